"""The thresholds of a diagnosis: one home, each read somewhere, handed to every step and printed by the verdict."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.estimation.noise import NoiseSource
from host.diagnosis.estimation.rules import RULES, SelectionRules
from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import inspected, prepare
from protocol.errors import InputError

SOURCES = Path(__file__).parents[3] / "host" / "diagnosis"
GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "tip": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "motor", "output": "tip"}],
}


def gear(seed: int, highest: float = np.inf) -> dict[str, np.ndarray]:
    """A gear for 12 s at 50 Hz, its reading limited to `highest`."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 12.0, 0.02)
    x = 0.3 * np.sin(1.3 * t + rng.uniform(0.0, 6.0)) + 0.2 * np.sin(2.9 * t + rng.uniform(0.0, 6.0))
    return {"t": t, "m": x, "y": np.minimum(x + 1e-3 * rng.normal(size=t.size), highest)}


def found(highest: float, rules: SelectionRules) -> set[str]:
    data = inspected(nominal_of(GEAR), [Table(f"r{seed}", gear(seed, highest)) for seed in (1, 2)], rules)
    return {finding.id for finding in data.findings}


def test_names_are_those_of_one_rule() -> None:
    own, of_data = ({rule.name for rule in fields(kind)} for kind in (SelectionRules, DataRules))
    assert not own & of_data
    assert set(RULES.as_dict()) == (own - {"data"}) | of_data
    assert all(isinstance(value, int | float) for value in RULES.as_dict().values())


def test_every_rule_is_read() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES.rglob("*.py"))
    assert [name for name in RULES.as_dict() if not re.search(rf"\.{name}\b", text)] == []


def test_a_rule_is_changed_by_its_name_wherever_it_is() -> None:
    rules = RULES.changed(clipped_share=0.5, significance=0.02)
    assert rules.data.clipped_share == 0.5 and rules.significance == 0.02
    different = {name for name, value in rules.as_dict().items() if value != RULES.as_dict()[name]}
    assert different == {"clipped_share", "significance"}
    with pytest.raises(TypeError, match="no_such_rule"):
        RULES.changed(no_such_rule=1.0)


@pytest.mark.parametrize(("changed", "limited"), [({}, True), ({"clipped_share": 0.9}, False)])
def test_a_rule_of_the_data_decides_a_finding(changed: dict[str, float], limited: bool) -> None:
    assert ("saturated" in found(0.35, RULES.changed(**changed))) is limited


def test_a_rule_of_the_data_decides_what_is_refused() -> None:
    with pytest.raises(InputError, match="at least 5000 rows"):
        found(np.inf, RULES.changed(least_rows=5000))


def test_noise_is_estimated_by_the_rules_that_are_given() -> None:
    still = gear(3)
    still["m"][:200] = still["m"][200]
    sources = [Table("r", {**still, "y": still["m"] + 1e-3 * np.random.default_rng(4).normal(size=600)})]
    for rules, source in ((RULES, NoiseSource.QUIESCENT), (RULES.changed(rest_shortest_samples=500), NoiseSource.SPECTRUM)):
        _, problem, full = prepare(nominal_of(GEAR), sources, rules)
        assert problem.noise[0].source is source and problem.rules is full.rules is rules


@pytest.mark.parametrize("constant", [False, True])
def test_the_verdict_prints_the_rules_that_it_used(constant: bool) -> None:
    """Also where there is nothing to compare."""
    runs = [gear(seed) for seed in (5, 6)]
    if constant:
        runs = [{**run, "y": np.full_like(run["y"], 3.0)} for run in runs]
    rules = RULES.changed(clipped_share=0.02, confident=0.8)
    verdict = diagnose(runs, GEAR, rules=rules)
    assert verdict.as_dict()["rules"] == rules.as_dict() != RULES.as_dict()
    assert (verdict.diagnosis is None) is constant
