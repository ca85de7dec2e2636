"""A channel that is early by any part of a sample: stated, corrected or fitted, never an effect, and hiding none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

import seldinger as sd
from tests.host.proof.everyday import free_nominal, gear_nominal, spring_nominal, stream

Array = np.ndarray
Columns = dict[str, Array]
DT_S, SAMPLES, FINER = 0.01, 2500, 20


def moved(rng: np.random.Generator, size: float) -> tuple[Array, CubicSpline]:
    """Times (n,) s and a random motion of up to 1.5 Hz with the RMS `size`, with a margin at both ends."""
    t = DT_S * np.arange(SAMPLES + 400)
    f, phase, part = rng.uniform(0.05, 1.5, 12), rng.uniform(0.0, 6.28, 12), rng.standard_normal(12)
    x = np.sin(2 * np.pi * np.outer(t, f) + phase) @ part
    return t, CubicSpline(t, size * x / np.std(x))


def cut(t: Array) -> Array:
    """The times of a recording within its margins."""
    return t[200 : 200 + SAMPLES]


def pressed(seed: int, lead: float, cubic: float = 0.0, mass: float = 0.0) -> list[Columns]:
    """Three recordings of a pad (40 N s/m, 800 N/m, 0.5 N) whose force is read `lead` samples early."""
    rng, out = stream(seed), []
    for _ in range(3):
        t, x = moved(rng, 3e-3)
        force = CubicSpline(t, 40.0 * x(t, 1) + 800.0 * x(t) + cubic * x(t) ** 3 + mass * x(t, 2) + 0.5)
        now = cut(t)
        f = force(now + lead * DT_S) + 0.01 * rng.standard_normal(SAMPLES)
        out.append({"t": now - now[0], "x": x(now) + 2e-6 * rng.standard_normal(SAMPLES), "f": f})
    return out


def geared(seed: int, lead: float, play: float = 0.0) -> list[Columns]:
    """Three recordings of a gear (1.3) whose load is read `lead` samples early. play: whole width at the motor."""
    rng, out = stream(seed), []
    for _ in range(3):
        t, x = moved(rng, 3.0)
        fine = np.arange(0.0, t[-1], DT_S / FINER)
        u = x(fine)
        at = u[0]
        for k in range(u.size if play else 0):
            u[k] = at = min(max(at, u[k] - 0.5 * play), u[k] + 0.5 * play)
        now = cut(t)
        load = np.interp(now + lead * DT_S, fine, 1.3 * u) + 0.03 * rng.standard_normal(SAMPLES)
        out.append({"t": now - now[0], "motor": x(now), "load": load})
    return out


def diagnosed(recordings: list[Columns], nominal: dict[str, Any]) -> tuple[sd.Verdict, list[str]]:
    """Verdict and the ids of what was found about the recordings."""
    verdict = sd.diagnose(recordings, nominal)
    return verdict, [finding["id"] for finding in verdict.data_findings]


@pytest.mark.parametrize("lead", [2.6, 7.88])
def test_the_clock_of_a_force_is_corrected_by_parts_of_a_sample(lead: float) -> None:
    verdict, found = diagnosed(pressed(801, lead), spring_nominal())
    assert verdict.verdict == "nothing_missing" and found == ["clock"]
    says = verdict.data_findings[0]["says"]
    assert float(says.split(" comes ")[1].split(" s ")[0]) == pytest.approx(lead * DT_S, abs=0.02 * DT_S)
    low, high = verdict.as_dict()["fit"]["nominal_parameters"]["damping_N_s_per_m"]["ci95"]
    assert low < 40.1 and 39.9 < high


@pytest.mark.parametrize("lead", [0.4, 1.4, 4.33])
def test_the_clock_of_a_gear_is_corrected_by_parts_of_a_sample(lead: float) -> None:
    verdict, found = diagnosed(geared(802, lead), gear_nominal())
    assert verdict.verdict == "nothing_missing" and found == ["within_sample" if lead < 1.0 else "clock"]


@pytest.mark.parametrize("lead", [1.4, 5.4])
def test_a_lead_hides_no_play_of_a_gear(lead: float) -> None:
    verdict, found = diagnosed(geared(803, lead, play=1.0), gear_nominal())
    assert [effect["id"] for effect in verdict.effects] == ["backlash"] and "clock" in found
    assert verdict.effects[0]["parameters"]["width_rad"]["value"] == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("lead", [1.4, 5.4])
def test_a_lead_hides_no_hardening_of_a_spring(lead: float) -> None:
    verdict, found = diagnosed(pressed(804, lead, cubic=2e7), spring_nominal())
    assert [effect["id"] for effect in verdict.effects] == ["nonlinear_stiffness"] and found == ["clock"]


def test_a_force_that_is_early_by_a_part_of_a_sample_may_be_a_mass() -> None:
    """To first order, both add the same to the force of a damper and a spring."""
    for recordings in (pressed(805, 0.4), pressed(806, 0.0, mass=0.16)):
        verdict, found = diagnosed(recordings, spring_nominal())
        for effect in verdict.effects:
            assert effect["id"] == "resonance" and effect["probability"] < 0.9
            assert effect["indistinguishable_from"] == ["latency@pad"] and "lead" in found
        if not verdict.effects:
            assert "within_sample" in found


def test_a_random_force_is_not_a_drift_of_a_parameter() -> None:
    """A second mass fits a part of what the unrecorded force does. With it, one parameter may as well run."""
    out = []
    for k in range(3):
        rng = stream(810 + k)
        t = np.arange(4000) / 200.0
        f = np.sin(2 * np.pi * np.outer(t, rng.uniform(0.2, 3.0, 3)) + rng.uniform(0.0, 6.28, 3)) @ np.full(3, 16.0)
        slow = lfilter([np.sqrt(1.0 - np.exp(-0.2))], [1.0, -np.exp(-0.1)], rng.standard_normal(t.size))
        felt, keep = np.repeat(f + slow, 20), np.exp(-6.0 / 4000.0)
        v = lfilter([(1.0 - keep) / 30.0], [1.0, -keep], felt)
        x = np.cumsum(v)[::20] / 4000.0
        out.append({"t": t, "f": f, "x": x + 1e-5 * rng.standard_normal(t.size)})
    verdict, found = diagnosed(out, free_nominal("zero"))
    assert not verdict.effects and "drifting" not in found
