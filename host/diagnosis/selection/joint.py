"""Two effects at once, where no effect alone passes: each may show only together with the other (play and a bent curve)."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Problem, Term, finish, get_starts, minimize, set_starts
from host.diagnosis.estimation.initial_state import begun_again
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.refits import restarted
from host.diagnosis.selection.screening import above_noise, term_of
from host.diagnosis.selection.trial import Trial, bound_by, of_noise, of_sampling, related, sure_together

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
FitNext = Callable[[Fit, list[dict[str, float]]], list[Trial]]


@dataclass(frozen=True)
class PairFit:
    """Two effects that pass together: their fit, and the starts of memory that it was found with."""

    fit: Fit
    score: float  # likelihood on all samples, less the cost of the parameters
    heldout: Gain
    starts: list[dict[str, float]]


def best_pair(problem: Problem, nominal: Fit, trials: list[Trial], fit_next: FitNext, progress: Progress) -> PairFit | None:
    """The likeliest pair of refused effects of which each earns its place together with the other; None if there is none.

    The effects of a pair are among those fitted alone; or the second is one that shows only past the first.

    trials: effects fitted alone over `nominal`, all refused. fit_next: the best further effects over the fit of a trial.
    """
    rules = problem.rules
    singles = _singles([trial for trial in trials if not of_noise(trial)], rules.joint_singles)
    earned = [t.both.log_likelihood - rules.parameter_penalty * (t.fit.fitted - nominal.fitted) for t in singles]
    called_for = max(earned, default=0.0) > rules.weak_log_likelihood
    if not called_for and not above_noise(problem, nominal, rules.joint_over_noise):
        return None  # nothing calls for an effect, so nothing calls for two
    pairs = [
        (a, b)
        for a, b in itertools.combinations(singles, 2)
        if not (related(a.candidate, b.candidate) or of_sampling(a) or of_sampling(b))
    ]
    found = []
    for count, (a, b) in enumerate(pairs):
        if problem.budget.spent():
            break
        progress(f"fitting {a.candidate.key} and {b.candidate.key}", count / len(pairs))
        starts = [{**y, **x} for x, y in zip(a.starts, b.starts, strict=True)]
        set_starts(problem, starts)
        fit = _fitted(problem, nominal, a, b)
        passed = _passed(problem, nominal, fit, starts)
        if passed is not None and all(_earned_over(problem, fit, alone.fit) for alone in (a, b)):
            found.append(passed)
    for trial in _unlike(singles)[: rules.joint_first]:
        if problem.budget.spent():
            break
        progress(f"fitting a second effect with {trial.candidate.key}", 0.5)
        seconds = [t for t in fit_next(trial.fit, trial.starts) if len(t.fit.terms) == 2]
        if seconds:  # past the second the first may have another, simpler form
            top = max(seconds, key=lambda t: t.both.log_likelihood)
            set_starts(problem, top.starts)
            other = _alone(problem, nominal, top.fit)
            seconds += [t for t in fit_next(other, top.starts) if len(t.fit.terms) == 2]
        for second in (t for t in seconds if not (of_sampling(t) or of_noise(t))):
            set_starts(problem, second.starts)
            fit, passed = second.fit, _passed(problem, nominal, second.fit, second.starts)
            if passed is not None and all(
                _earned_over(problem, fit, _alone(problem, nominal, fit, which)) for which in (0, 1)
            ):
                found.append(passed)
    return max(found, key=lambda pair: pair.score, default=None)


def pair_instead(problem: Problem, nominal: Fit, one: Fit, trials: list[Trial]) -> tuple[PairFit | None, list[Fit]]:
    """Two effects in the place of the one in `one`, whose formula joins effects of unlike kinds; None if they do no better.
    Then the pairs that do as well: no data tell them from it.

    A loop with a dead band both rests after a reversal and is late. It outdoes play or a delay alone where both are there,
    and hides them: past it, neither earns much. Pairs of an effect that it contains and any unlike one at its port have to
    be likelier than it is. The arguments are those of `best_pair`.
    """
    rules, term = problem.rules, one.terms[0]
    here = [t for t in _singles(trials, len(trials)) if t.candidate.port.name == term.candidate.port.name]
    parts = [t for t in here if t.candidate.effect.id in term.candidate.effect.contains]
    if len(_unlike(parts)) < 2 or problem.budget.spent():
        return None, []
    tried = [
        (a, b)
        for a, b in itertools.combinations(here, 2)
        if (a in parts or b in parts)
        and not (related(a.candidate, b.candidate) or related(b.candidate, a.candidate))
        and term.candidate.key not in (a.candidate.key, b.candidate.key)
    ]
    begun, found, equal = get_starts(problem), [], []
    for a, b in tried[: rules.split_fits]:
        fit = _fitted_anew(problem, nominal, a, b)
        passed = _passed(problem, nominal, fit, get_starts(problem))
        ahead = problem.gain("both", one.residuals, fit.residuals)
        more = fit.fitted - one.fitted
        lead = ahead.log_likelihood - rules.parameter_penalty * max(more, 0)
        if lead < -rules.equal_log_likelihood or passed is None:
            continue
        if all(_earned_over(problem, fit, t.fit) for t in (a, b)):
            equal.append(fit)
            if lead > rules.heldout_log_likelihood:
                found.append(passed)
    set_starts(problem, begun)
    best = max(found, key=lambda pair: pair.score, default=None)
    return best, equal if best is None else []


def second_mass_instead(problem: Problem, nominal: Fit, one: Fit, candidate_effects: list[Candidate]) -> PairFit | None:
    """A part of the mass on a spring, and a delay or lag of the drive, in the place of the mode of the drive in `one`; None
    if they do no better.

    Such a mode is an effect of one place that does most of what the two do. Past it neither earns anything, and past a delay
    or a lag the second mass promises little until it begins where it was.
    """
    n, term = len(nominal.values), one.terms[0]
    second = next((c for c in candidate_effects if c.effect.as_mode and _of_same_mass(c, term.candidate)), None)
    if second is None or second.effect.as_mode is None or problem.budget.spent():
        return None
    mode = second.effect.as_mode(dict(zip((p.name for p in term.parameters), map(float, one.values[n:]), strict=True)))
    if mode is None:
        return None
    own, (begin, late_s) = term_of(problem, second, one), mode
    begun, found = get_starts(problem), []
    for candidate in candidate_effects:
        if candidate.effect.shifts != "time" or candidate.form or candidate.port.name != term.candidate.port.name:
            continue
        set_starts(problem, begun)
        terms = (term_of(problem, candidate, one), own)
        start = np.array([late_s, *(begin[p.name] for p in own.parameters)])
        fit = minimize(
            problem,
            terms,
            np.concatenate((one.values[:n], start)),
            rounds=problem.rules.further_iterations,
            tolerance=1e-4,
        )
        fit = finish(problem, begun_again(problem, fit))
        passed = _passed(problem, nominal, fit, get_starts(problem))
        ahead = problem.gain("both", one.residuals, fit.residuals).log_likelihood
        least = problem.rules.heldout_log_likelihood + problem.rules.parameter_penalty * max(fit.fitted - one.fitted, 0)
        if passed is None or not ahead > least:
            continue
        if all(_earned_over(problem, fit, _alone(problem, nominal, fit, which)) for which in (0, 1)):
            found.append(passed)
    set_starts(problem, begun)
    return max(found, key=lambda pair: pair.score, default=None)


def _of_same_mass(second: Candidate, mode: Candidate) -> bool:
    """Whether `second`, a second mass on an axis, may be what `mode` is taken for at the axis' drive."""
    same = second.effect.id == mode.effect.id and second.port.subsystem == mode.port.subsystem
    return same and second.port.name != mode.port.name


