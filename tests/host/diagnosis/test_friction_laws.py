"""Laws of a slide that is simulated apart from the finder: damped bristles, and a lag of its sensor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numba import njit

from host.diagnosis import diagnose
from tests.host.proof.everyday import axis_nominal

pytestmark = pytest.mark.slow
Array = npt.NDArray[np.float64]
DT_S, STEPS = 5e-3, 100


@njit(cache=True)
def slide(
    force: Array,
    law: tuple[float, float, float],
    dry: tuple[float, float, float],
) -> Array:
    """Position of a slide. law: mass, damping, stiffness; dry: level of friction, stiffness and damping of its bristles."""
    n, h = force.size, DT_S / STEPS
    x, v, z, place = 0.0, 0.0, 0.0, np.empty(force.size)
    for i in range(n):
        place[i] = x
        for _ in range(STEPS):
            free = v + h * (force[i] - law[1] * v - law[2] * x) / law[0]
            if dry[0] > 0.0:
                before = z
                z = (z + h * v) / (1.0 + h * abs(v) * dry[1] / dry[0])
                free -= h * (dry[1] * z + dry[2] * (z - before) / h) / law[0]
            v = free
            x += h * v
    return place


def pushed(seed: int, seconds: float, waves: dict[float, float]) -> tuple[np.random.Generator, Array, Array]:
    """Random numbers, times, and a force of sines: amplitudes (N) by frequency (Hz)."""
    rng, t = np.random.default_rng([seed, 19]), DT_S * np.arange(round(seconds / DT_S))
    phase = rng.uniform(0.0, 6.3, len(waves))
    return rng, t, np.sin(2.0 * np.pi * np.outer(t, list(waves)) + phase) @ np.array(list(waves.values()))


def test_damped_bristles_are_presliding_and_not_a_friction_that_falls() -> None:
    """The friction of Canudas de Wit et al. (1995) at a constant level was named Stribeck friction with 0.93."""
    recordings = []
    for seed in (1, 2):
        rng, t, f = pushed(seed, 12.0, {0.25: 8.0, 0.8: 4.0, 1.7: 3.0})
        x = slide(f, (1.0, 8.0, 300.0), (2.0, 1500.0, 5.0))
        recordings.append({"t": t, "f": f, "x": x + 1.5e-4 * rng.standard_normal(t.size)})
    nominal = axis_nominal("zero", mass=0.8, damping=12.0, stiffness=250.0)
    (effect,) = diagnose(recordings, nominal).as_dict()["effects"]
    assert effect["id"] == "presliding_friction"
    assert effect["parameters"]["force_N"]["value"] == pytest.approx(2.0, rel=0.03)


def test_the_plain_lag_of_a_sensor_is_tried_before_richer_ones() -> None:
    """A digital low pass was named: mass, damping and stiffness were off by several of their intervals."""
    recordings = []
    for seed in (1, 2):
        rng, t, f = pushed(seed, 10.0, {0.5: 4.0, 1.4: 4.0, 2.6: 4.0, 4.2: 4.0})
        x = slide(f, (1.0, 5.0, 200.0), (0.0, 0.0, 0.0))
        fine, lagged = np.interp(DT_S / 20 * np.arange(20 * t.size), t, x), np.zeros(t.size)
        state = x[0]
        for i in range(t.size):
            lagged[i] = state
            for value in fine[20 * i : 20 * (i + 1)]:
                state += (1.0 - np.exp(-DT_S / 20 / 0.025)) * (value - state)
        recordings.append({"t": t, "f": f, "x": lagged + 3e-4 * rng.standard_normal(t.size)})
    nominal = axis_nominal("zero", mass=0.8, damping=6.0, stiffness=180.0)
    verdict = diagnose(recordings, nominal).as_dict()
    (effect,) = verdict["effects"]
    assert effect["id"] == "rate_lag"
    assert effect["parameters"]["time_constant_s"]["value"] == pytest.approx(0.025, rel=0.02)
    assert verdict["fit"]["nominal_parameters"]["mass_N_s2_per_m"]["value"] == pytest.approx(1.0, rel=0.005)
