"""New starts of the nominal parameters, next to an effect without which their fit went astray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from host.diagnosis.estimation.fit import Fit, Problem, Term, finish, minimize, reweigh, robust, starts
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.screening import Screened, enough, screen, term_of, without

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
LOST = 1e-3  # change of the error without a parameter, over the error, below which it does nothing


def hidden(problem: Problem, nominal: Fit, candidate_effects: list[Candidate]) -> list[Screened]:
    """Candidates that change the nominal parameters so much that each needs start values of its own for them.

    A model with `restarts` says which parameters are worth a try; those that leave the least with the effect are
    kept.
    """
    few = enough(problem)
    begins = problem.model.restarts(few.segments) if any(c.effect.hides for c in candidate_effects) else []
    found = []
    for candidate in candidate_effects if begins else ():
        if not candidate.effect.hides:
            continue
        term = term_of(problem, candidate, nominal)
        begin = starts(term, {}, {})
        tried = [np.concatenate((theta, begin)) for theta in begins]
        tried.sort(key=lambda values: robust(few.stacked((term,), values))[0])
        nominals = [values[: -begin.size] for values in tried[: problem.rules.nominal_restarts]]
        if nominals:
            found.append(Screened(candidate, term, (), 0.0, [begin] * len(nominals), nominals))
    return found


def along_motion(
    problem: Problem, base: Fit, candidate_effects: list[Candidate], promising: list[Screened], progress: Progress
) -> list[Screened]:
    """`promising`, with starts from the forces along the measured motion where the fit of `base` went astray.

    Without its damper, a simulated oscillator is far from its recording with the right mass and spring, and nearer with
    wrong ones. Without its spring, a mass is best left away. From there no single step leads back. Along the measured motion
    the law is linear in its coefficients.
    """
    along = _along(problem, base)
    if along is None:
        return promising
    fit = _astray(along, base, problem.rules)
    if fit is None:
        return promising
    few = enough(problem)
    forces = [candidate for candidate in candidate_effects if candidate.effect.slots is not None]
    ranked = [each for each in screen(along, fit, forces, progress) if each.promise > problem.rules.screening_log_likelihood]
    found, cost = {item.candidate.key: item for item in promising}, robust(few.stacked(base.terms, base.values))[0]
    for item in ranked[: problem.rules.fits_per_step]:
        terms, values = without(fit, along, item.drop)
        terms = (*terms, item.term)
        begins = [_solved(along, terms, np.append(values, begin)) for begin in item.begin]
        rounds = problem.rules.first_iterations  # all that is linear is at its place already
        tried = [minimize(along, terms, begin, rounds=rounds, tolerance=1e-4) for begin in begins]
        best = min(tried, key=lambda each: each.cost)
        if robust(few.stacked(terms, best.values))[0] < cost:
            nominal, begin = np.split(best.values, [values.size])
            so_far = without(base, problem, item.drop)[1]
            before = found.get(item.candidate.key, replace(item, begin=[], nominal=[]))
            others = [*before.nominal, *([so_far] * (len(before.begin) - len(before.nominal)))]
            # its natural sizes, too, are those along the motion: parameters that went astray make them anything
            found[item.candidate.key] = replace(
                before, term=item.term, begin=[begin, *before.begin], nominal=[nominal, *others]
            )
    return list(found.values())


def _along(problem: Problem, base: Fit) -> Problem | None:
    """The recordings to screen by, compared along the measured motion; None where the model cannot."""
    model = problem.model.along_motion()
    if model is None or model is problem.model:
        return None if model is None else enough(problem)
    few = enough(problem).segments
    segments = [replace(model.prepare(segment.recording), fit=segment.fit) for segment in few]
    if problem.model.holds:
        model.hold_as(segments, problem.model.hold)
    noise = next(noise for noise in map(model.noise_of, segments) if noise is not None)
    along = Problem(model, segments, [noise], np.ones(1), problem.columns, problem.rules)
    reweigh(along, Fit(base.terms, base.values))
    return along


def _astray(along: Problem, base: Fit, rules: SelectionRules) -> Fit | None:
    """The parameters of `base` fitted along the motion, if its own leave much more there, or have lost one; else None."""
    fit = minimize(along, base.terms, _solved(along, base.terms, base.values))
    left = [along.stacked(base.terms, values) for values in (base.values, fit.values)]
    own, least = (float(r @ r) for r in left)
    lost = False
    for index, p in enumerate(along.model.inner.parameters):
        if p.log:
            away = fit.values.copy()
            away[index] = 0.0
            change = along.stacked(base.terms, away) - left[1]
            lost = lost or float(change @ change) < LOST**2 * least
    return finish(along, fit) if lost or own > rules.astray_ratio**2 * least else None


def _solved(along: Problem, terms: tuple[Term, ...], values: Array) -> Array:
    """`values` with those solved for in which the error along the motion is linear, next to the others as they are."""
    parameters, law = along.parameters(terms), len(along.model.inner.parameters)
    linear = [k for k, p in enumerate(parameters) if p.high > p.low and (p.linear or k < law)]
    without_them = values.copy()
    without_them[linear] = 0.0
    left, columns = along.stacked(terms, without_them), []
    for k in linear:
        one = without_them.copy()
        one[k] = max(abs(values[k]), *map(abs, parameters[k].grid)) or 1.0
        columns.append((along.stacked(terms, one) - left) / one[k])
    A = np.array(columns).T
    size = np.linalg.norm(A, axis=0)
    bounds = [(max(p.low, 0.0) if p.log else p.low, p.high) for p in (parameters[k] for k in linear)]
    if not linear or not np.all(np.isfinite(A)) or not size.all():
        return values
    low, high = (np.array(ends) * size for ends in zip(*bounds, strict=True))
    found = values.copy()
    found[linear] = lsq_linear(A / size, -left, (low, high)).x / size
    return found
