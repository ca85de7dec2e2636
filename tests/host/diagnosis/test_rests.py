"""Motion that starts and stops under dry friction: its size, although no recording shows the instants at which it jumps."""

from __future__ import annotations

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.models.balance import at_edges
from tests.host.proof.everyday import axis_nominal, stream

Array = np.ndarray
DT_S, SAMPLES, STEPS, BEGIN = 0.002, 5000, 20, 500


def driven(seed: int, mass: float, damping: float, friction: float) -> list[dict[str, Array]]:
    """Three recordings of a stage in a PID loop that goes to another place every 1.2 s at 0.15 m/s; the force is held.

    Time steps in which dry friction takes as much of the speed as it can (Moreau 1988).
    """
    rng, out, h = stream(seed), [], DT_S / STEPS
    for _ in range(3):
        n = SAMPLES + BEGIN
        target = np.repeat(rng.uniform(-0.05, 0.05, n // 600 + 1), 600)[:n]
        x, v, total, before, wanted = 0.0, 0.0, 0.0, 0.0, 0.0
        read, force = np.zeros(n), np.zeros(n)
        for k in range(n):
            wanted += np.clip(target[k] - wanted, -0.15 * DT_S, 0.15 * DT_S)
            read[k] = x + 3e-6 * rng.standard_normal()
            error = wanted - read[k]
            total += error * DT_S
            force[k] = 4000.0 * error + 6000.0 * total + 200.0 * (error - before) / DT_S
            before = error
            for _ in range(STEPS):
                free = v + h * (force[k] - damping * v) / mass
                faster = np.sign(free) * max(abs(free) - h * friction / mass, 0.0)
                x, v = x + 0.5 * h * (v + faster), faster
        out.append({"t": DT_S * np.arange(SAMPLES), "f": force[BEGIN:], "x": read[BEGIN:]})
    return out


@pytest.mark.slow
def test_friction_of_a_stage_that_starts_and_stops_has_its_size() -> None:
    """Test functions that reach over the begin and end of a rest took a tenth of it, and gave it to the damping."""
    terms = ("mass", "damping", "offset")
    content = sd.diagnose(driven(841, 4.0, 30.0, 5.0), axis_nominal("zero", terms=terms)).as_dict()
    (effect,) = content["effects"]
    force, nominal = effect["parameters"]["force_N"], content["fit"]["nominal_parameters"]
    assert effect["id"] == "coulomb_friction" and effect["probability"] > 0.9
    assert force["value"] == pytest.approx(5.0, rel=0.02) and force["ci95"][0] < 5.0 < force["ci95"][1]
    assert nominal["damping_N_s_per_m"]["value"] == pytest.approx(30.0, rel=0.03)


def test_samples_about_the_begin_and_end_of_a_rest_are_left_out() -> None:
    """Those that a test function reaches, unless that is more than half of the motion."""
    rests = np.zeros(100, dtype=bool)
    rests[40:60] = True
    assert np.array_equal(np.flatnonzero(at_edges(rests, 2)), [*range(37, 44), *range(57, 64)])
    often = np.arange(100) % 8 < 4
    assert not at_edges(often, 2).any() and not at_edges(np.zeros(100, dtype=bool), 2).any()
