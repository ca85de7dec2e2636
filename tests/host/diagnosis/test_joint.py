"""Two effects at once where none passes alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.selection import search
from host.diagnosis.selection.found import SearchMove
from tests.host.proof import everyday as make


def _play_and_delay(number: int) -> dict[str, Any]:
    """A gear with play, behind which everything comes 80 ms late."""
    columns = make.with_play(make.gear(number, fastest_Hz=2.0), 0.25)
    return {**columns, "load": np.interp(columns["t"] - 0.08, columns["t"], columns["load"])}


@pytest.mark.slow
def test_a_pair_is_found_where_every_single_effect_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    found = search.good_enough
    monkeypatch.setattr(search, "good_enough", lambda trial, base: bool(base.terms) and found(trial, base))
    verdict = diagnose([_play_and_delay(1), _play_and_delay(2)], make.gear_nominal())
    assert {effect["id"] for effect in verdict.effects} == {"backlash", "latency"}
    assert [step.move for step in verdict.diagnosis.found.steps][:1] == [SearchMove.STOP]


def test_no_pair_is_tried_where_nothing_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[str] = []
    monkeypatch.setattr("host.diagnosis.selection.joint._fitted", lambda *given: fitted.append("pair"))
    assert diagnose([make.gear(1), make.gear(2)], make.gear_nominal()).verdict == "nothing_missing"
    assert not fitted