def pair_first(problem: Problem, nominal: Fit, trials: list[Trial], progress: Progress) -> PairFit | None:
    """The likeliest pair of unlike effects that were tried in the first step, one of them at a place along a loaded link;
    None if no pair passes.

    A gap behind friction is seen only together with it: another effect can be the best single one, and what is found past it
    hides the pair. Pairs of two places along the link are fitted first: the scores of single effects say little of them.
    The arguments are those of `pair_instead`.
    """
    tried = [
        (a, b)
        for a, b in itertools.combinations(trials, 2)
        if (a.candidate.port.within or b.candidate.port.within)
        and not (a.replaced or b.replaced or related(a.candidate, b.candidate) or related(b.candidate, a.candidate))
    ]
    tried.sort(key=lambda pair: (not all(t.candidate.port.within for t in pair), -sum(t.score for t in pair)))
    tried = tried[: problem.rules.first_pairs]
    begun, found = get_starts(problem), []
    for count, (a, b) in enumerate(tried):
        if problem.budget.spent():
            break
        progress(f"fitting {a.candidate.key} and {b.candidate.key}", count / len(tried))
        fit = _fitted_anew(problem, nominal, a, b)
        passed = _passed(problem, nominal, fit, get_starts(problem))
        if passed is not None and all(_earned_over(problem, fit, t.fit) for t in (a, b)):
            found.append(passed)
    set_starts(problem, begun)
    return max(found, key=lambda pair: pair.score, default=None)


