"""Curves and periods: what does not come back is a curve, whatever sine is near it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from host.diagnosis import diagnose

GEAR = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {name: {"column": name, "unit": "rad"} for name in ("motor", "jaw")},
    "link": [{"subsystem": "gear", "input": "motor", "output": "jaw"}],
}


def recorded(seed: int, curve: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    """A gear that turns over 1.6 rad for 20 s, with a curve in it."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 20.0, 0.02)
    x = 0.5 * np.sin(0.7 * t + rng.uniform(0.0, 6.0)) + 0.3 * np.sin(1.9 * t + rng.uniform(0.0, 6.0))
    return {"t": t, "motor": x, "jaw": x + curve(x) + 1e-3 * rng.standard_normal(t.size)}


@pytest.mark.parametrize(
    ("curve", "name"),
    [
        (lambda x: 6e-3 * (np.tanh(4.0 * x) - 1.3 * x), "static_nonlinearity"),  # 1.3 periods of a sine, nearly
        (lambda x: 4e-3 * np.sin(2.0 * np.pi * x / 0.5), "periodic_disturbance"),  # three periods
    ],
)
def test_a_bend_is_no_period_before_crest_and_trough_come_back(curve: Callable[[np.ndarray], np.ndarray], name: str) -> None:
    (effect,) = diagnose([recorded(seed, curve) for seed in (1, 2, 3)], GEAR).as_dict()["effects"]
    assert effect["id"] == name
