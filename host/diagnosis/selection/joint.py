"""Two effects at once, where no effect alone passes: each may show only together with the other (play and a bent curve)."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import Gain, compare
from host.diagnosis.estimation.fit import Fit, Problem, Term, finish, minimize, set_starts
from host.diagnosis.selection.screening import above_noise
from host.diagnosis.selection.trial import Trial, bound_by, related

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]


def best_pair(
    problem: Problem, nominal: Fit, trials: list[Trial], noise_sd: Array, progress: Progress
) -> tuple[Fit, Gain, list[dict[str, float]]] | None:
    """The likeliest pair of refused effects of which each earns its place together with the other; None if there is none.

    trials: effects fitted alone over `nominal`, all refused. Returns the pair's fit, its gain on held-out samples and the
    starts of memory that it was found with.
    """
    rules = problem.rules
    singles = _singles(trials, rules.joint_singles)
    called_for = bool(singles) and singles[0].both.log_likelihood >= rules.pooled_log_likelihood
    if not called_for and not above_noise(problem, nominal, rules.residual_over_noise):
        return None  # nothing calls for an effect, so nothing calls for two
    pairs = [(a, b) for a, b in itertools.combinations(singles, 2) if not related(a.candidate, b.candidate)]
    found = []
    for count, (a, b) in enumerate(pairs):
        if problem.budget.spent():
            break
        progress(f"fitting {a.candidate.key} and {b.candidate.key}", count / len(pairs))
        starts = [{**y, **x} for x, y in zip(a.starts, b.starts, strict=True)]
        set_starts(problem, starts)
        fit = _fitted(problem, nominal, a, b)
        held = compare(problem.segments, "heldout", nominal.residuals, fit.residuals, noise_sd)
        both = compare(problem.segments, "both", nominal.residuals, fit.residuals, noise_sd)
        more = len(fit.values) - len(nominal.values)
        if _earned(problem, fit, a, b, noise_sd) and _enough(problem, held, both, more):
            found.append((both.log_likelihood - rules.parameter_penalty * more, fit, held, starts))
    if not found:
        return None
    _, fit, held, starts = max(found, key=lambda item: item[0])
    return fit, held, starts


def _singles(trials: list[Trial], most: int) -> list[Trial]:
    """The likeliest trial of each effect and port."""
    kept: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda trial: -trial.both.log_likelihood):
        kept.setdefault(f"{trial.candidate.effect.id}@{trial.candidate.port.name}", trial)
    return list(kept.values())[:most]


def _fitted(problem: Problem, nominal: Fit, a: Trial, b: Trial) -> Fit:
    """Both effects together, from the nominal parameters of either."""
    n, rules = len(nominal.values), problem.rules
    own = [trial.fit.values[n:] for trial in (a, b)]
    terms: tuple[Term, ...] = (a.fit.terms[-1], b.fit.terms[-1])
    begins = [np.concatenate((trial.fit.values[:n], *own)) for trial in (a, b)]
    fits = [minimize(problem, terms, begin, rounds=rules.first_iterations, tolerance=1e-4) for begin in begins]
    fit = min(fits, key=lambda f: f.cost)
    return finish(problem, minimize(problem, terms, fit.values, rounds=rules.further_iterations, tolerance=1e-4))


def _earned(problem: Problem, fit: Fit, a: Trial, b: Trial, noise_sd: Array) -> bool:
    """Whether each effect gains enough over the other alone, on samples to fit and on held-out ones, and none is at a
    bound.
    """
    rules = problem.rules
    if any(bound_by(fit, term) for term in fit.terms):
        return False
    for alone in (a, b):
        more = len(fit.values) - len(alone.fit.values)
        held = compare(problem.segments, "heldout", alone.fit.residuals, fit.residuals, noise_sd)
        trained = compare(problem.segments, "fit", alone.fit.residuals, fit.residuals, noise_sd)
        least = rules.heldout_log_likelihood + more
        if min(held.log_likelihood, trained.log_likelihood - more) < least or held.p_value > rules.significance:
            return False
        if held.share < rules.further_error_reduction:
            return False
    return True


def _enough(problem: Problem, held: Gain, both: Gain, more: int) -> bool:
    """Whether the pair passes what a single effect has to."""
    rules = problem.rules
    least = max(rules.least_error_reduction, rules.least_excess_reduction * held.excess)
    sure = held.p_value < rules.significance or both.log_likelihood > rules.decisive_log_likelihood
    return sure and held.share > least and held.log_likelihood > rules.heldout_log_likelihood + more
