"""A delay whose error has several minima: the right one is found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import seldinger as sd

PAD: dict[str, Any] = {
    "name": "pad",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"x": {"column": "x", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "pad", "input": "x", "output": "f", "terms": ["damping", "stiffness", "offset"]},
}


def pressed(seed: int, delay_s: float) -> dict[str, np.ndarray]:
    """A pad of 4 kN/m and 40 N s/m under tones up to 6 Hz, its force read late, 10 s at 500 Hz."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 10.0, 0.002)
    frequencies, phases = np.geomspace(0.3, 6.0, 6) * rng.uniform(0.9, 1.1, 6), rng.uniform(0.0, 6.28, 6)
    omega = 2.0 * np.pi * frequencies
    x = 1e-3 * np.sin(np.outer(t, omega) + phases).sum(axis=1)
    late = np.outer(t - delay_s, omega) + phases
    f = 1e-3 * (4000.0 * np.sin(late) + 40.0 * omega * np.cos(late)).sum(axis=1)
    return {"t": t, "x": x, "f": f + 0.05 * rng.normal(size=t.size)}


@pytest.mark.parametrize("delay_s", [0.024, 0.038, 0.045, 0.07])
def test_damping_does_not_hide_a_long_delay(delay_s: float) -> None:
    """The fitted damping takes over a part of the delay, and the error has one minimum with damping and one without."""
    verdict = sd.diagnose([pressed(seed, delay_s) for seed in (1, 2, 3)], PAD)
    assert [effect["id"] for effect in verdict.effects] == ["latency"]
    assert verdict.effects[0]["parameters"]["delay_s"]["value"] == pytest.approx(delay_s, rel=0.01)
