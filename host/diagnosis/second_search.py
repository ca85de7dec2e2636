"""Second searches, with one more nominal parameter than the file has: a value that it holds, a delay within one sample.

What is wrong about the nominal model itself hides what is missing from it, or is taken for an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from host.diagnosis.estimation.fit import Fit, Problem, get_starts, minimize, set_starts
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.effect import Candidate
from host.diagnosis.model.nominal import EffectSpec, NominalSpec
from host.diagnosis.model.readings import Finding
from host.diagnosis.problems import problems
from host.diagnosis.selection.equivalence import mismatch_removed
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.held_values import FARTHEST, Freed, HeldValue, contradicted, held_values, promising, with_free
from host.diagnosis.selection.refits import fit_nominal, fit_without, refined
from host.diagnosis.selection.sampling import late_by_a_sample
from host.diagnosis.selection.screening import above_noise
from host.diagnosis.selection.search import search
from host.diagnosis.selection.trial import Trial, lead_of, within_sample

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Searched:
    """What was searched, and what was found in it."""

    problem: Problem
    full: Problem
    found: Found
    findings: list[Finding]  # what was found about the data on the way
    freed: Freed | None = None

    def contradicted(self, spans: Sequence[tuple[float, float]]) -> list[Finding]:
        """Return what says which held values the recordings contradict. spans: intervals of all parameters."""
        return [] if self.freed is None else contradicted(self.problem, self.found, spans, self.freed)


@dataclass(frozen=True)
class Again:
    """What a second search starts from: the nominal model and recordings of the first one, its effects, its progress."""

    spec: NominalSpec
    recordings: list[Recording]
    candidates: list[Candidate]
    progress: Progress


def past_sampling(again: Again, begun: Searched) -> Searched:
    """What a second search finds, with a delay within one sample among the nominal parameters, where the data call for one.

    Such a delay is not named, because it may be a matter of the recording. It still hides what else is missing.
    """
    late = within_sample(begun.found.last_trials, begun.found.best)
    if late is None or (lead_of(late) > 0.0 and _is_remainder(begun, late)):
        return _with_delay_first(again, begun)
    if not begun.problem.budget.spent():
        past = _past_delay(again, late, begun)
        if past is not None:
            return past
    if begun.found.best.terms:
        return begun
    return replace(begun, findings=[*begun.findings, *late_by_a_sample(begun.problem, late)])


def _is_remainder(begun: Searched, lead: Trial) -> bool:
    """Whether a lead beyond named effects removes no more than what their inexact formulas may leave.

    A force of friction that is not exactly of its formula is ahead of the place, too. A lead that is more removes half of
    the squared error, as a clock has to, or a partial share of the mismatch.
    """
    found, rules = begun.found, begun.problem.rules
    if not found.best.terms or lead.both.share > 1.0 - rules.data.clock_residual_ratio:
        return False
    return mismatch_removed(begun.problem, found.nominal, found.best, lead.fit) < rules.partial_share


def _with_delay_first(again: Again, begun: Searched) -> Searched:
    """What a search finds past a delay within one sample that alone did nearly as well as the first effect, if likelier.

    An effect can stand in for such a delay together with what else is missing. Once it is named, nothing calls for the
    delay any more.
    """
    found, rules = begun.found, begun.problem.rules
    first = found.steps[0] if found.best.terms and found.steps else None
    late = within_sample(first.trials, found.nominal) if first is not None else None
    if first is None or late is None or begun.problem.budget.spent():
        return begun
    if late.score < rules.alternative_start_score * first.trials[0].score:
        return begun
    past = _past_delay(again, late, begun)
    if past is None:
        return begun
    ahead = begun.problem.gain("both", found.best.residuals, past.found.best.residuals).log_likelihood
    more = past.found.best.fitted + late.fit.fitted - found.best.fitted  # the delay is a parameter, too
    return past if ahead > rules.heldout_log_likelihood + rules.parameter_penalty * more else begun


def _past_delay(again: Again, late: Trial, begun: Searched) -> Searched | None:
    """The search with the delay of `late` among the nominal parameters; None if that names nothing better.

    What is named may be no shape of the delay: its gain has to be that of a further effect, it is not a linear effect at the
    place of the delay, and the delay stays within the sample.
    """
    candidate, term, problem = late.candidate, late.fit.terms[-1], begun.problem
    values = {p.key: float(value) for p, value in zip(term.parameters, late.fit.values_of(term), strict=True)}
    known = EffectSpec(
        id=candidate.effect.id, at=candidate.port.name, values=values, source=candidate.source, form=candidate.form
    )
    extended = again.spec.model_copy(update={"effect": [*again.spec.effect, known]})
    second, full = _problems_of(extended, again, begun)
    place = {*candidate.port.path, candidate.port.name}
    others = [c for c in again.candidates if not (c.effect.shifts and (c.port.held or c.port.name in place))]
    found = search(second, others, again.progress, late.both.log_likelihood)
    own = [t for t in found.best.terms if not (t.candidate.effect.invariant and t.candidate.port.name in place)]
    delay_s = found.best.values[len(problem.model.parameters) : len(second.model.parameters)]
    late_s = float(np.max(delay_s, initial=0.0))
    if not own or late_s > problem.rules.sampling_delay * problem.segments[0].recording.dt_s:
        return None
    before, rules = late.fit.residuals, problem.rules
    ahead = problem.gain("both", before, found.best.residuals).log_likelihood
    earned = problem.gain("both", begun.found.nominal.residuals, before).log_likelihood
    if ahead < -max(rules.heldout_log_likelihood, rules.refinement_tolerance * earned):
        return None
    said = [*begun.findings, *late_by_a_sample(second, late, past=True)]
    return replace(begun, problem=second, full=full, found=found, findings=said)


def _problems_of(spec: NominalSpec, again: Again, begun: Searched) -> tuple[Problem, Problem]:
    """The problems of an extended nominal model, at the rate that is fitted and at the full one; all else as in `begun`."""
    problem = begun.problem
    model, second, full = problems(spec, again.recordings, problem.rules)
    second.budget, second.joint_states = problem.budget, problem.joint_states
    for each in (second, full) if model.holds else ():
        model.hold_as(each.segments, problem.model.hold)
    return second, full


def past_held_values(again: Again, begun: Searched) -> tuple[Again, Searched]:
    """What a second search finds with held values among the parameters to fit, and from where a further one would start.

    A held value that is wrong leaves a mismatch, and some effect is nearly its shape: a mass that is too small leaves what a
    second mass on a stiff spring would. The fitted value is taken where it explains nearly as much, with fewer parameters
    than the effects of the first search, or plainly more. A vocabulary's effect that says the same stays.
    """
    problem, found, rules = begun.problem, begun.found, begun.problem.rules
    held = held_values(again.spec, problem)
    if not held or problem.budget.spent():
        return again, begun
    freed = _without_effects(again, begun, held)
    if found.best.terms and not freed:
        freed = _next_to_effects(again, begun, held)
    if not freed and above_noise(problem, found.best, rules.noise_uncertainty):
        freed = [each for each in promising(problem, found.best, held, 1) if _gains(again, begun, each)]
    if not freed or problem.budget.spent():
        return again, begun
    extended = with_free(again.spec, freed)
    second, full = _problems_of(extended, again, begun)
    other = search(second, again.candidates, again.progress)
    if not _likelier(begun, other.best, freed) or not _plausible(extended, second, other.best, freed):
        return again, begun
    held_at = tuple(float(found.nominal.values[index]) for each in freed for index in each.indices)
    said = Freed(tuple(freed), held_at, found.nominal.residuals)
    return replace(again, spec=extended), replace(begun, problem=second, full=full, found=other, freed=said)


def _without_effects(again: Again, begun: Searched, held: Sequence[HeldValue]) -> list[HeldValue]:
    """Held values that each earn a place when fitted; empty if all together do plainly less than the best effect."""
    problem, rules, freed = begun.problem, begun.problem.rules, list[HeldValue]()
    now, best, score = problem, begun.found.nominal, 0.0
    while len(freed) < len(held) and not problem.budget.spent():
        left = [each for each in held if each not in freed]
        trials = []
        for each in promising(now, best, left, rules.held_values_tried):
            spec = with_free(again.spec, [*freed, each])
            second, _ = _problems_of(spec, again, begun)
            fit = fit_nominal(second)
            gain = problem.gain("both", best.residuals, fit.residuals)
            earned = gain.log_likelihood - rules.parameter_penalty * len(each.indices)
            if gain.p_value < rules.significance and _plausible(spec, second, fit, [each]) and not _said(begun, fit, each):
                trials.append((earned, each, second, fit))
        if not trials:
            break
        earned, each, now, fit = max(trials, key=lambda trial: trial[0])
        if earned < rules.pooled_log_likelihood:
            break
        freed, best, score = [*freed, each], fit, score + earned
    first = begun.found.steps[0].trials if begun.found.best.terms and begun.found.steps else []
    enough = rules.alternative_start_score * max((trial.score for trial in first), default=0.0)
    return freed if score >= enough else []


def _next_to(second: Problem, base: Fit, starts: list[dict[str, float]]) -> Fit:
    """`base` fitted again in `second`, which fits a held value, from the same starts of memory."""
    set_starts(second, starts)
    return refined(second, minimize(second, base.terms, base.values))


def _gains(again: Again, begun: Searched, each: HeldValue) -> bool:
    """Whether fitting a held value next to all that was found takes enough from what they leave to search again."""
    problem, best = begun.problem, begun.found.best
    second, _ = _problems_of(with_free(again.spec, [each]), again, begun)
    fit_nominal(second)
    fit = _next_to(second, best, get_starts(problem))
    gain = problem.gain("both", best.residuals, fit.residuals)
    return gain.log_likelihood > problem.rules.pooled_log_likelihood and gain.p_value < problem.rules.significance


def _said(begun: Searched, fit: Fit, freed: HeldValue) -> bool:
    """Whether a single effect with as few parameters explains as much as `fit`: the search has judged it already."""
    problem, rules = begun.problem, begun.problem.rules
    first = begun.found.steps[0].trials if begun.found.steps else []
    alike = [trial.fit for trial in first if trial.fit.fitted <= len(freed.indices)]
    return any(problem.gain("both", a.residuals, fit.residuals).log_likelihood < rules.heldout_log_likelihood for a in alike)


def _next_to_effects(again: Again, begun: Searched, held: Sequence[HeldValue]) -> list[HeldValue]:
    """The held value that is worth its place next to effects: all that were found, those without one, or one tried first.

    Together with another missing effect, a wrong value may look like a third one.
    """
    problem, found, rules = begun.problem, begun.found, begun.problem.rules
    before = get_starts(problem)
    bases = [(found.best, before)]
    if len(found.best.terms) > 1:
        bases += [(fit_without(problem, found.best, (term.candidate.key,)), before) for term in found.best.terms]
    first = found.steps[0].trials if found.steps else []
    bases += [(trial.fit, trial.starts) for trial in first[: rules.joint_first]]
    freed = dict[str, tuple[NominalSpec, Problem]]()
    for base, starts in bases:
        set_starts(problem, starts)
        for each in promising(problem, base, held, 1):
            if problem.budget.spent():
                break
            if each.name not in freed:
                spec = with_free(again.spec, [each])
                freed[each.name] = spec, _problems_of(spec, again, begun)[0]
                fit_nominal(freed[each.name][1])
            spec, second = freed[each.name]
            fit = _next_to(second, base, starts)
            if _likelier(begun, fit, [each]) and _plausible(spec, second, fit, [each]):
                set_starts(problem, before)
                return [each]
    set_starts(problem, before)
    return []


def _likelier(begun: Searched, fit: Fit, freed: Sequence[HeldValue]) -> bool:
    """Whether `fit`, with `freed` fitted, explains nearly what was found by fewer parameters and causes, or plainly more.

    A wrong value next to an effect is two causes: a load at the end of an arm is one, with more parameters. Plainly: by as
    much as an effect has to be likelier, and either by a part of the mismatch that no inexact formula leaves, or down to the
    noise.
    """
    problem, found, rules = begun.problem, begun.found, begun.problem.rules
    more = fit.fitted + sum(len(each.indices) for each in freed) - found.best.fitted
    ahead = problem.gain("both", found.best.residuals, fit.residuals).log_likelihood - rules.parameter_penalty * more
    if more >= 0 or len(fit.terms) + len(freed) > len(found.best.terms):
        removed = mismatch_removed(problem, found.nominal, found.best, fit)
        before, after = (above_noise(problem, each, rules.noise_uncertainty) for each in (found.best, fit))
        return ahead > rules.pooled_log_likelihood and (removed > rules.partial_share or (before and not after))
    earned = problem.gain("both", found.nominal.residuals, found.best.residuals).log_likelihood
    return ahead > -max(rules.heldout_log_likelihood, rules.refinement_tolerance * earned)


def _plausible(spec: NominalSpec, problem: Problem, fit: Fit, freed: Sequence[HeldValue]) -> bool:
    """Whether each fitted value is within its bounds, and a parameter of the model within two decades of what was held."""
    parameters = problem.model.parameters
    for each in freed:
        for index in each.indices:
            p, value = parameters[index], float(fit.values[index])
            if not p.low < value < p.high:
                return False
            if each.effect is None and not 1.0 / FARTHEST < value / spec.parameters[each.name].value < FARTHEST:
                return False
    return True
