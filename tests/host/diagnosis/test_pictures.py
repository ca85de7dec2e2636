"""Pictures and figures of a report: the axes of the loop, and what remains of the mismatch."""

from __future__ import annotations

import base64
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.report.pictures import before_after, loop
from host.diagnosis.report.verdict import remaining_power, remains
from host.report.style import ReportFigure

TWO_LINKS = {
    "name": "wrist",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {name: {"column": name, "unit": "rad"} for name in ("motor", "gear", "tendon", "jaw")},
    "link": [
        {"subsystem": "upper", "input": "motor", "output": "gear"},
        {"subsystem": "lower", "input": "tendon", "output": "jaw"},
    ],
}


def recorded(seed: int) -> dict[str, np.ndarray]:
    """Play of 0.8 mrad behind a tendon that moves by 10 mrad; the other link has none."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 12.0, 0.02)
    motor, tendon = (0.3 * np.sin(1.3 * t + rng.uniform(0.0, 6.0)), 0.01 * np.sin(1.9 * t + rng.uniform(0.0, 6.0)))
    jaw = tendon.copy()
    for k in range(1, t.size):
        jaw[k] = min(max(jaw[k - 1], tendon[k] - 4e-4), tendon[k] + 4e-4)
    gear, jaw = (values + 3e-5 * rng.standard_normal(t.size) for values in (motor, jaw))
    return {"t": t, "motor": motor, "gear": gear, "tendon": tendon, "jaw": jaw}


def words_of(picture: ReportFigure) -> list[str]:
    return re.findall(r">([^<>]+)</text>", base64.b64decode(picture.wide.split(",")[1]).decode())


def test_the_loop_is_drawn_over_the_motion_of_its_own_link_in_units_that_can_be_read() -> None:
    result = diagnose([recorded(seed) for seed in (1, 2)], TWO_LINKS).diagnosis
    assert [term.candidate.name for term in result.found.best.terms] == ["backlash@lower"]
    picture = loop(result)
    assert picture is not None
    words = words_of(picture)
    assert "tendon (mrad)" in words and "jaw (mrad)" in words
    assert {"−5", "0", "5"} <= {word.removesuffix(".0") for word in words}


@pytest.mark.parametrize(
    ("after", "predictable", "remaining"),
    [(30.2, 0.0, 0.048), (30.2, 0.3, 0.3), (24.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)],
)
def test_what_remains_agrees_with_the_errors_that_are_stated(after: float, predictable: float, remaining: float) -> None:
    """86.7 before, noise 24.1: an error above the noise is not called a remainder of nothing."""
    figures = SimpleNamespace(before=np.array([86.7]), after=np.array([after]), noise_sd=np.array([24.1]), primary=0)
    result: Any = SimpleNamespace(figures=figures, remainder=SimpleNamespace(share=predictable))
    assert remaining_power(result) == pytest.approx(remaining, abs=1e-3)
    assert remains(result).startswith(f"{remaining:.0%} of its power")


@pytest.mark.parametrize(("errors", "ticks"), [((0.97, 1.31), {"1", "1.1", "1.2"}), ((0.9, 40.0), {"1", "2", "5", "10"})])
def test_the_axis_of_errors_has_ticks_whatever_their_range(errors: tuple[float, float], ticks: set[str]) -> None:
    figures = SimpleNamespace(before=np.array(errors[::-1]), after=np.array(errors), noise_sd=np.ones(2), primary=0)
    model = SimpleNamespace(outputs=[SimpleNamespace(channel=name) for name in ("x", "y")])
    result: Any = SimpleNamespace(figures=figures, model=model)
    assert ticks <= set(words_of(before_after(result)))
