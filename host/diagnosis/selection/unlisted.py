"""The residual after the known effects: is it predictable, and does an equation found by search explain it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.coloured import only_coloured, shifted, structured, too_slow
from host.diagnosis.estimation.evidence import asked
from host.diagnosis.estimation.fit import Fit, Problem, finish, get_starts, minimize, parameter_rates, reweigh, set_starts
from host.diagnosis.estimation.jumps import jumps_of
from host.diagnosis.estimation.noise import NoiseSource
from host.diagnosis.model.effect import Port
from host.diagnosis.model.model import tolerance_of
from host.diagnosis.model.operators import fill
from host.diagnosis.selection.found import Found, SearchMove, Step
from host.diagnosis.selection.refits import fit_without, try_fit
from host.diagnosis.selection.screening import Screened, term_of
from host.diagnosis.selection.trial import Trial, rank, within_sample
from host.diagnosis.symbolic.dictionary import Form, PredictedPart, equation_at, fallen, lay_out, predict_residual
from host.diagnosis.symbolic.equation_search import search_equation

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Remainder:
    """Residual beyond the known effects. `predicted`: its most predictable part; `share`: of the nominal mismatch
    that remains.
    """

    predicted: PredictedPart | None
    share: float
    doubtful: bool = False  # known effects are named, but they are probably the wrong names
    above_noise: bool = False  # the remaining residual is larger than noise, predicted or not

    @property
    def sure(self) -> bool:
        """Return whether a mismatch is certain."""
        return self.above_noise or (self.predicted is not None and self.predicted.sure)


def remaining_share(problem: Problem, found: Found) -> float:
    """Share of the nominal model's held-out error above noise that the best model leaves, in the output where it
    mattered most; noise may be larger than its estimate by `noise_uncertainty`, and is no larger than that remaining error.
    """
    shares, weights = [], []
    noise_sd = _levels(problem, found.best)
    for row in range(noise_sd.size):
        left = _power(problem, found.best.residuals, row)
        # An effect that is there at rest too, a line in a reading, is part of the noise that was measured at rest.
        noise = min(float(noise_sd[row]) ** 2, left)
        before = _power(problem, found.nominal.residuals, row) - noise
        after = left - problem.rules.noise_uncertainty**2 * noise
        if before > 0.0:
            shares.append(float(np.clip(after / before, 0.0, 1.0)))
            weights.append(before / max(noise, 1e-300))
    return shares[int(np.argmax(weights))] if shares else 0.0


def _above_noise(problem: Problem, found: Found) -> bool:
    """Whether the best model leaves more than the noise of some output can be: noise known from quiescent parts, or
    guessed. What the fitted samples leave counts, too: held-out ones may hardly show what is missing.
    """
    rules, levels, none = problem.rules, _levels(problem, found.best), not found.best.terms
    measured = rules.residual_over_noise_nominal if none else rules.residual_over_noise
    for row, noise in enumerate(problem.noise):
        left = _most_left(problem, found.best, row)
        if left > (measured if noise.source.seen_alone else rules.residual_over_guessed_noise) * levels[row]:
            return True
        if none and jumps_of([r[row] for r in found.best.residuals], rules, problem.reading_step(row)):
            return True  # no noise does that
    return none and bool(structured_outputs(problem, found.best))


def structured_outputs(problem: Problem, fit: Fit) -> list[int]:
    """Rows of outputs of which `fit` leaves more than noise may be, if the guess is right, and not like any noise."""
    least = problem.rules.residual_over_noise_nominal * problem.noise_sd
    return [
        row
        for row, level in enumerate(least)
        if _most_left(problem, fit, row) > level and _shows_structure(problem, fit, row)
    ]


def _shows_structure(problem: Problem, fit: Fit, row: int) -> bool:
    """Whether the residual of an output follows something more than noise with its spectrum may do.

    Noise of an input does so too, whether it was read with the input or a controller fed it into it. Both get there by a
    linear law, so all that a linear law makes of the inputs, or of simulated outputs, is removed before.
    """
    rules = problem.rules
    if (
        problem.noise[row].source not in (NoiseSource.SPECTRUM, NoiseSource.SHORT_RESTS)
        or problem.noise_passed > rules.noise_passed_share
    ):
        return False
    if _made_by_steps(problem, fit, row):
        return False
    known = _known(problem, fit, slice(None))
    absorbed = [np.vstack(both) for both in zip(_absorbed(problem, fit, row), map(shifted, known), strict=True)]
    return structured([r[row] for r in fit.residuals], known, absorbed, rules)


def _made_by_steps(problem: Problem, fit: Fit, row: int) -> bool:
    """Whether the steps in which an input is read may make the residual of an output, both relative to their signals.

    Steps that are too fine to be seen are taken for a third of the least movement that counts.
    """
    left = float(np.sqrt(_power(problem, fit.residuals, row, "both")))
    signal = float(np.nanstd(np.concatenate([segment.y[row] for segment in problem.segments])))
    for name in problem.model.quiet_inputs:
        u = [fill(segment.inputs[name]) for segment in problem.segments]
        rounding = max(tolerance_of(x, float(np.ptp(x))) for x in u) / (3.0 * np.sqrt(12.0))
        if left * float(np.std(np.concatenate(u))) < problem.rules.residual_over_noise_nominal * rounding * signal:
            return True
    return False


def _known(problem: Problem, fit: Fit, row: int | slice) -> list[list[Array]]:
    """Signals (n_i,) of each recording that a mismatch may follow: inputs, and simulated outputs (of a row, or of several).

    What a plant does to a force inside it follows its own motion, of which no form of an input says enough.
    """
    return [
        [*(segment.inputs[name] for name in problem.model.quiet_inputs), *np.atleast_2d(segment.y[row] - r[row])]
        for segment, r in zip(problem.segments, fit.residuals, strict=True)
    ]


def _absorbed(problem: Problem, fit: Fit, row: int) -> list[Array]:
    return [parameter_rates(problem, fit, segment)[:, row] for segment in problem.segments]


def _levels(problem: Problem, fit: Fit) -> Array:
    """Noise of each output (outputs,): where it was guessed from a spectrum, and `fit` leaves coloured noise, that noise."""
    levels = problem.noise_sd
    for row, noise in enumerate(problem.noise):
        if not noise.source.seen_alone and _power(problem, fit.residuals, row) > levels[row] ** 2:
            residuals = [r[row] for r in fit.residuals]
            if only_coloured(residuals, _known(problem, fit, row), problem.rules, partial(_absorbed, problem, fit, row)):
                levels[row] = np.sqrt(_power(problem, fit.residuals, row))
    return levels


def slow_outputs(problem: Problem, fit: Fit) -> list[int]:
    """Rows of outputs of which `fit` leaves noise so slow that these data cannot separate it from a mismatch."""
    rules, levels = problem.rules, _levels(problem, fit)
    return [
        row
        for row, sigma in enumerate(problem.noise_sd)
        if levels[row] > rules.residual_over_guessed_noise * sigma and too_slow([r[row] for r in fit.residuals], rules)
    ]


def _most_left(problem: Problem, fit: Fit, row: int) -> float:
    """RMS that `fit` leaves of an output, in held-out samples or in all, whichever is larger."""
    return float(np.sqrt(max(_power(problem, fit.residuals, row, which) for which in ("heldout", "both"))))


def _power(problem: Problem, residuals: list[Array], row: int, which: str = "heldout") -> float:
    parts = [r[row][asked(segment, which)] for segment, r in zip(problem.segments, residuals, strict=True)]
    together = np.concatenate(parts)
    together = together[np.isfinite(together)]
    return float(np.mean(together**2)) if together.size else 0.0


def explain_remainder(problem: Problem, found: Found, progress: Progress) -> Remainder:
    """Test the remaining residual, and add an equation to `found.best` where one earns its place."""
    ports = {port.name: port for port in problem.model.ports}
    pairs = {a: (ports[a], ports[b]) for a, b in problem.model.unlisted_at}
    progress("testing whether the residual is predictable", 0.0)
    late = None if found.best.terms else within_sample(found.last_trials, found.best)
    if late is not None:
        past = _past(problem, found, late)
        if not past.sure:
            return past
    places = _places(problem, found)
    remainder = _remainder(problem, found, places)
    crowd = Counter(term.candidate.port.name for term in found.best.terms).most_common(1)
    if (
        not remainder.sure
        or remainder.predicted is None
        or (crowd and remainder.share < problem.rules.partial_share / crowd[0][1])
    ):
        return remainder
    likely = sorted((p for p in places if p.port is not None and p.sure), key=lambda place: -place.log_likelihood)
    for number, place in enumerate([place.port.name for place in likely if place.port is not None]):
        if not problem.budget.spent() and _equation_instead(problem, found, *pairs[place], progress, evolve=number == 0):
            return remainder_of(problem, found)
    # Several effects that pile up and still do not fit stand for something that is in no list.
    return replace(remainder, doubtful=bool(crowd))


def _past(problem: Problem, found: Found, late: Trial) -> Remainder:
    """The remainder past a delay within one sample: how the input was held, which no effect is named for."""
    begun = get_starts(problem)
    set_starts(problem, late.starts)
    remainder = remainder_of(problem, replace(found, best=late.fit))
    set_starts(problem, begun)
    return remainder


def remainder_of(problem: Problem, found: Found) -> Remainder:
    """Return what the best model leaves, without a search for its equation."""
    return _remainder(problem, found, _places(problem, found))


def _places(problem: Problem, found: Found) -> list[PredictedPart]:
    """What forms of the inputs predict of the residual; nothing where most of it is noise, which these inputs hold."""
    of_noise = problem.noise_passed > problem.rules.noise_passed_share and not found.best.terms
    return [] if of_noise else predict_residual(problem, found.best)


def _remainder(problem: Problem, found: Found, places: list[PredictedPart]) -> Remainder:
    best = max(places, key=lambda place: (place.sure, place.log_likelihood), default=None)
    explained = fallen(problem, found.nominal.residuals, found.best.residuals)
    predicted_share = best.power / (explained + best.power) if best is not None and best.power > 0.0 else 0.0
    left = max(remaining_share(problem, found), predicted_share)
    return Remainder(best, left, above_noise=_above_noise(problem, found))


def _equation_instead(problem: Problem, found: Found, port: Port, target: Port, progress: Progress, evolve: bool) -> bool:
    """Puts an equation in the place of all effects at its port, if it earns its place and does better than they.

    `evolve`: search by genetic programming too, where no form of the library says it all.
    """
    progress("searching an equation", 0.0)
    there = tuple(term.candidate.key for term in found.best.terms if term.candidate.port.name in (port.name, target.name))
    base = fit_without(problem, found.best, there, tolerance=1e-7) if there else found.best
    sized = [form for place in predict_residual(problem, base) if place.port is port for form in place.forms]
    trials = [_tried(problem, base, target, form, size) for form, size in sized]
    forms = [form for form, _ in sized]
    rank(problem, trials, base)
    winner = next((trial for trial in trials if _earned(trial) and not _only_sampling(problem, trial)), None)
    if evolve and (winner is None or _left(problem, found, winner.fit) > problem.rules.partial_share):
        evolved = search_equation(problem, base, port)
        trials += [_tried(problem, base, target, form, 1.0) for form in evolved]
        forms += evolved
        rank(problem, trials, base)
        winner = next((trial for trial in trials if _earned(trial) and not _only_sampling(problem, trial)), None)
    if winner is None or not _better_than_known(problem, found, winner, bool(there)):
        return False
    if _left(problem, found, winner.fit) > problem.rules.equation_residual_share:
        return False
    if there and _still_earned(problem, found.best, winner):
        return False
    found.forms += [form for form in forms if form.text == winner.candidate.effect.equation]
    found.steps.append(Step(SearchMove.EQUATION, winner.candidate.key, winner.heldout, trials))
    found.best = finish(problem, minimize(problem, winner.fit.terms, winner.fit.values))
    reweigh(problem, found.best)
    return True


def _still_earned(problem: Problem, best: Fit, winner: Trial) -> bool:
    """Whether the effects that an equation would replace gain as much together with it as they must to enter: then they
    stay.
    """
    term = winner.fit.terms[-1]
    begin = np.concatenate((best.values, winner.fit.values_of(term)))
    both = finish(problem, minimize(problem, (*best.terms, term), begin, rounds=8, tolerance=1e-4))
    gain = problem.gain("heldout", winner.fit.residuals, both.residuals)
    more = both.fitted - winner.fit.fitted
    return gain.log_likelihood > problem.rules.heldout_log_likelihood + problem.rules.parameter_penalty * more


def equations_for(problem: Problem, less: Fit, port: Port) -> list[Trial]:
    """The best forms of the library at `port`, or at the one whose reading it is, each refitted with `less`."""
    here = port.within or port.name
    target = next((b for a, b in problem.model.unlisted_at if here in (a, b)), None)
    if target is None:
        return []
    ports = {p.name: p for p in problem.model.ports}
    name = next(a for a, b in problem.model.unlisted_at if b == target)
    sized = [form for place in predict_residual(problem, less, name) for form in place.forms]
    return [_tried(problem, less, ports[target], form, size) for form, size in sized[: problem.rules.equation_fits]]


def _earned(trial: Trial) -> bool:
    """Whether an equation earns its place: in either part of the samples, and by what it takes of the error above noise.

    Chosen among hundreds on the samples to fit, it has to gain more there than a listed effect; few held-out blocks may hold
    all of the mismatch, so these have less of a say.
    """
    gain, rules = trial.heldout, trial.rules
    return (
        gain.log_likelihood > rules.heldout_log_likelihood + rules.heldout_parameter_cost  # of its amplitude
        and trial.trained.log_likelihood > rules.equation_log_likelihood
        and gain.p_value < rules.equation_significance
        and gain.share > max(rules.least_error_reduction, rules.least_excess_reduction * gain.excess)
    )


def _only_sampling(problem: Problem, trial: Trial) -> bool:
    """Whether an equation shifts its port's own input by no more than a sample: how the input was held, not physics."""
    own = problem.columns.get(problem.model.moves.get(trial.candidate.port.name, ""), "")
    return (
        trial.candidate.effect.equation == f"rate({own})"
        and abs(trial.fit.values[-1]) < problem.rules.sampling_delay * trial.period_s
    )


def _tried(problem: Problem, base: Fit, target: Port, form: Form, size: float) -> Trial:
    lay_out(problem.segments, form)
    candidate = equation_at(target, form, size)
    return try_fit(problem, base, Screened(candidate, term_of(problem, candidate, base), (), 1.0, [np.array([size])]))


def _left(problem: Problem, found: Found, fit: Fit) -> float:
    return remaining_share(problem, replace(found, best=fit))


def _better_than_known(problem: Problem, found: Found, winner: Trial, instead: bool) -> bool:
    """Whether an equation beats the known effects it takes the place of, or else all those that were tried and refused."""
    if instead:
        gain = problem.gain("heldout", found.best.residuals, winner.fit.residuals)
        return gain.log_likelihood > problem.rules.heldout_log_likelihood
    last = found.steps[-1].trials if found.steps else []
    return all(
        trial.heldout.log_likelihood < problem.rules.equation_known_ratio * winner.heldout.log_likelihood for trial in last
    )
