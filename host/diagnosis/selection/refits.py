"""Refits of a structure: the nominal model, one more effect, one less, and the memories that recordings begin with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.feedback import find_feedback
from host.diagnosis.estimation.fit import (
    RAN_AWAY,
    Fit,
    Problem,
    finish,
    first_needs,
    get_starts,
    minimize,
    reweigh,
    set_starts,
)
from host.diagnosis.estimation.initial_state import STATE_STEPS, begun_again, fit_with_states, start_again
from host.diagnosis.estimation.instants import placed
from host.diagnosis.model.effect import Candidate, rate_key
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.screening import Screened, enough, without
from host.diagnosis.selection.trial import Trial

Array = npt.NDArray[np.float64]


def fit_nominal(problem: Problem) -> Fit:
    """Nominal parameters refitted on all samples to fit; sets the weights of outputs and the start of memories.

    A model that takes a measured output as an input too (`settle`) has it freed of noise before each fit, with what it
    simulates itself: errors in a variable that the fit takes for exact would bend its parameters.
    """
    fit = Fit((), _first_values(problem))
    for _ in range(3):
        settle(problem, fit.values)
        reweigh(problem, fit)
        fit = minimize(problem, (), fit.values, states=True)
    fit = settled(problem, begun_again(problem, fit))
    fed = find_feedback(problem.segments, fit.residuals, problem.model.quiet_inputs, problem.rules)
    problem.noise_fed = fed and _over_own_noise(problem, fit) < problem.rules.residual_over_noise_nominal**2
    problem.passed = _of_inputs(problem, fit)
    problem.noise_passed = problem.passed_share(fit)
    return fit


def _first_values(problem: Problem) -> Array:
    """Nominal values to fit from: the model's guess, or the best of its restarts where the guess leaves more than no motion
    at all would.

    The guess is linear. Where noise or drop-outs make a mass negative there, its default takes its place, and the simulation
    may run away.
    """
    model, guess = problem.model, problem.model.guess(problem.segments)
    fitted = [segment for segment in problem.segments if segment.fit.any()]

    def left(values: Array) -> float:
        total = 0.0
        for segment in fitted:
            r = np.clip(problem.left(segment, (), values)[:, segment.fit], -RAN_AWAY, RAN_AWAY)
            spread = np.nanvar(segment.y[:, segment.fit], axis=1, keepdims=True)
            total += float(np.nansum(r**2 / np.maximum(spread, 1e-300)))
        return total

    samples = sum(int(np.isfinite(segment.y[:, segment.fit]).sum()) for segment in fitted)
    if left(guess) <= samples:
        return guess
    return min([guess, *model.restarts(fitted)], key=left)


def settled(problem: Problem, fit: Fit) -> Fit:
    """A nominal fit with its residuals; outputs weighted by it, and initial states estimated from it."""
    settle(problem, fit.values)
    reweigh(problem, fit)
    finish(problem, fit)
    set_starts(problem, first_needs(problem, fit))
    return fit


def settle(problem: Problem, values: Array) -> None:
    """Lets a model that needs it prepare its recordings for these nominal parameters."""
    for segment in problem.segments:
        problem.model.settle(segment, values)
    start_again(problem, Fit((), values))


def refined(problem: Problem, fit: Fit) -> Fit:
    """`fit` brought to its end on all samples, together with the states that recordings begin from."""
    fit = begun_again(problem, fit)
    for _ in range(2 if any(segment.begin is not None for segment in problem.segments) else 1):
        start_again(problem, fit)
        fit = minimize(problem, fit.terms, fit.values, states=not problem.joint_states)
    if not problem.joint_states:
        start_again(problem, fit)
    return placed(problem, finish(problem, fit))


def fit_without(
    problem: Problem,
    fit: Fit,
    keys: tuple[str, ...],
    *,
    nominal: Fit | None = None,
    rounds: int = 8,
    tolerance: float = 1e-4,
    begin_again: bool = False,
) -> Fit:
    """`fit` without the effects of these `keys`: what remains is fitted again from its values.

    nominal: returned instead where no effect remains. rounds, tolerance: of `minimize`. begin_again: whether a model that is
    a linear path is also given initial states of its own.
    """
    terms, values = without(fit, problem, keys)
    if not terms and nominal is not None:
        return nominal
    less = minimize(problem, terms, values, rounds=rounds, tolerance=tolerance)
    return finish(problem, begun_again(problem, less) if begin_again else less)


def _of_inputs(problem: Problem, fit: Fit) -> Array:
    """Variance (outputs,) that noise of measured inputs makes of the outputs through the nominal law."""
    samples, passed = np.zeros(len(problem.noise)), np.zeros(len(problem.noise))
    for segment, r in zip(problem.segments, fit.residuals, strict=True):
        seen = np.sum(np.isfinite(r), axis=1)
        samples, passed = samples + seen, passed + seen * problem.model.noise_of_inputs(segment, fit.values) ** 2
    return np.asarray(passed / np.maximum(samples, 1.0))


def _over_own_noise(problem: Problem, fit: Fit) -> float:
    """Squared residual of a fit over that of the noise which the model's own differences make, in all recordings together;
    infinite for a model that makes no differences.
    """
    ratios = []
    for segment, residual in zip(problem.segments, fit.residuals, strict=True):
        noise = problem.model.noise_of(segment)
        if noise is not None:
            ratios.append(float(np.nanmean(residual**2)) / noise.sigma**2)
    return float(np.mean(ratios)) if ratios else np.inf


def _cancellable(problem: Problem, base: Fit) -> float:
    """Share of what `base` leaves that is noise which a linear law with memory can cancel.

    A law that amplifies what is fast in a force makes noise of the differences smaller. Where nothing but noise is left, all
    that it takes may be that.
    """
    return 1.0 if _over_own_noise(problem, base) < 1.0 else problem.passed_share(base)


def try_fit(problem: Problem, base: Fit, item: Screened) -> Trial:
    """Full joint refit of one candidate from its best starts."""
    terms, values = without(base, problem, item.drop)
    few = enough(problem)
    begins = [np.concatenate((values, b)) for b in item.begin[: 2 if any(not p.linear for p in item.term.parameters) else 1]]
    if item.nominal:
        begins = [np.concatenate(both) for both in zip(item.nominal, item.begin, strict=True)]
    fits = [
        minimize(few, (*terms, item.term), begin, rounds=problem.rules.first_iterations, tolerance=1e-4) for begin in begins
    ]
    fit = min(fits, key=lambda f: f.cost)
    alone = not problem.joint_states  # the other models are begun again together with their parameters
    fit = minimize(few, fit.terms, fit.values, rounds=problem.rules.further_iterations, tolerance=1e-4, states=alone)
    begun = get_starts(problem)
    fit = begun_again(problem, fit)
    if any(a is not b for a, b in zip(few.segments, problem.segments, strict=True)):
        fit = minimize(problem, fit.terms, fit.values, rounds=1)
    if alone:
        start_again(problem, fit)  # also of held-out recordings: the state of the model so far is not this one's
    fit = finish(problem, fit)
    fit = placed(problem, restarted(problem, fit, fit.terms[-1].candidate))
    after = get_starts(problem)
    set_starts(problem, begun)
    heldout = problem.gain("heldout", base.residuals, fit.residuals)
    trained = problem.gain("fit", base.residuals, fit.residuals)
    both = problem.gain("both", base.residuals, fit.residuals)
    return Trial(
        fit.terms[-1].candidate,
        fit,
        heldout,
        trained,
        both,
        both.log_likelihood - problem.rules.parameter_penalty * (fit.fitted - base.fitted),
        after,
        bool(item.drop),
        problem.segments[0].recording.dt_s,
        problem.rules,
        problem.apart,
        any(segment.repeats for segment in problem.segments),
        _cancellable(problem, base) if fit.terms[-1].candidate.effect.cancels_noise else 0.0,
        problem.passive(fit),
    )


def restarted(problem: Problem, fit: Fit, candidate: Candidate) -> Fit:
    """Refit with the memory at the candidate's port started, in each recording, where that recording fits best."""
    if not candidate.effect.remembers:
        return fit
    port = candidate.port.name
    for _ in range(0 if candidate.effect.memories else 2):
        before = get_starts(problem)
        reach = 2.0 * max(max(abs(start.get(port, 0.0)) for start in before), _need_rms(problem, fit, candidate))
        for segment in problem.segments:
            _best_start(problem, fit, segment, port, reach)
            if candidate.effect.begins_with_speed:
                x = problem.model.motion(segment, candidate.port)
                hurry = float(np.std(np.gradient(x, segment.recording.dt_s))) / max(float(np.std(x)), 1e-300)
                for key, most in ((rate_key(port), reach * hurry), (port, reach)):
                    _best_start(problem, fit, segment, key, most)
        trial = minimize(problem, fit.terms, fit.values, rounds=6, tolerance=1e-4)
        if not trial.cost < fit.cost:
            set_starts(problem, before)
            break
        better = trial.cost < 0.98 * fit.cost
        fit = finish(problem, trial)
        if not better:
            break
    return _memory_and_values(problem, fit) if candidate.effect.timed and not problem.joint_states else fit


