"""What is found in the recordings before any fit: readings that are limited, short noisy channels, copies in order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

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
