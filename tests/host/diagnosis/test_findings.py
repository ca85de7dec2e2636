"""What is found in the recordings before any fit: readings that are limited, short noisy channels, copies in order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from host.diagnosis.model.findings import Finding
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.pipeline import inspected

GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "jaw": {"column": "y", "unit": "rad"}},
    "link": [{"input": "motor", "output": "jaw"}],
}


AXIS: dict[str, Any] = {
    "name": "stage",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "place": {"column": "y", "unit": "m"}},
    "axis": {"input": "force", "output": "place", "terms": ["mass", "damping", "stiffness"], "hold": "zero"},
    "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
}


def stage(force: Callable[[np.ndarray], np.ndarray], noise_m: float = 1e-4) -> dict[str, np.ndarray]:
    """A mass of 1.2 kg on 150 N/m and 3 N s/m under a held force (N) of time, for 20 s at 100 Hz."""
    t, rng = np.arange(2000) * 0.01, np.random.default_rng(301)
    f = force(t)
    step = expm(np.array([[0.0, 1.0, 0.0], [-150.0 / 1.2, -3.0 / 1.2, 1.0 / 1.2], [0.0, 0.0, 0.0]]) * 0.01)[:2]
    state, y = np.zeros(2), np.zeros(t.size)
    for k in range(t.size):
        y[k] = state[0]
        state = step @ np.array([*state, f[k]])
    return {"t": t, "f": f, "y": y + noise_m * rng.standard_normal(t.size)}


def tones(t: np.ndarray) -> np.ndarray:
    """Four tones (N) that never repeat a value."""
    parts = zip((0.3, 0.9, 1.6, 2.6), (3.0, 2.0, 3.0, 2.0), (0.4, 2.1, 5.0, 1.2), strict=True)
    return sum(a * np.sin(2.0 * np.pi * f * t + phase) for f, a, phase in parts)


def motion(n: int = 600) -> dict[str, np.ndarray]:
    rng, t = np.random.default_rng(4), np.arange(n) * 0.02
    x = 0.3 * np.sin(1.3 * t + 1.0) + 0.2 * np.sin(2.9 * t)
    return {"t": t, "m": x, "y": x + 1e-3 * rng.standard_normal(n)}


def said(columns: dict[str, np.ndarray], nominal: dict[str, Any] = GEAR) -> list[Finding]:
    return inspected(nominal_of(nominal), [Table("a", columns), Table("b", columns)]).findings


@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize(("low", "high", "word"), [(-np.inf, 0.3, "largest"), (-0.3, np.inf, "smallest")])
def test_a_reading_that_is_limited_on_either_side_is_stated(gain: float, low: float, high: float, word: str) -> None:
    columns = motion()
    columns["y"] = np.clip(gain * columns["y"], low, high)
    limits = [finding.says for finding in said(columns) if finding.id == "saturated"]
    assert len(limits) == 1 and f"its {word} reading" in limits[0]


LEVELS = np.random.default_rng(910).uniform(-5.0, 5.0, 60)


@pytest.mark.parametrize(
    "force",
    [
        lambda t: np.where(t > 2.0, 4.0, 0.0),
        lambda t: np.where(t % 2.0 < 0.8, 4.0, 1.0),
        lambda t: np.sign(LEVELS)[(t / 0.35).astype(int)] * 5.0,
        lambda t: np.sign(np.random.default_rng(1).standard_normal(t.size)) * 5.0,
        lambda t: LEVELS[(t / 0.5).astype(int)],
        lambda t: np.convolve(LEVELS[(t / 0.5).astype(int)], [0.5, 0.5])[: t.size],
        lambda t: 4.0 * np.where(t % 2.0 < 0.8, np.sin(np.pi * (t % 2.0) / 0.8), 0.0),
    ],
    ids=["step", "pulses", "prbs", "white prbs", "staircase", "resampled staircase", "half sines"],
)
def test_an_input_that_is_held_at_levels_is_not_limited_there(force: Callable[[np.ndarray], np.ndarray]) -> None:
    assert "saturated" not in {finding.id for finding in said(stage(force), AXIS)}


def test_an_input_that_is_clipped_is_stated() -> None:
    assert "saturated" in {finding.id for finding in said(stage(lambda t: np.clip(tones(t), -4.0, 4.0)), AXIS)}


def test_a_short_channel_of_noise_is_no_sinusoid() -> None:
    """Its strongest line may be among the last three of the spectrum."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        columns = motion(60) | {"m": rng.standard_normal(60), "y": rng.standard_normal(60)}
        assert not any("sinusoid" in finding.says for finding in said(columns))


def test_copies_are_stated_in_the_order_of_the_channels() -> None:
    columns = motion()
    columns["y"] += 0.03 * np.random.default_rng(7).standard_normal(columns["y"].size)  # noise that two gauges do not share
    others = {name: {"column": name, "unit": "N"} for name in "hgfe"}
    nominal = GEAR | {"channels": GEAR["channels"] | others, "link": [GEAR["link"][0] | {"load": list(others)}]}
    found = said(columns | {name: columns["y"].copy() for name in others}, nominal)
    assert [finding.channel for finding in found if finding.id == "alias"] == list(others)
