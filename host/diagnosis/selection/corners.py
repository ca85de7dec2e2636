"""Laws with a corner, and the same laws without it: which of both the data call for, and how far their amounts differ.

Dry friction jumps where the motion reverses. That of a lubricated contact, or of another simulator, rises within a small
speed. If such a friction is fitted with the jump, its force comes out too small, with an interval that does not hold the
true one. Both laws have one name, so that their likelihood alone decides between them.
"""

from __future__ import annotations

import numpy as np

from host.diagnosis.estimation.fit import Fit, Problem, Term, finish, get_starts, minimize, set_starts
from host.diagnosis.estimation.initial_state import begun_again
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.refits import refined
from host.diagnosis.selection.screening import without
from host.diagnosis.selection.trial import Trial, at_bound

Interval = tuple[float, float]


def round_corners(problem: Problem, found: Found) -> None:
    """Each law with a corner replaced by the same law without it, where that one is plainly likelier.

    Where neither is, the fit without the corner is kept as one that is alike. Changes `found`.
    """
    rules, found.alike = problem.rules, []
    for term in found.best.terms:
        tried = _without_corner(found, term)
        if tried is None or problem.budget.spent():
            continue
        step, trial = tried
        begun, before = get_starts(problem), found.best
        other = _in_its_place(problem, before, term, trial)
        ahead = problem.gain("both", before.residuals, other.residuals)
        lead = ahead.log_likelihood - rules.parameter_penalty * (other.fitted - before.fitted)
        if at_bound(other) or lead < rules.heldout_log_likelihood:
            set_starts(problem, begun)
            if lead > -rules.equal_log_likelihood:
                found.alike.append(other)
            continue
        found.steps.append(Step(SearchMove.ROUND, trial.candidate.key, ahead, step.trials))
        found.best = refined(problem, other)


def over_alike(problem: Problem, found: Found, spans: list[Interval], of: list[list[Interval]]) -> list[Interval]:
    """`spans` of the best fit's parameters, each so wide that it holds that parameter's interval in the fits that are alike.

    of: intervals of `found.alike`. Fits of other effects than those that are named now do not count.
    """
    out, best = list(spans), found.best
    places = {name: index for index, name in enumerate(_names(problem, best))}
    for fit, others in zip(found.alike, of, strict=True):
        if sorted(term.candidate.name for term in fit.terms) != sorted(term.candidate.name for term in best.terms):
            continue
        for name, (low, high) in zip(_names(problem, fit), others, strict=True):
            place = places.get(name)
            if place is not None:
                out[place] = (min(out[place][0], low), max(out[place][1], high))
    return out


def _names(problem: Problem, fit: Fit) -> list[tuple[str, ...]]:
    """What tells the parameters of a fit from one another, whatever the form of its effects: place, effect, name, unit."""
    nominal = [("", "", p.name, p.unit) for p in problem.model.parameters]
    own = [(t.candidate.port.name, t.candidate.effect.id, p.name, p.unit) for t in fit.terms for p in t.parameters]
    return [*nominal, *own]


def _without_corner(found: Found, term: Term) -> tuple[Step, Trial] | None:
    """The last step and trial of the law of `term` without its corner, at its place; None where none was tried."""
    own = term.candidate
    if own.effect.rounded:
        return None
    for step in reversed(found.steps):
        for trial in step.trials:
            other = trial.candidate
            same = (other.effect.id, other.port.name, other.source) == (own.effect.id, own.port.name, own.source)
            if same and other.effect.rounded:
                return step, trial
    return None


def _in_its_place(problem: Problem, best: Fit, term: Term, trial: Trial) -> Fit:
    """`best` with the effect of `trial` in the place of `term`; it is the last one."""
    rest, values = without(best, problem, (term.candidate.key,))
    own = trial.fit.terms[-1]
    begin = np.concatenate((values, trial.fit.values_of(own)))
    other = minimize(problem, (*rest, own), begin, rounds=problem.rules.further_iterations, tolerance=1e-4)
    return finish(problem, begun_again(problem, other))
