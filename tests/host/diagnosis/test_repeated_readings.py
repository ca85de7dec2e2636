"""A sensor that is read more seldom than it is logged: its age is no lag, and its repetitions are no further samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

import seldinger as sd
from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.readings import repeated

RATE_HZ = 100.0
STAGE: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "u", "unit": "N"}, "place": {"column": "y", "unit": "m"}},
    "axis": {"subsystem": "stage", "input": "force", "output": "place", "terms": ["mass", "damping", "stiffness"],
             "hold": "linear"},
    "parameters": {"mass": 1.1, "damping": 2.7, "stiffness": 95.0},
}  # fmt: skip


def tones(rng: np.random.Generator, t: np.ndarray, size: float) -> np.ndarray:
    at = zip(rng.uniform(0.1, 1.5, 5), rng.uniform(0.0, 6.28, 5), strict=True)
    return np.asarray(size * sum(np.sin(2.0 * np.pi * hertz * t + phase) for hertz, phase in at))


def logged(samples: float, delay_s: float = 0.0) -> list[dict[str, Any]]:
    """Three recordings of a mass on a spring whose place is read every so many samples."""
    made = []
    for k in range(3):
        rng, t = np.random.default_rng([97, k]), np.arange(0.0, 23.0, 1.0 / RATE_HZ)
        force = tones(rng, t, 2.0)
        place = np.interp(t - delay_s, t, lsim(([1.0], [1.4, 3.0, 90.0]), force, t)[1])
        read = place + 3e-4 * rng.standard_normal(t.size)
        last = np.floor(np.floor(np.arange(t.size) / samples) * samples).astype(int)
        part = slice(300, None)
        made.append({"t": t[part], "u": force[part], "y": read[last][part]})
    return made


@pytest.mark.parametrize("samples", [4, pytest.param(3.3, marks=pytest.mark.long)])
def test_a_reading_that_is_logged_again_and_again_is_no_lag(samples: float) -> None:
    """A lag was named (0.29) that left two thirds of the error."""
    verdict = sd.diagnose(logged(samples), STAGE)
    assert verdict.verdict == "nothing_missing"
    (finding,) = [f for f in verdict.data_findings if f["id"] == "repeated"]
    assert f"for {int(samples)} samples" in finding["says"]


@pytest.mark.long
def test_a_delay_behind_it_is_found_with_its_whole_value() -> None:
    effects = sd.diagnose(logged(4, 0.06), STAGE).effects
    assert effects[0]["id"] == "latency" and effects[0]["parameters"]["delay_s"]["value"] == pytest.approx(0.06, abs=0.003)


def test_a_coarse_reading_of_a_slow_motion_repeats_nothing() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    for motion in (np.sin(0.7 * t), np.abs((t % 4.0) - 2.0)):
        assert repeated(np.asarray(np.round(motion, 2), dtype=float), DataRules()) is None
    assert repeated(np.random.default_rng(1).standard_normal(500), DataRules()) is None
    assert repeated(np.zeros(500), DataRules()) is None
