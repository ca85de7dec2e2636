"""What a report page lists of the search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from host.cli.diagnose import summary
from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.report.page import candidates, headline
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


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ([], "There is a mismatch, and no known effect explains it"),
        (["changed"], "The nominal parameters change within a recording"),
        (["outliers", "session"], "The nominal parameters differ between the recordings; data: outliers"),
    ],
)
def test_parameters_that_differ_are_the_headline(found: list[str], says: str) -> None:
    verdict = {"verdict": "mismatch_not_identified", "effects": [], "worse": []}
    assert headline({**verdict, "data_findings": [{"id": name} for name in found]}) == says


def test_the_summary_states_an_error_with_effects_only_where_there_are_any() -> None:
    fit = {"rmse_before": 0.5, "rmse_after": 0.5, "unit": "m", "noise_floor": 0.1}
    verdict = {"verdict": "nothing_missing", "effects": [], "data_findings": [], "worse": [], "fit": fit, "next": "Nothing."}
    assert summary(verdict) == ["nothing missing", "held-out RMS error 0.5 m; noise 0.1 m", "next: Nothing."]
