"""Effects whose interval contains zero: dropped, unless a recording that was not fitted is decisive for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from host.diagnosis.estimation.fit import Problem, minimize
from host.diagnosis.model.effect import Parameter
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import candidates_of, prepare
from host.diagnosis.selection import removal
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal, refined
from host.diagnosis.selection.screening import term_of
from host.diagnosis.selection.trial import reached
from tests.host.proof import everyday as make


def rubbing(friction_N: float) -> tuple[Problem, Found]:
    """A spring with dry friction, its second recording held out, and the fit that names this friction."""
    recordings = [Table(f"r{k}", make.spring(k, coulomb_N=friction_N)) for k in (41, 42)]
    nominal = {**make.spring_nominal(), "data": {"time": "t", "heldout": ["r42"]}}
    _, problem, _ = prepare(nominal_of(nominal), recordings)
    rubs = next(c for c in candidates_of(problem, frozenset()) if c.effect.id == "coulomb_friction" and not c.form)
    found = Found(fit_nominal(problem), fit_nominal(problem), [])
    term = term_of(problem, rubs, found.nominal)
    found.best = refined(problem, minimize(problem, (term,), np.append(found.nominal.values, 0.01)))
    return problem, found


@pytest.mark.parametrize(("friction_N", "stays"), [(0.5, True), (0.0, False)])
def test_only_decisive_evidence_outweighs_an_interval(
    monkeypatch: pytest.MonkeyPatch, friction_N: float, stays: bool
) -> None:
    problem, found = rubbing(friction_N)
    monkeypatch.setattr(removal, "intervals", lambda problem, fit: [(-abs(v), 2.0 * abs(v)) for v in fit.values])
    removal.drop_unsure(problem, found)
    assert bool(found.best.terms) == stays


@pytest.mark.parametrize(("times", "drops"), [(3.0, False), (20.0, True)])
def test_an_amplitude_from_zero_to_ten_times_its_value_says_nothing(
    monkeypatch: pytest.MonkeyPatch, times: float, drops: bool
) -> None:
    problem, found = rubbing(0.5)
    (term,) = found.best.terms
    (p,) = term.parameters
    found.best.terms = (replace(term, parameters=(replace(p, low=0.0, high=np.inf),)),)
    monkeypatch.setattr(removal, "intervals", lambda problem, fit: [(0.0, times * abs(v)) for v in fit.values])
    assert bool(removal.unsure(problem, found.best)) == drops


def test_an_amplitude_at_the_limit_of_fits_is_at_a_bound() -> None:
    ratio = Parameter("load_ratio", "", (0.5,), 0.0, np.inf, linear=True)
    assert reached(ratio, 500.0, natural=True) and not reached(ratio, 68.0, natural=True)
