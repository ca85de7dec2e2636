"""The study that moves each threshold by a fifth."""

import json
from pathlib import Path
from typing import Any

import pytest

from host.diagnosis.estimation.rules import RULES
from host.studies.proof.sensitivity import LabelledCase, block, changes, read_cases, values_of, verdict_of
from protocol.errors import InputError
from tests.host.proof.test_runner import Built


def test_whole_numbers_move_by_at_least_one() -> None:
    assert values_of(6.0) == (4.8, 7.2)
    assert values_of(10) == (8, 12)
    assert values_of(2) == (1, 3)
    assert values_of(-1.8) == (-1.44, -2.16)
    assert values_of(0.95) == (0.76, 0.96)


def test_every_rule_is_moved_both_ways() -> None:
    rules = RULES.as_dict()
    assert sorted(change.rule for change in changes()) == sorted([*rules] * 2)
    for change in changes():
        moved = change.applied().as_dict()
        assert {name for name, value in moved.items() if value != rules[name]} == {change.rule}


def line(rule: str, value: float, effects: dict[str, float], right: bool, case: str = "ode/0001") -> dict[str, Any]:
    said = "missing_physics" if effects else "nothing_missing"
    read = {} if rule else {"read": ["significance", "coarsening", "prior_none"]}
    return {
        "case": case,
        "rule": rule,
        "value": value,
        "verdict": said,
        "effects": [*effects.items()],
        "right": right,
        **read,
    }


def test_the_table_lists_the_cases_whose_verdict_changes(tmp_path: Path) -> None:
    (tmp_path / "suite.json").write_text(json.dumps({"seed": 5}))
    less, more = values_of(RULES.significance)
    lines = [
        line("", 0.0, {"backlash@gear": 0.9}, True),
        line("", 0.0, {}, False, "ode/0002"),
        line("significance", less, {}, False),
        line("significance", more, {"backlash@gear": 0.9}, True),
        line("significance", more, {"rate_lag@gear": 0.6}, True, "ode/0002"),
        line("coarsening", values_of(RULES.coarsening)[1], {"backlash@gear": 0.86}, True),
        line("prior_none", values_of(RULES.prior_none)[0], {"backlash@gear": 0.9}, True),
    ]
    text = block(lines, tmp_path)
    assert "Seed 5, 2 cases (2 of `ode`). With the rules as they are, 1 verdicts are right." in text
    assert "| `significance` | 0.01 | -ode/0001 | +ode/0002 | 0.00 |" in text
    assert "| `coarsening` | 60 | none | none | 0.04 |" in text
    assert "With 1 other rules no name changes, and no probability by 0.01: `prior_none`." in text
    assert f"None of these cases reads the other {len(RULES.as_dict()) - 3} rules: `rest_range_share`, " in text


def test_rules_that_a_case_reads_are_noted(built: Built) -> None:
    folder, labels = built
    label = next(la for la in labels if la["kind"] == "transmission" and la["category"] == "null")
    case = LabelledCase("own", label, folder / "own" / "cases" / label["id"])  # type: ignore[arg-type]
    said = verdict_of(case, None)
    assert {"screening_log_likelihood", "absent_a"} <= set(said["read"])
    assert set(said["read"]) < set(RULES.as_dict())


def test_cases_are_found_by_name(built: Built) -> None:
    folder, labels = built
    (case,) = read_cases(folder, ["own/0003"])
    assert case.label == labels[3] and (case.folder / "nominal.toml").exists()
    with pytest.raises(InputError, match="own/0099"):
        read_cases(folder, ["own/0003", "own/0099"])