def _memory_and_values(problem: Problem, fit: Fit) -> Fit:
    """`fit` with its parameters and the starts of its memories moved together, if that lowers its cost.

    In turn they hardly move where a memory fades slowly: the start holds what the parameters leave, and they follow it.
    """
    before = get_starts(problem)
    trial = fit_with_states(problem, fit, STATE_STEPS)
    trial = minimize(problem, trial.terms, trial.values, rounds=6, tolerance=1e-4)
    if trial.cost < fit.cost:
        return finish(problem, trial)
    set_starts(problem, before)
    return fit


def _need_rms(problem: Problem, fit: Fit, candidate: Candidate) -> float:
    needs = problem.needs(fit, candidate.port)
    return float(np.sqrt(np.nanmean(np.concatenate(needs) ** 2)))


def _best_start(problem: Problem, fit: Fit, segment: Segment, port: str, reach: float) -> None:
    """Start of memory at `port` that leaves the least error in `segment`: a scan over [-reach, reach], then its best
    cell halved.
    """

    def error(start: float) -> float:
        segment.start[port] = start
        r = problem.left(segment, fit.terms, fit.values) / problem.scale[:, None]
        return float(np.nansum(np.minimum(r * r, 16.0)))

    old = segment.start.get(port, 0.0)
    tried = {float(s): error(float(s)) for s in (*np.linspace(-reach, reach, 9), old)}
    step = 0.125 * reach
    for _ in range(4):
        middle = min(tried, key=lambda s: tried[s])
        for s in (middle - step, middle + step):
            tried[s] = error(s)
        step *= 0.5
    best = min(tried, key=lambda s: tried[s])
    segment.start[port] = best if tried[best] < 0.9999 * tried[old] else old
