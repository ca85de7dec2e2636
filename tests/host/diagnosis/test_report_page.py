"""What a report page lists of the search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.report.page import candidates
from host.diagnosis.selection.found import SearchMove, Step


def rows(*steps: Step) -> list[tuple[str, str, str]]:
    """Name, gain and p-value of the rows of these steps."""
    result: Any = SimpleNamespace(found=SimpleNamespace(steps=list(steps)))
    return [(row.name, row.likelihood, row.p_value) for row in candidates(result)]


@pytest.mark.parametrize("move", list(SearchMove))
def test_every_removal_is_listed(move: SearchMove) -> None:
    listed = rows(Step(move, "sensor_bias@tip"))
    assert listed == ([(f"sensor bias at tip {move.value}", "", "")] if move.removes else [])


def test_a_removal_by_evidence_states_it() -> None:
    assert rows(Step(SearchMove.BACKWARD, "creep(fast)@gear", Gain(2.5, 0.25, 0.0))) == [
        ("creep (fast) at gear removed again", "2.5", "0.25")
    ]
