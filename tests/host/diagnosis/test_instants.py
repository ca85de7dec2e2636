"""A lost step is put at its instant, also where that lies in samples that are held out, and none is invented."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import seldinger as sd

GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"u": {"column": "u", "unit": "rad"}, "y": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "u", "output": "y"}],
    "parameters": {"gain": 0.22},
}


@pytest.mark.parametrize("lost", [{5.0: 0.02}, {7.3: 0.02}, {11.7: 0.02}, {7.3: 0.02, 13.1: 0.03}])
def test_a_lost_step_has_its_instant_within_a_sample(lost: dict[float, float]) -> None:
    """Blocks of a lone recording are held out by turns: 6 to 8 s, 10 to 12 s, ..."""
    rng, t = np.random.default_rng(913), np.arange(0.0, 20.0, 0.01)
    u = sum(a * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.28)) for f, a in ((0.25, 1.0), (0.7, 0.6)))
    y = 0.25 * u - sum(size * (t >= instant - 1e-9) for instant, size in lost.items())
    (found,) = sd.diagnose([{"t": t, "u": u, "y": y + 5e-4 * rng.standard_normal(t.size)}], GEAR).as_dict()["effects"]
    assert found["id"] == "missed_steps" and found["probability"] > 0.9
    instants = {key: value for key, value in found["parameters"].items() if key.startswith("instant")}
    assert [value["value"] for value in instants.values()] == pytest.approx(list(lost), abs=0.01)
    assert all(value["ci95"][1] - value["ci95"][0] >= 0.0099 for value in instants.values())
    sizes = [value["value"] for key, value in found["parameters"].items() if key.startswith("jump")]
    assert sizes == pytest.approx([-4.0 * size for size in lost.values()], rel=0.02)
