"""Noise that a controller sends back into the input, and delays of recordings that are cut from motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.estimation.feedback import find_feedback, freed
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.locate import windows

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
    find_feedback([segment], [noise[None, :]], ("u",))
    left = float(np.var(freed(segment, 0, noise)) / np.var(noise))
    assert left == pytest.approx(share, abs=0.05)


def test_windows_of_a_recording_shorter_than_their_average() -> None:
    t = np.arange(2000) * 1e-5
    mismatch = np.where(t > 0.01, 1.0, 0.0)
    assert windows(mismatch, t, 1e-5) == []
