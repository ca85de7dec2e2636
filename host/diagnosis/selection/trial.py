"""A candidate fitted in full, and what it has to show to earn a place: likelihood, blocks, size, and no bound reached."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import Gain
from host.diagnosis.estimation.fit import LARGEST_AMPLITUDE, Fit, Problem, Term, size_of
from host.diagnosis.estimation.rules import RULES, SelectionRules
from host.diagnosis.model.effect import Candidate, Parameter, same_place

Array = npt.NDArray[np.float64]


@dataclass
class Trial:
    """A candidate fitted in full, with its gains over the structure it was added to."""

    candidate: Candidate
    fit: Fit
    heldout: Gain
    trained: Gain
    both: Gain  # on all samples, fitted and held out
    score: float
    starts: list[dict[str, float]] = field(default_factory=list)
    replaced: bool = False
    period_s: float = 0.0
    rules: SelectionRules = RULES
    apart: bool = True  # whether whole recordings are held out, not blocks between the fitted ones
    seldom: bool = False  # whether a sensor is read more seldom than it is logged
    cancelled: float = 0.0  # share of the residual's variance that is noise which the effect could cancel
    passive: bool = True  # whether no mass, damper or spring of the law is below zero
    crossed: Gain | None = None  # of all recordings, each predicted from the others, where those held out show nothing


def at_bound(fit: Fit) -> bool:
    """Whether the last term ended at a bound that is not a natural one: its shape is then not what it stands for."""
    return bound_by(fit, fit.terms[-1])


def bound_by(fit: Fit, term: Term) -> bool:
    """As `at_bound`, of any of its terms; friction whose parts have both signs has left what is physical too."""
    values = fit.values_of(term)
    if _drives(term, values):
        return True
    natural = term.candidate.effect.natural_bounds
    return any(reached(p, float(value), natural) for p, value in zip(term.parameters, values, strict=True))


def reached(p: Parameter, value: float, natural: bool) -> bool:
    """Whether `value` is at a bound of `p` that is not a natural one. natural: whether the effect's bounds are.

    An amplitude a thousand times its natural size has run away: fits do not go further.
    """
    if p.high <= p.low:
        return False
    if p.linear and abs(value) >= 0.999 * LARGEST_AMPLITUDE * size_of(p, 0.0):
        return True
    low = np.isfinite(p.low) and p.low != 0.0 and value <= p.low * (1.001 if p.low > 0 else 0.999)
    high = np.isfinite(p.high) and value >= p.high - 1e-3 * abs(p.high)
    return bool((low and not p.vanishes and not natural) or (high and (p.shape or not natural)))


def _drives(term: Term, values: Array) -> bool:
    """Whether a friction's linear parts have both signs: at some speed it would push along with the motion.

    Where an output may count a force either way, their bounds allow both signs, but only to all of them alike.
    """
    parts = [float(value) for p, value in zip(term.parameters, values, strict=True) if p.linear]
    return term.candidate.effect.dissipates and len(parts) > 1 and min(parts) < 0.0 < max(parts)


def vanished(fit: Fit, term: Term, rules: SelectionRules) -> bool:
    """Whether the amounts of `term`, which cannot be negative, went to zero: only its initial state remains.

    A mode that takes part with no share of the motion can still ring down from the first sample on. What it then explains
    is an initial state that the nominal model lacks. The same holds of a memory without linear parameters (a delay, a gap)
    if all of its parameters that may be zero are.
    """
    linear = any(p.linear for p in term.parameters)
    if not linear and not term.candidate.effect.remembers:
        return False
    own = [(p, float(value)) for p, value in zip(term.parameters, fit.values_of(term), strict=True) if p.linear == linear]
    amounts = [(p, value) for p, value in own if p.low == 0.0 or p.dead_time]
    alone = len(amounts) == len(own) or not linear
    return bool(amounts) and alone and all(abs(v) < rules.least_amount * min(map(abs, p.grid)) for p, v in amounts)


def rank(problem: Problem, trials: list[Trial], base: Fit) -> None:
    """Sorts trials by their likelihood on all samples, with one effective sample size for all, that of the trial with
    the least error. Of trials that are one equation under several ids, the effect that comes first in its order is first.
    """
    if not trials:
        return
    rules = trials[0].rules
    common = _scored(trials, [trial.both for trial in trials], base)
    trials.sort(key=lambda trial: trial.score, reverse=True)
    _compare_on_common_samples(problem, trials, base)
    least = rules.same_equation_log_likelihood
    alike = [trial for trial in trials if trials[0].score - trial.score < least and trial.fit.fitted == trials[0].fit.fitted]
    top = min(alike, key=lambda trial: trial.candidate.effect.order)
    trials.remove(top)
    trials.insert(0, top)
    coarse = 0.5 * float(
        common @ (-np.log(1.0 - rules.refinement_error_reduction * np.minimum(1.0, 2.0 * top.both.excesses)))
    )
    near = top.score - max(
        rules.heldout_log_likelihood,
        rules.refinement_tolerance * top.score,
        min(coarse, rules.refinement_score_share * top.score),
    )
    # A form whose further parameters ended at zero is the form without them, which may have begun a fit less luckily.
    same, much = top.fit.fitted - _zeros(top.fit), (1.0 - rules.reduced_form_tolerance) * top.score
    simpler = [
        t
        for t in trials
        if t.fit.fitted < top.fit.fitted
        and (t.score > near or (t.fit.fitted <= same and t.candidate.name == top.candidate.name and t.score > much))
        and related(t.candidate, top.candidate)
    ]
    if simpler:
        best = max(simpler, key=lambda t: (-t.fit.fitted, t.score))
        trials.remove(best)
        trials.insert(0, best)


def _scored(trials: list[Trial], gains: list[Gain], base: Fit) -> Array:
    """Effective sample sizes (outputs,) of the gain that leaves least; the scores of `trials` are set with them."""
    most = np.max([gain.independent for gain in gains], axis=0)
    common = max(gains, key=lambda gain: float(most @ gain.log_ratio)).independent
    for trial, gain in zip(trials, gains, strict=True):
        more = max(trial.fit.fitted - base.fitted, 0)
        trial.score = 0.5 * float(common @ gain.log_ratio) - trial.rules.parameter_penalty * more
    return common


def _compare_on_common_samples(problem: Problem, trials: list[Trial], base: Fit) -> None:
    """Score the first of sorted trials again, and sort them, where a dead time of one hides samples that others predict.

    A lag would else be credited with the first samples of a recording, of which a delay says nothing.
    """
    least = (1.0 - problem.rules.reduced_form_tolerance) * trials[0].score
    first = [trial for trial in trials if trial.score > least]
    fits = [base, *(trial.fit for trial in first)]
    seen = [np.all([np.isfinite(r) for r in rows], axis=0) for rows in zip(*(fit.residuals for fit in fits), strict=True)]
    if all(np.array_equal(mask, np.isfinite(r)) for fit in fits for mask, r in zip(seen, fit.residuals, strict=True)):
        return
    before = [np.where(mask, r, np.nan) for mask, r in zip(seen, base.residuals, strict=True)]
    gains = [problem.gain("both", before, trial.fit.residuals) for trial in first]
    _scored(first, gains, base)
    first.sort(key=lambda trial: trial.score, reverse=True)
    trials[: len(first)] = first


def richer_gain(earned: Gain, more: int, rules: SelectionRules) -> float:
    """Log-likelihood by which a richer shape has to outdo a simpler one, as in `rank`.

    earned: gain of the richer one over neither; more: number of its further parameters.
    """
    score = earned.log_likelihood
    left = np.log(1.0 - rules.refinement_error_reduction * np.minimum(1.0, 2.0 * earned.excesses))
    coarse = 0.5 * float(earned.independent @ -left)
    coarse = min(coarse, rules.refinement_score_share * score)
    least = max(rules.heldout_log_likelihood, rules.refinement_tolerance * score, coarse)
    return least + rules.parameter_penalty * more


def _zeros(fit: Fit) -> int:
    """Number of parameters of the last effect that ended at a lower bound of zero."""
    term = fit.terms[-1]
    own = zip(term.parameters, fit.values_of(term), strict=True)
    return sum(p.low == 0.0 and value <= 1e-9 * max(map(abs, p.grid)) for p, value in own)


def of_sampling(trial: Trial) -> bool:
    """Whether a delay or lag of an axis' input, all of a drifting one, may be how the input was held between samples or
    recorded, which is not physics: it is within a sample, and no time between those that this could take. So is each lead.

    An input that is held where it should run straight is half a sample late, one that is recorded after its sample a whole
    one, and an integrator of a few steps in a sample a small part of one, or as early as that. A sensor that is read more
    seldom than it is logged adds any part of a sample. A delay d that gains the log-likelihood L over none has about the
    standard deviation d / sqrt(2 L), since L is a parabola in d.
    """
    shift, rules = trial.candidate.effect.shifts, trial.rules
    if leads(trial):
        return True
    if not shift or not trial.candidate.port.held:
        return False
    longest_s = max(r.shape[1] for r in trial.fit.residuals) * trial.period_s
    term = trial.fit.terms[-1]
    own = zip(term.parameters, trial.fit.values_of(term), strict=True)
    late_s = sum(abs(float(value)) * (longest_s if p.unit == "s/s" else 1.0) for p, value in own if p.unit in ("s", "s/s"))
    late = late_s / trial.period_s
    if late > rules.sampling_delay or trial.seldom:
        return late <= rules.sampling_delay
    spread = late / math.sqrt(2.0 * max(trial.both.log_likelihood, 0.5))
    margin = max(rules.sampling_delay_margin, rules.sampling_delay_deviations * spread)
    return late < rules.integrator_delay + margin or min(abs(late - 0.5), abs(late - 1.0)) < margin


def leads(trial: Trial) -> bool:
    """Whether the effect of a trial is a delay below zero."""
    return lead_of(trial) > 0.0


def lead_of(trial: Trial) -> float:
    """Time (s) by which a trial says that the recordings are ahead of the nominal model; 0 where it is not a delay."""
    term = trial.fit.terms[-1]
    own = zip(term.parameters, trial.fit.values_of(term), strict=True)
    return max((-float(value) for p, value in own if p.dead_time), default=0.0)


def within_sample(trials: list[Trial], base: Fit) -> Trial | None:
    """The likeliest of the simplest delays and lags within one sample that the data call for beyond `base`."""
    late = [trial for trial in trials if of_sampling(trial) and called_for(trial, base)]
    return max(late, key=lambda trial: (-trial.fit.fitted, trial.score), default=None)


def only_sampling(trial: Trial, trials: list[Trial]) -> bool:
    """Whether a delay within one sample does as well at the place of `trial`: how an input was held, under another name.

    At another place of the same subsystem another shift has to do better: what it leaves to that place is less than noise.
    """
    own, rules = trial.candidate.port, trial.rules
    for other in trials:
        port = other.candidate.port
        same = port.name == own.name or other.candidate.effect.id == trial.candidate.effect.id
        least = trial.score - (rules.heldout_log_likelihood if same else 0.0)
        if of_sampling(other) and port.subsystem == own.subsystem and other.score > least:
            return True
    return False


def related(simple: Candidate, general: Candidate) -> bool:
    """Whether `general` is a finer shape of `simple`, at the same place."""
    a, b = simple.effect, general.effect
    return same_place(simple, general) and (a.id == b.id or a.id in b.contains or bool(a.family and a.family == b.family))


def contained(simple: Candidate, general: Candidate) -> bool:
    """Whether `simple` is a shape that the effect `general` contains, at the same place."""
    return simple.effect.id in general.effect.contains and related(simple, general)


def wider(general: Candidate, bounded: Candidate) -> bool:
    """Whether `general` may fit where `bounded` ended at a bound of its form: another form of it, or one that holds it."""
    a, b = bounded.effect, general.effect
    if bounded.port.name != general.port.name or bounded.key == general.key:
        return False
    return (
        a.id in b.contains or a.id == b.id or bool(a.family and a.family == b.family) or bool({*a.spans} & {b.id, *b.spans})
    )


def good_enough(trial: Trial, base: Fit) -> bool:
    """Whether a trial earns its place: likelihood, blocks, size, and agreement of fitted and held-out parts.

    Held-out samples alone are enough; where they show it dimly, because their excitation hardly calls for it, all
    samples together have to be surer by far. Blocks held out between the fitted ones have the same excitation: no excuse.
    """
    gone = vanished(trial.fit, trial.fit.terms[-1], trial.rules)
    return trial.passive and not gone and not at_bound(trial.fit) and not of_sampling(trial) and called_for(trial, base)


def of_noise(trial: Trial) -> bool:
    """Whether all that a trial takes may be noise of measured inputs, which a law with memory cancels."""
    return trial.both.share < trial.rules.noise_passed_margin * trial.cancelled


def called_for(trial: Trial, base: Fit) -> bool:
    """Whether the evidence of a trial is enough, wherever its parameters ended."""
    if refuted(trial.heldout, trial.rules) or of_noise(trial):
        return False
    more = max(trial.fit.fitted - base.fitted, 0)
    if trial.crossed is not None and _across(trial, trial.crossed, more):
        return True
    return _alone(trial, more) or (trial.apart and _together(trial, more)) or _plainly(trial, more)


def refuted(heldout: Gain, rules: SelectionRules) -> bool:
    """Whether the error on held-out samples grows by as much as an effect has to take: not if they just do not excite it.

    The likelihood is that of the error without what a controller fed back (`compare`). An effect that lowers it can raise
    the whole error: it explains the remainder, which may be small, and makes the other residual larger.
    """
    return heldout.share < -rules.least_error_reduction


def _across(trial: Trial, crossed: Gain, more: int) -> bool:
    """Whether recordings that are predicted from one another call for it: no sample was fitted to what it judges."""
    rules = trial.rules
    gained = crossed.log_likelihood - rules.heldout_parameter_cost * more
    agreed = gained > rules.pooled_log_likelihood and crossed.p_value < rules.weak_significance
    return crossed.share > _least(trial, crossed) and (agreed or gained > rules.decisive_log_likelihood)


def _alone(trial: Trial, more: int) -> bool:
    gain, rules = trial.heldout, trial.rules
    return (
        gain.log_likelihood > rules.heldout_log_likelihood + rules.heldout_parameter_cost * more
        and gain.p_value < rules.significance
        and gain.share > _least(trial, gain)
        and trial.trained.log_likelihood > rules.heldout_log_likelihood + rules.parameter_penalty * more
    )


def _together(trial: Trial, more: int) -> bool:
    enough = trial.both.share > _least(trial, trial.both)
    return enough and sure_together(trial.rules, trial.heldout, trial.both, more)


def sure_together(rules: SelectionRules, heldout: Gain, both: Gain, more: int) -> bool:
    """Whether all samples together are sure where held-out ones are few. more: number of further parameters."""
    return (
        both.log_likelihood > rules.pooled_log_likelihood + rules.parameter_penalty * more
        and both.p_value < rules.pooled_significance
        and heldout.log_likelihood > rules.weak_log_likelihood
        and heldout.p_value < rules.weak_significance
    )


def _plainly(trial: Trial, more: int) -> bool:
    """Likelihood so large that noise cannot be its cause, gained in both parts, in however few episodes."""
    rules = trial.rules
    return (
        trial.both.log_likelihood > rules.decisive_log_likelihood + rules.parameter_penalty * more
        and trial.both.share > _least(trial, trial.both)
        and trial.heldout.log_likelihood > rules.weak_log_likelihood
        and trial.trained.log_likelihood > rules.weak_log_likelihood
    )


def weighty(trial: Trial, earned: float) -> bool:
    """Whether a trial earns enough relative to the likelihood of what is named already; a finer shape is judged alone."""
    rules = trial.rules
    parts = (trial.heldout, trial.trained)
    large = all(
        part.share > rules.large_error_reduction and part.log_likelihood > rules.large_log_likelihood for part in parts
    )
    enough = trial.both.share > rules.further_error_reduction and (
        large or trial.both.log_likelihood > rules.further_likelihood_ratio * earned
    )
    return trial.replaced or earned == 0.0 or enough


def _least(trial: Trial, gain: Gain) -> float:
    rules = trial.rules
    return max(
        rules.least_error_reduction,
        (rules.refinement_error_reduction if trial.replaced else rules.least_excess_reduction) * gain.excess,
    )
