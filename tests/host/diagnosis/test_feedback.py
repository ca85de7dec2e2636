"""Noise that a controller sends back into the input, and delays of recordings that are cut from motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.estimation.feedback import find_feedback, freed, unpredicted
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.locate import windows
from tests.host.proof.everyday import free_nominal
from tests.host.proof.suite_cases import verdict_of

RATE_HZ = 400.0
STIFFNESS, DAMPING = 150.0, 2.0
PRESS = {
    "name": "press",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"motion": {"column": "x", "unit": "m"}, "force": {"column": "f", "unit": "N"}},
    "impedance": {
        "subsystem": "press",
        "input": "motion",
        "output": "force",
        "terms": ["damping", "stiffness", "offset"],
    },
}


def pressed(number: int, delay_s: float, seconds: float = 10.0) -> dict[str, Any]:
    """A spring and damper pressed in five tones, read `delay_s` late, with noise of 1 % of the force."""
    rng = np.random.default_rng([77, number])
    t = np.arange(-400, seconds * RATE_HZ) / RATE_HZ
    phases = rng.uniform(0.0, 6.28, 5)
    x = np.sin(2.0 * np.pi * np.outer(t, [0.2, 0.5, 0.9, 1.6, 2.6]) + phases) @ np.full(5, 0.006)
    force = STIFFNESS * x + DAMPING * np.gradient(x, t)
    read = np.interp(t - delay_s, t, force) + 0.01 * rng.standard_normal(t.size)
    return {"t": t[400:] - t[400], "x": x[400:], "f": read[400:]}


def test_a_delay_longer_than_a_step_is_found_to_its_size_in_recordings_cut_from_motion() -> None:
    """At 100 times the noise a straight line in place of the unseen input outweighed all other samples."""
    (found,) = diagnose([pressed(k, 0.06) for k in (1, 2, 3)], PRESS).effects
    assert found["id"] == "latency"
    low, high = found["parameters"]["delay_s"]["ci95"]
    assert low <= 0.06 <= high
    assert found["parameters"]["delay_s"]["value"] == pytest.approx(0.06, abs=0.004)


def held(number: int, rate_hz: float = 200.0, steps: int = 10, late_steps: int = 6) -> dict[str, Any]:
    """The same spring and damper in a loop that holds a force: it reads the force with its noise and 3 ms late."""
    rng, n = np.random.default_rng([78, number]), 4000
    h = 1.0 / (rate_hz * steps)
    fine, rows = np.arange(n * steps) * h, np.arange(n) / rate_hz
    wanted = 0.006 * np.sin(2.0 * np.pi * np.outer(fine, [0.2, 0.5, 0.9]) + rng.uniform(0.0, 6.28, 3)).sum(axis=1)
    noise = np.interp(fine, rows, 0.01 * rng.standard_normal(n))
    x, read = wanted.copy(), np.zeros(fine.size)
    moved = 0.0
    for k in range(1, fine.size):
        if k > late_steps:
            moved += 40.0 * h * (wanted[k - late_steps] - read[k - late_steps] / STIFFNESS)
        x[k] = wanted[k] + moved
        read[k] = STIFFNESS * x[k] + DAMPING * (x[k] - x[k - 1]) / h + noise[k]
    return {"t": rows[200:] - rows[200], "x": x[::steps][200:], "f": read[::steps][200:]}


def test_noise_that_comes_back_within_a_sample_is_no_delay() -> None:
    """A rate that is interpolated sees the next sample, and in it the noise of this one."""
    verdict = diagnose([held(number) for number in (1, 2, 3)], PRESS)
    assert (verdict.verdict, [effect["id"] for effect in verdict.effects]) == ("nothing_missing", [])


@pytest.mark.parametrize(("through", "share"), [(0.5, 0.3), (0.0, 1.0)])
def test_only_noise_that_comes_back_is_taken_off(through: float, share: float) -> None:
    rng = np.random.default_rng(3)
    noise = rng.standard_normal(3000)
    u = rng.standard_normal(3000)
    u[4:] += 3.0 * through * noise[:-4]
    t = np.arange(3000) / 100.0
    every = np.ones(3000, dtype=bool)
    recording = Recording("a", t, 0.01, True, {"u": u}, every, ~every)
    segment = Segment(recording, noise[None, :], every, ~every, {"u": u})
    find_feedback([segment], [noise[None, :]], ("u",), RULES)
    left = float(np.var(freed(segment, 0, noise)) / np.var(noise))
    assert left == pytest.approx(share, abs=0.05)


def test_noise_that_comes_back_in_the_same_row_is_taken_off_where_later_rows_hold_more_of_it() -> None:
    rng = np.random.default_rng(4)
    noise, u = rng.standard_normal(6000), rng.standard_normal(6000)
    u[2:] += 1.5 * noise[:-2]
    u += 0.35 * noise  # a thirtieth of the variance: less than shows feedback alone
    t, every = np.arange(6000) / 100.0, np.ones(6000, dtype=bool)
    recording = Recording("a", t, 0.01, True, {"u": u}, every, ~every)
    segment = Segment(recording, noise[None, :], every, ~every, {"u": u})
    find_feedback([segment], [noise[None, :]], ("u",), RULES)
    new = unpredicted(u)
    assert abs(np.corrcoef(new, freed(segment, 0, noise))[0, 1]) < 1e-3


def looped(number: int, coulomb_N: float = 0.0, noise_m: float = 2e-4, load_kg: float = 0.0) -> dict[str, Any]:
    """A mass of 0.5 kg and a damper of 3 N s/m under a controller that reads the recorded place, held for 10 ms.

    load_kg: a second mass on a spring of 400 N/m.
    """
    rng = np.random.default_rng([78, number])
    t, h = np.arange(2000) / 100.0, 0.01 / 40.0
    wanted = 0.02 * np.sin(2.0 * np.pi * np.outer(t, np.geomspace(0.1, 1.0, 7)) + rng.uniform(0.0, 6.28, 7)).sum(axis=1)
    x = v = far = far_v = before = 0.0
    force, place = np.empty(t.size), np.empty(t.size)
    for i in range(t.size):
        place[i] = x + noise_m * rng.standard_normal()
        force[i] = 300.0 * (wanted[i] - place[i]) - 3.0 * (place[i] - before) / 0.01
        before = place[i]
        for _ in range(40):
            pull = 400.0 * (x - far) + (v - far_v) if load_kg else 0.0
            a = (force[i] - 3.0 * v - coulomb_N * np.tanh(v / 2e-3) - pull) / 0.5
            x, v = x + h * v + 0.5 * h * h * a, v + h * a
            if load_kg:
                far, far_v = far + h * far_v + 0.5 * h * h * pull / load_kg, far_v + h * pull / load_kg
    return {"t": t[:1800], "f": force[200:], "x": place[200:]}


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ({}, []),
        ({"noise_m": 5e-5}, []),
        ({"coulomb_N": 0.6}, ["coulomb_friction"]),
        pytest.param({"load_kg": 0.3, "noise_m": 2e-7}, ["resonance"], marks=pytest.mark.long),
    ],
    ids=["nothing", "nothing, less noise", "friction", "a second mass read well"],
)
@pytest.mark.parametrize("compare", ["force", None])
def test_noise_in_a_loop_around_a_free_mass_is_no_resonance(
    more: dict[str, float], found: list[str], compare: str | None
) -> None:
    """A second mass cancelled the noise that the controller had fed back, and was named with 0.92."""
    nominal = free_nominal("zero")
    nominal["axis"]["compare"] = compare
    verdict = diagnose([looped(k, **more) for k in (1, 2, 3)], nominal).as_dict()
    assert [effect["id"] for effect in verdict["effects"]] == found
    said = "noise_fed_back" in [finding["id"] for finding in verdict["data_findings"]]
    assert said == (compare == "force" and not found)


def lagging(number: int, lag_s: float) -> dict[str, Any]:
    """A mass of 0.5 kg and a damper of 3 N s/m whose motor follows the held command of a controller with a lag.

    The command is recorded with 2 % of noise; it has about 25 samples a period.
    """
    rng = np.random.default_rng([81, number])
    t, h = np.arange(1000) / 100.0, 0.01 / 40.0
    turns = np.outer(t, np.geomspace(0.3, 4.0, 7))
    wanted = 0.01 * np.sin(2.0 * np.pi * turns + rng.uniform(0.0, 6.28, 7)).sum(axis=1)
    x = v = acting = 0.0
    command, place = np.empty(t.size), np.empty(t.size)
    for i in range(t.size):
        place[i] = x
        command[i] = 100.0 * (wanted[i] - x) - 3.0 * v
        for _ in range(40):
            acting += h * (command[i] - acting) / lag_s
            a = (acting - 3.0 * v) / 0.5
            x, v = x + h * v + 0.5 * h * h * a, v + h * a
    noisy = command + 0.02 * np.std(command) * rng.standard_normal(t.size)
    return {"t": t[:800], "f": noisy[200:], "x": (place + 2e-8 * rng.standard_normal(t.size))[200:]}


def test_a_lag_of_a_noisy_command_has_its_own_time_constant() -> None:
    """Bends of the command were taken for noise that no lag smooths: 12 % too long, and a resonance explained it better."""
    verdict = diagnose([lagging(k, 0.02) for k in (1, 2)], free_nominal("zero")).as_dict()
    assert [effect["id"] for effect in verdict["effects"]] == ["rate_lag"]
    assert verdict["effects"][0]["parameters"]["time_constant_s"]["value"] == pytest.approx(0.02, rel=0.03)


def test_windows_of_a_recording_shorter_than_their_average() -> None:
    t = np.arange(2000) * 1e-5
    mismatch = np.where(t > 0.01, 1.0, 0.0)
    assert windows(mismatch, t, 1e-5, RULES) == []


def test_a_loop_in_which_nothing_is_missing_has_no_mode(tmp_path: Path) -> None:
    """A null of the proof (world `ode`, seed 352917) of which a load of 45 times the drive's mass took noise away."""
    result = verdict_of("ode", 352917, 5, tmp_path)
    assert result["verdict"] == "nothing_missing" and result["effects"] == []
