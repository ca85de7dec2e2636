"""What was changed between recordings is said with the parameters of each; one nominal model for all is not."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import seldinger as sd

LINK: dict[str, Any] = {
    "name": "belt",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "load": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "belt", "input": "motor", "output": "load"}],
}


def sessions(gains: tuple[float, ...], offsets: tuple[float, ...]) -> list[dict[str, Any]]:
    made = []
    for k, (gain, offset) in enumerate(zip(gains, offsets, strict=True)):
        rng = np.random.default_rng([71, k])
        t = np.arange(0.0, 20.0, 0.02)
        tones = zip(rng.uniform(0.1, 1.5, 5), rng.uniform(0.0, 6.28, 5), strict=True)
        motor = 0.3 * sum(np.sin(2.0 * np.pi * f * t + phase) for f, phase in tones)
        made.append({"t": t, "m": motor, "y": gain * motor + offset + 0.003 * rng.standard_normal(t.size)})
    return made


def test_a_gain_that_was_changed_between_recordings_is_said_and_no_effect_is_named() -> None:
    """It ended as wear (0.17), which left nine tenths of the mismatch."""
    verdict = sd.diagnose(sessions((1.0, 1.0, 0.9, 0.9), (0.0, 0.0, 0.0, 0.0)), LINK)
    (finding,) = [f for f in verdict.data_findings if f["id"] == "session"]
    assert verdict.verdict == "mismatch_not_identified" and not verdict.effects
    assert re.search(r"gain is (1|0\.9999|1\.000) in recording 1, .* 0\.9(00.)? in recording 4", finding["says"])
    assert "between the recordings" in verdict.as_dict()["next"]


@pytest.mark.parametrize(("gains", "offsets"), [((0.95,) * 4, (0.02,) * 4)])
def test_recordings_of_one_model_are_not_called_unlike(gains: tuple[float, ...], offsets: tuple[float, ...]) -> None:
    verdict = sd.diagnose(sessions(gains, offsets), LINK)
    assert verdict.verdict == "nothing_missing" and not verdict.data_findings
