"""Backward moves: effects that no longer earn their place, that are not sure, or that a simpler shape replaces."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import Fit, Problem, Term, finish, get_starts, minimize, set_starts
from host.diagnosis.estimation.initial_state import begun_again
from host.diagnosis.estimation.uncertainty import intervals
from host.diagnosis.model.effect import Candidate
from host.diagnosis.selection.folds import unexcited
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.refits import fit_nominal, fit_without, refined, restarted
from host.diagnosis.selection.screening import term_of, without
from host.diagnosis.selection.trial import Trial, at_bound, contained, richer_gain, same_place, sure_together, vanished


def prune(problem: Problem, best: Fit, steps: list[Step]) -> Fit:
    """Backward: drop what no longer earns its place."""
    dropped, rules = True, problem.rules
    while dropped and len(best.terms) > 1:
        dropped = False
        for term in best.terms:
            begun = get_starts(problem)
            less, gain, held = _gained(problem, best, term)
            least = max(rules.least_error_reduction, rules.least_excess_reduction * gain.excess)
            price = rules.parameter_penalty * term.fitted
            few = gain.log_likelihood < rules.heldout_log_likelihood + price
            gone = vanished(best, term, rules)
            if held.log_likelihood < 0.0:
                held = unexcited(problem, less, best, term.fitted, held) or held
            small = gain.share < rules.removal_tolerance * least
            if gone or few or small or held.log_likelihood < 0.0:
                best, dropped = less, True
                steps.append(Step(SearchMove.BACKWARD, term.candidate.key, held))
                break
            set_starts(problem, begun)
    return best


def _gained(problem: Problem, fit: Fit, term: Term) -> tuple[Fit, Gain, Gain]:
    """`fit` without `term`, with the memories begun again, and what `term` gains on all samples and on those held out."""
    less = fit_without(problem, fit, (term.candidate.key,), begin_again=True)
    both, held = (problem.gain(which, less.residuals, fit.residuals) for which in ("both", "heldout"))
    return less, both, held


def reduce(problem: Problem, found: Found) -> None:
    """Each of several effects replaced by a simpler one that does nearly as well in its place.

    A richer shape may have entered because the simpler one needed another effect as well: a limit of speed that is never
    reached outdoes the lag that it contains by chance alone. What the richer one takes more has to be what a richer one
    has to take to be preferred where single effects are ranked (`rank`). An effect of another kind has to be likelier than
    the richer one, less the price of parameters. Of those that are as simple, the likeliest is taken.
    """
    for term in found.best.terms:
        if problem.budget.spent():
            return
        if not any(term is other for other in found.best.terms):
            continue  # it left with another of its name, which was reduced
        tried = _simpler(found, term, problem.rules.swap_fits)
        if not tried:
            continue
        begun, best = get_starts(problem), found.best
        less = fit_without(problem, best, (term.candidate.key,), nominal=found.nominal)
        earned = problem.gain("both", less.residuals, best.residuals)
        set_starts(problem, begun)
        for _, as_simple in itertools.groupby(tried, key=lambda trial: trial.fit.terms[-1].fitted):
            passed = [end for trial in as_simple if (end := _in_its_place(problem, best, term, trial, earned)) is not None]
            if passed:
                gains = [problem.gain("both", less.residuals, end.fit.residuals).log_likelihood for end in passed]
                taken = passed[int(np.argmax(gains))]
                ahead = problem.gain("both", taken.fit.residuals, best.residuals)
                found.steps.append(Step(SearchMove.REDUCE, taken.trial.candidate.key, ahead, [p.trial for p in passed]))
                found.best = taken.fit
                set_starts(problem, taken.starts)
                break


@dataclass(frozen=True)
class _Simpler:
    """A fit with the effect of `trial` in the place of a richer one, and its starts of memory."""

    trial: Trial
    fit: Fit
    starts: list[dict[str, float]]


def _in_its_place(problem: Problem, best: Fit, term: Term, trial: Trial, earned: Gain) -> _Simpler | None:
    """`best` with the simpler effect of `trial` in the place of `term`; None where it takes too little.

    earned: what `term` takes. Leaves the starts of memory as they are.
    """
    begun, simple = get_starts(problem), trial.fit.terms[-1]
    rest, values = without(best, problem, (term.candidate.key,))
    own = {p.name: float(value) for p, value in zip(term.parameters, best.values_of(term), strict=True)}
    alone = zip(simple.parameters, trial.fit.values_of(simple), strict=True)
    start = np.array([min(max(own.get(p.name, float(value)), p.low), p.high) for p, value in alone])
    begin = np.concatenate((values, start))
    other = minimize(problem, (*rest, simple), begin, rounds=problem.rules.further_iterations, tolerance=1e-4)
    other = restarted(problem, finish(problem, begun_again(problem, other)), simple.candidate)
    ahead = problem.gain("both", other.residuals, best.residuals)
    more = best.fitted - other.fitted
    shape = contained(trial.candidate, term.candidate)
    most = richer_gain(earned, more, problem.rules) if shape else problem.rules.parameter_penalty * more
    end = _Simpler(trial, other, get_starts(problem))
    set_starts(problem, begun)
    return end if ahead.log_likelihood < most and not at_bound(other) else None


def _simpler(found: Found, term: Term, others: int) -> list[Trial]:
    """Trials of effects with fewer parameters than `term`, at its place, each once, the simplest first: all shapes that it
    contains, and the likeliest `others`.
    """
    active = {t.candidate.key for t in found.best.terms}
    kept: dict[str, Trial] = {}
    for step in reversed(found.steps):
        for trial in step.trials:
            key, fewer = trial.candidate.key, trial.fit.terms[-1].fitted < term.fitted
            if fewer and same_place(trial.candidate, term.candidate) and key not in active and not trial.replaced:
                kept.setdefault(key, trial)
    shapes = [trial for trial in kept.values() if contained(trial.candidate, term.candidate)]
    rest = [trial for trial in kept.values() if not contained(trial.candidate, term.candidate)]
    rest.sort(key=lambda trial: -trial.both.log_likelihood)
    return sorted([*shapes, *rest[:others]], key=lambda trial: trial.fit.terms[-1].fitted)


def drop_unsure(problem: Problem, found: Found) -> None:
    """Drops effects whose only amplitude these recordings do not determine (`unsure`).

    The evidence counts independent samples. Where an effect was called for in some parts of the recordings only, or by a
    few, the jackknife of its interval shows that they do not agree on it.
    """
    while doubtful := unsure(problem, found.best):
        terms, values = without(found.best, problem, (doubtful[-1].candidate.key,))
        found.steps.append(Step(SearchMove.UNSURE, doubtful[-1].candidate.key))
        found.best = refined(problem, minimize(problem, terms, values)) if terms else fit_nominal(problem)


def unsure(problem: Problem, fit: Fit) -> list[Term]:
    """Terms whose amplitude these recordings do not determine: the interval of an effect of one parameter contains zero, and
    the other effects could do without it; or that of the only amplitude reaches both of its bounds, or its lower one and ten
    times its value.

    The latter is an effect that does what the nominal parameters do, such as a gain that changes where the motion ends; or a
    narrow band of noise, such as a load of 0 to 16500 times the drive's mass.
    """
    amplitudes = [(term, [k for k, p in enumerate(term.parameters) if p.linear]) for term in fit.terms]
    single = [(term, places[0]) for term, places in amplitudes if len(places) == 1]
    if not single:
        return []
    spans, found = intervals(problem, fit), []
    for term, place in single:
        index, p = fit.first_of(term) + place, term.parameters[place]
        (low, high), far = spans[index], problem.rules.undetermined_ratio * abs(float(fit.values[index]))
        if low <= p.low and min(p.high, far) <= high:
            found.append(term)
        elif low <= 0.0 <= high and len(term.parameters) == 1 and not _needed(problem, fit, term):
            found.append(term)
    return found


def _needed(problem: Problem, fit: Fit, term: Term) -> bool:
    """Whether all samples together, and those held out, are sure that `term` is needed next to the other effects.

    Two effects that are much alike share an amplitude, whose interval is wide; without one of them the error may be far
    larger all the same, in all parts of the recordings. The only effect has to be decisive in a recording that was not
    fitted: the scatter between halves of two recordings, which can make its interval seven times wider, is a poor measure.
    """
    only, rules = len(fit.terms) == 1, problem.rules
    if only and not problem.apart:
        return False
    begun = get_starts(problem)
    _, both, held = _gained(problem, fit, term)
    set_starts(problem, begun)
    decisive = held.log_likelihood > rules.decisive_log_likelihood and held.p_value < rules.significance
    return sure_together(rules, held, both, term.fitted) and (decisive or not only)


def drop_unsure_events(problem: Problem, found: Found, candidate_effects: list[Candidate]) -> None:
    """Takes events whose size has an interval that contains zero out of an effect of several, one after the other."""
    for _ in range(problem.rules.most_effects):
        fit, spans = found.best, intervals(problem, found.best) if found.best.terms else []
        for term in fit.terms:
            first, events = fit.first_of(term), _events(term)
            sizes = [k - 1 for k in events if len(events) > 1 and spans[first + k - 1][0] <= 0.0 <= spans[first + k - 1][1]]
            fewer = _with_events(problem, fit, term, candidate_effects, len(events) - 1) if sizes else None
            if fewer is not None:
                smallest = min(sizes, key=lambda k: abs(fit.values[first + k]))
                values = np.delete(fit.values, [first + smallest, first + smallest + 1])
                terms = tuple(fewer if other is term else other for other in fit.terms)
                found.steps.append(Step(SearchMove.UNSURE, term.candidate.key))
                found.best = refined(problem, minimize(problem, terms, values))
                break
        else:
            return


def _events(term: Term) -> list[int]:
    """Places of the instants among the parameters of a term; the size of each event is before its instant."""
    return [k for k, p in enumerate(term.parameters) if p.event]


def _with_events(problem: Problem, fit: Fit, term: Term, candidate_effects: list[Candidate], count: int) -> Term | None:
    """The effect of `term` at its port in the form that has `count` events; None where it has no such form."""
    own = term.candidate
    for candidate in candidate_effects:
        if (candidate.effect.id, candidate.port.name, candidate.source) == (own.effect.id, own.port.name, own.source):
            other = term_of(problem, candidate, fit)
            if len(_events(other)) == count:
                return other
    return None
