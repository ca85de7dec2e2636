"""Small effects have starts, wrong partners are exchanged, a stand-in lists the equation that does better."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Problem, finish, minimize
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.problems import prepare
from host.diagnosis.selection.equivalence import standings
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.screening import screen
from host.diagnosis.selection.search import _exchange, _grow
from tests.host.diagnosis import planted

Array = np.ndarray


def silent(text: str, share: float) -> None:
    """Take the progress of a diagnosis and show none of it."""


def late(x: Array, t: Array) -> Array:
    return np.interp(t - 0.0015, t, x)


def drifting(x: Array, t: Array) -> Array:
    return np.interp(t * (1.0 - 6e-5), t, x)


def slack(x: Array, t: Array) -> Array:
    return np.sign(x) * np.maximum(np.abs(x) - 0.003, 0.0)


@pytest.mark.parametrize(("effect", "act"), [("latency", late), ("clock_drift", drifting), ("dead_zone", slack)])
def test_effects_far_below_a_sample_or_the_span_are_not_overlooked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, effect: str, act: Callable[[Array, Array], Array]
) -> None:
    monkeypatch.setattr(planted, "_transmitted", lambda _, x, load, t: act(x, t))
    problem, nominal = fitted(planted.transmission(tmp_path, "", 1))
    ranked = screen(problem, nominal, candidates(problem.model.ports, True), silent)
    promise = {item.candidate.effect.id: item.promise for item in reversed(ranked)}
    assert promise[effect] > 0.9 * ranked[0].promise > 10.0


def fitted(case: tuple[Path, list[Path]]) -> tuple[Problem, Fit]:
    problem = prepare(read_nominal(case[0]), case[1])[1]
    return problem, fit_nominal(problem)


def found_by(problem: Problem, nominal: Fit, *ids: str) -> Found:
    """What a search that knows only these effects finds."""
    candidate_effects = [c for c in candidates(problem.model.ports, True) if c.effect.id in ids]
    found = Found(nominal, nominal, [])
    _grow(problem, found, candidate_effects, 0.0, silent)
    return found


def test_a_wrong_partner_is_exchanged_for_the_right_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backlash = planted._transmitted
    monkeypatch.setattr(planted, "_transmitted", lambda _, x, load, t: backlash("backlash", x, load, t))
    problem, nominal = fitted(planted.transmission(tmp_path, "compliance", 1))
    found = found_by(problem, nominal, "compliance", "rate_lag")
    assert {name.partition("@")[0] for name in found.best.names} == {"compliance", "rate_lag"}
    _exchange(problem, found, candidates(problem.model.ports, True), silent)
    assert {name.partition("@")[0] for name in found.best.names} == {"compliance", "backlash"}


@pytest.mark.parametrize(
    ("effect", "named", "equal"), [("unlisted", "asymmetry", True), ("compliance", "compliance", False)]
)
def test_an_equation_that_does_better_is_listed_beside_a_stand_in(
    tmp_path: Path, effect: str, named: str, equal: bool
) -> None:
    problem, nominal = fitted(planted.transmission(tmp_path, effect, 1))
    term = next(
        item.term
        for item in screen(problem, nominal, candidates(problem.model.ports, True), silent)
        if item.candidate.effect.id == named
    )
    begin = [*nominal.values, *(p.grid[0] for p in term.parameters)]
    best = finish(problem, minimize(problem, (term,), np.array(begin)))
    (standing,) = standings(problem, Found(nominal, best, []))
    assert ("unlisted@cable" in [other.name for other in standing.alike]) is equal


def test_the_input_of_another_link_is_tried_without_being_named() -> None:
    recordings = []
    for number in (1, 2):
        rng = np.random.default_rng([92, number])
        t = np.arange(0.0, 20.0, 0.02)
        phase = rng.uniform(0.0, 6.28, (2, 2))
        knob = np.sin(2.0 * np.pi * np.outer(t, [0.2, 0.7]) + phase[0]).sum(axis=1)
        roll = np.sin(2.0 * np.pi * np.outer(t, [0.13, 0.5]) + phase[1]).sum(axis=1)
        bend, turn = 0.5 * knob + 0.03 * roll, 0.9 * roll
        noise = 2e-3 * rng.standard_normal((2, t.size))
        recordings.append({"t": t, "knob": knob, "roll": roll, "bend": bend + noise[0], "turn": turn + noise[1]})
    nominal = {
        "name": "handle",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {name: {"column": name, "unit": "rad"} for name in ("knob", "roll", "bend", "turn")},
        "link": [
            {"subsystem": "knob", "input": "knob", "output": "bend"},
            {"subsystem": "roll", "input": "roll", "output": "turn"},
        ],
    }
    (found,) = sd.diagnose(recordings, nominal).effects
    assert (found["id"], found["subsystem"]) == ("coupling", "knob")
    assert found["parameters"]["gain"]["value"] == pytest.approx(0.03 / 0.5, rel=0.02)
