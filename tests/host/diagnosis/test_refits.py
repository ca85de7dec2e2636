"""Fits of the nominal model and of its effects: where they begin, what is removed again, and how sure a time is."""

from __future__ import annotations

import numpy as np
import pytest

from host.diagnosis import diagnose
from host.diagnosis.effects import candidates, library
from host.diagnosis.estimation.fit import Fit, Problem, finish, minimize
from host.diagnosis.estimation.uncertainty import intervals
from host.diagnosis.model.effect import Scale
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.removal import unsure
from host.diagnosis.selection.screening import term_of
from tests.host.proof import everyday as make


def gear(columns: list[make.Columns]) -> Problem:
    tables = [Table(f"r{k}", each) for k, each in enumerate(columns)]
    return prepare(nominal_of(make.gear_nominal()), tables)[1]


def with_effect(problem: Problem, name: str, values: list[float]) -> Fit:
    nominal = fit_nominal(problem)
    offered = candidates(problem.model.ports, True)
    term = term_of(problem, next(c for c in offered if c.effect.id == name and not c.form), nominal)
    return finish(problem, Fit((term,), np.concatenate((nominal.values, values))))


def test_a_guess_whose_simulation_runs_away_is_not_where_the_fit_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise had made the mass negative in the linear guess, and its default of 0.5 g let every simulation run away."""
    tables = [Table(f"r{k}", make.sprung(k)) for k in (1, 2)]
    _, problem, _ = prepare(nominal_of(make.axis_nominal()), tables)
    assert fit_nominal(problem).values[:3] == pytest.approx([make.MASS_kg, make.DAMPING, make.STIFFNESS], rel=0.02)
    monkeypatch.setattr(problem.model, "guess", lambda _: np.array([5e-6, 100.0, 7000.0, 0.0]))
    assert fit_nominal(problem).values[:3] == pytest.approx([make.MASS_kg, make.DAMPING, make.STIFFNESS], rel=0.02)


def test_a_delay_is_uncertain_by_the_sample_in_which_it_is_read() -> None:
    problem = gear([make.with_delay(make.gear(k), 0.123) for k in (1, 2)])
    near = with_effect(problem, "latency", [0.123])
    fit = finish(problem, minimize(problem, near.terms, near.values))
    low, high = intervals(problem, fit)[-1]
    assert 1.0 <= 0.5 * (high - low) / problem.recorded_s <= 1.6
    problem.recorded_s = 0.0  # untimed samples have no period
    low, high = intervals(problem, fit)[-1]
    assert 0.5 * (high - low) < 0.002


def test_a_gain_that_changes_where_the_motion_ends_is_not_sure() -> None:
    problem = gear([make.gear(k) for k in (1, 2)])
    highest = max(float(np.max(segment.inputs["motor"])) for segment in problem.segments)
    assert unsure(problem, with_effect(problem, "asymmetry", [0.2, highest]))
    bent = [make.gear(k) for k in (1, 2)]
    for columns in bent:
        columns["load"] += 0.05 * np.abs(columns["motor"])
    problem = gear(bent)
    assert not unsure(problem, with_effect(problem, "asymmetry", [0.125, 0.0]))


def test_a_small_difference_of_gain_is_no_lost_sign() -> None:
    recordings = [make.gear(k) for k in (1, 2)]
    for columns in recordings:
        columns["load"] += 0.01 * np.abs(columns["motor"])
    content = diagnose(recordings, make.gear_nominal()).as_dict()
    assert [effect["id"] for effect in content["effects"]] == ["asymmetry"]


def test_what_moves_or_loads_the_rig_at_a_frequency_is_tried_where_the_residual_has_its_lines() -> None:
    """A grid of few frequencies misses a beat: a drag of the flow at 1.1 Hz was fitted at 1.2 Hz and named a weight."""
    scale = Scale("m", 1.0, 0.0, 1.0, 1.0, 1e-6, 1.0, 0.025, 30.0, True)
    found = [
        (f"{effect.id}:{form}", p.spectral)
        for effect in library()
        if effect.id in ("flow_drag", "base_motion")
        for form in effect.forms
        for p in effect.parameters(scale, form)
        if p.unit == "Hz"
    ]
    assert {"flow_drag:", "base_motion:beat", "base_motion:rock", "base_motion:line"} <= {name for name, _ in found}
    assert all(spectral for _, spectral in found)