def _singles(trials: list[Trial], most: int) -> list[Trial]:
    """The likeliest trial of each effect and port."""
    kept: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda trial: -trial.both.log_likelihood):
        kept.setdefault(f"{trial.candidate.effect.id}@{trial.candidate.port.name}", trial)
    return list(kept.values())[:most]


def _unlike(singles: list[Trial]) -> list[Trial]:
    """The likeliest of each family: finer shapes of one friction are one try."""
    kept: list[Trial] = []
    for trial in singles:
        if not any(related(trial.candidate, k.candidate) or related(k.candidate, trial.candidate) for k in kept):
            kept.append(trial)
    return kept


def _alone(problem: Problem, nominal: Fit, pair: Fit, which: int = 1) -> Fit:
    """One effect of `pair` without the other, fitted again."""
    begin = np.concatenate((pair.values[: len(nominal.values)], pair.values_of(pair.terms[which])))
    rounds = problem.rules.further_iterations
    return finish(problem, minimize(problem, (pair.terms[which],), begin, rounds=rounds, tolerance=1e-4))


def _fitted(problem: Problem, nominal: Fit, a: Trial, b: Trial) -> Fit:
    """Both effects together, from the nominal parameters of either."""
    n, rules = len(nominal.values), problem.rules
    own = [trial.fit.values[n:] for trial in (a, b)]
    terms: tuple[Term, ...] = (a.fit.terms[-1], b.fit.terms[-1])
    begins = [np.concatenate((trial.fit.values[:n], *own)) for trial in (a, b)]
    fits = [minimize(problem, terms, begin, rounds=rules.first_iterations, tolerance=1e-4) for begin in begins]
    fit = min(fits, key=lambda f: f.cost)
    return finish(problem, minimize(problem, terms, fit.values, rounds=rules.further_iterations, tolerance=1e-4))


def _fitted_anew(problem: Problem, nominal: Fit, a: Trial, b: Trial) -> Fit:
    """Both effects together, the memory of each started again: alone it began with something else than past the other."""
    set_starts(problem, [{**y, **x} for x, y in zip(a.starts, b.starts, strict=True)])
    fit = _fitted(problem, nominal, a, b)
    for which in (a, b):
        fit = restarted(problem, fit, which.candidate)
    return fit


def _earned_over(problem: Problem, fit: Fit, alone: Fit) -> bool:
    """Whether the pair gains enough over one of its effects `alone`, on samples to fit and on held-out ones, and none of
    the two is at a bound, or makes the law an active one.
    """
    if any(bound_by(fit, term) for term in fit.terms) or not problem.passive(fit):
        return False
    more = fit.fitted - alone.fitted
    held = problem.gain("heldout", alone.residuals, fit.residuals)
    trained = problem.gain("fit", alone.residuals, fit.residuals)
    both = problem.gain("both", alone.residuals, fit.residuals)
    rules = problem.rules
    shown = (
        held.log_likelihood >= rules.heldout_log_likelihood + rules.heldout_parameter_cost * more
        and trained.log_likelihood >= rules.heldout_log_likelihood + rules.parameter_penalty * more
    )
    plain = (  # as of a single effect: so likely that noise cannot be the cause, gained in both parts
        both.log_likelihood > rules.decisive_log_likelihood + rules.parameter_penalty * more
        and min(held.log_likelihood, trained.log_likelihood) > rules.weak_log_likelihood
    )
    return held.share >= rules.further_error_reduction and (
        (shown and held.p_value <= rules.significance) or _pooled(problem, held, both, more) or plain
    )


def _pooled(problem: Problem, held: Gain, both: Gain, more: int) -> bool:
    return problem.apart and sure_together(problem.rules, held, both, more)


def _passed(problem: Problem, nominal: Fit, fit: Fit, starts: list[dict[str, float]]) -> PairFit | None:
    """The pair that was fitted with `starts`; None if it does not pass what a single effect has to."""
    rules, more = problem.rules, fit.fitted - nominal.fitted
    held = problem.gain("heldout", nominal.residuals, fit.residuals)
    both = problem.gain("both", nominal.residuals, fit.residuals)
    least = max(rules.least_error_reduction, rules.least_excess_reduction * held.excess)
    sure = held.p_value < rules.significance or both.log_likelihood > rules.decisive_log_likelihood
    shown = sure and held.log_likelihood > rules.heldout_log_likelihood + rules.heldout_parameter_cost * more
    if not (held.share > least and (shown or _pooled(problem, held, both, more))):
        return None
    return PairFit(fit, both.log_likelihood - rules.parameter_penalty * more, held, starts)
