"""Which effects are missing: joint refits; forward, upgrade, swap and backward moves on held-out evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from host.diagnosis.dictionary import Form
from host.diagnosis.effect import Candidate
from host.diagnosis.evidence import Gain, compare
from host.diagnosis.fit import (
    Fit,
    Problem,
    finish,
    first_needs,
    get_starts,
    minimize,
    reweigh,
    set_starts,
)
from host.diagnosis.model import Piece
from host.diagnosis.screening import Screened, enough, screen, without

Array = npt.NDArray[np.float64]
Tell = Callable[[str, float], None]
FULL_FITS = 8  # candidates refitted in full at each step
FIRST_ROUNDS, MORE_ROUNDS = 5, 9  # of a fit: from each start, and from the best of these on
MOST_EFFECTS = 5
ENOUGH = 6.0  # held-out log-likelihood a new effect has to bring, besides its parameters' penalty
SURE = 1e-2  # p-value a new effect has to reach on held-out blocks
SMALLEST_SHARE = 0.015  # of the held-out error of some output it has to take away,
SMALLEST_EXCESS = 0.10  # and this much of what is above noise
COARSE = 0.15  # far above noise, a finer shape has to take this share of the error to be told from a simpler one
INEXACT = 0.02  # part of the likelihood that a coarser shape of the same effect may lack and still be preferred if simpler
NATURAL_BOUNDS = frozenset({"rectified_sensor", "saturation", "missed_steps", "dead_zone"})
REMEMBER = frozenset({"backlash", "presliding_friction", "load_dependent_friction", "coulomb_friction", "stribeck_friction"})


@dataclass
class Trial:
    """A candidate fitted in full, with its gains over the structure it was added to."""

    candidate: Candidate
    fit: Fit
    heldout: Gain
    trained: Gain
    score: float
    starts: list[dict[str, float]] = field(default_factory=list)
    replaced: bool = False
    period_s: float = 0.0


@dataclass
class Step:
    """One move of the search, for the report."""

    move: str
    key: str
    gain: Gain
    trials: list[Trial] = field(default_factory=list)


@dataclass
class Found:
    """Nominal fit, best fit, the moves between, trials fitted beside the best structure, and its equations."""

    nominal: Fit
    best: Fit
    steps: list[Step]
    rivals: dict[str, list[Trial]] = field(default_factory=dict)
    forms: list[Form] = field(default_factory=list)
    nominal_full: Fit = field(default_factory=lambda: Fit((), np.zeros(0)))
    best_full: Fit = field(default_factory=lambda: Fit((), np.zeros(0)))


def settle(problem: Problem, values: Array) -> None:
    """Lets a model that needs it prepare its recordings for these nominal parameters."""
    own = getattr(problem.model, "settle", None)
    for piece in problem.pieces if own is not None else ():
        own(piece, values)  # type: ignore[misc]
    begin_anew(problem, Fit((), values))


def begin_anew(problem: Problem, fit: Fit) -> None:
    """Lets a model that runs freely from a measured state find that state anew."""
    own = getattr(problem.model, "begin_anew", None)
    for piece in problem.pieces if own is not None else ():
        own(piece, *problem.parted(fit.terms, fit.values))  # type: ignore[misc]


def refined(problem: Problem, fit: Fit) -> Fit:
    """`fit` brought to its end on all samples, together with the states that recordings begin from."""
    for _ in range(2 if hasattr(problem.model, "begin_anew") else 1):
        begin_anew(problem, fit)
        fit = minimize(problem, fit.terms, fit.values)
    return finish(problem, fit)


def fit_nominal(problem: Problem) -> Fit:
    """Nominal parameters refitted on all samples to fit; sets the weights of outputs and the start of memories.

    A model that takes a measured output as an input too (`settle`) has it freed of noise before each fit, with what it
    simulates itself:
    errors in a variable that the fit takes for exact would bend its parameters.
    """
    fit = Fit((), problem.model.guess(problem.pieces))
    for _ in range(3):
        settle(problem, fit.values)
        reweigh(problem, fit)
        fit = minimize(problem, (), fit.values)
    settle(problem, fit.values)
    reweigh(problem, fit)
    finish(problem, fit)
    set_starts(problem, first_needs(problem, fit))
    return fit


def try_fit(problem: Problem, base: Fit, item: Screened, floor: Array) -> Trial:
    """Full joint refit of one candidate from its best starts."""
    terms, values = without(base, problem, item.drop)
    few = enough(problem)
    begins = item.begin[: 2 if any(not p.linear for p in item.term.parameters) else 1]
    fits = [
        minimize(few, (*terms, item.term), np.concatenate((values, begin)), rounds=FIRST_ROUNDS, tolerance=1e-4)
        for begin in begins
    ]
    fit = min(fits, key=lambda f: f.cost)
    fit = minimize(few, fit.terms, fit.values, rounds=MORE_ROUNDS, tolerance=1e-4)
    if any(a is not b for a, b in zip(few.pieces, problem.pieces, strict=True)):
        fit = minimize(problem, fit.terms, fit.values, rounds=1)
    fit = finish(problem, fit)
    begun = get_starts(problem)
    fit = _restart(problem, fit, item.candidate)
    after = get_starts(problem)
    set_starts(problem, begun)
    heldout = compare(problem.pieces, "heldout", base.residuals, fit.residuals, floor)
    trained = compare(problem.pieces, "fit", base.residuals, fit.residuals, floor)
    more = len(fit.values) - len(base.values)
    return Trial(
        item.candidate,
        fit,
        heldout,
        trained,
        heldout.log_likelihood - more,
        after,
        bool(item.drop),
        problem.pieces[0].recording.dt_s,
    )


def at_bound(fit: Fit) -> bool:
    """Whether the last term ended at a bound that is none of nature's: its shape is then not what it stands for."""
    term = fit.terms[-1]
    values = fit.values[-len(term.parameters) :]
    return (
        any(
            p.high > p.low
            and (
                (np.isfinite(p.low) and p.low != 0.0 and value <= p.low * (1.001 if p.low > 0 else 0.999))
                or (np.isfinite(p.high) and value >= p.high - 1e-3 * abs(p.high))
            )
            for p, value in zip(term.parameters, values, strict=True)
        )
        and term.candidate.effect.id not in NATURAL_BOUNDS
    )


def _restart(problem: Problem, fit: Fit, candidate: Candidate) -> Fit:
    """Refit with the memory at the candidate's port started, in each recording, where that recording fits best."""
    if candidate.effect.id not in REMEMBER:
        return fit
    port = candidate.port.name
    for _ in range(2):
        before = get_starts(problem)
        reach = 2.0 * max(max(abs(start.get(port, 0.0)) for start in before), _need_rms(problem, fit, candidate))
        for piece in problem.pieces:
            _best_start(problem, fit, piece, port, reach)
        trial = minimize(problem, fit.terms, fit.values, rounds=6, tolerance=1e-4)
        if not trial.cost < fit.cost:
            set_starts(problem, before)
            break
        better = trial.cost < 0.98 * fit.cost
        fit = finish(problem, trial)
        if not better:
            break
    return fit


def _need_rms(problem: Problem, fit: Fit, candidate: Candidate) -> float:
    n = len(problem.model.parameters)
    needs = [
        problem.model.needs(piece, candidate.port, fit.values[:n], r)
        for piece, r in zip(problem.pieces, fit.residuals, strict=True)
    ]
    return float(np.sqrt(np.nanmean(np.concatenate(needs) ** 2)))


def _best_start(problem: Problem, fit: Fit, piece: Piece, port: str, reach: float) -> None:
    """Start of memory at `port` that leaves the least error in `piece`: a scan over [-reach, reach], then its best
    cell halved.
    """

    def error(start: float) -> float:
        piece.start[port] = start
        r = (piece.y - problem.simulate(piece, fit.terms, fit.values)) / problem.scale[:, None]
        return float(np.nansum(np.minimum(r * r, 16.0)))

    old = piece.start.get(port, 0.0)
    tried = {float(s): error(float(s)) for s in (*np.linspace(-reach, reach, 9), old)}
    step = 0.125 * reach
    for _ in range(4):
        middle = min(tried, key=lambda s: tried[s])
        for s in (middle - step, middle + step):
            tried[s] = error(s)
        step *= 0.5
    best = min(tried, key=lambda s: tried[s])
    piece.start[port] = best if tried[best] < 0.9999 * tried[old] else old


def rank(trials: list[Trial], base: Fit) -> None:
    """Sorts trials by held-out likelihood, with one effective sample size for all, that of the trial with the least
    error.
    """
    if not trials:
        return
    most = np.max([trial.heldout.independent for trial in trials], axis=0)
    common = max(trials, key=lambda trial: float(most @ trial.heldout.log_ratio)).heldout.independent
    for trial in trials:
        more = max(len(trial.fit.values) - len(base.values), 0)
        trial.score = 0.5 * float(common @ trial.heldout.log_ratio) - more
    trials.sort(key=lambda trial: trial.score, reverse=True)
    top = trials[0]
    coarse = 0.5 * float(common @ (-np.log(1.0 - COARSE * np.minimum(1.0, 2.0 * top.heldout.excesses))))
    near = top.score - max(ENOUGH, INEXACT * top.score, min(coarse, 0.3 * top.score))
    simpler = [
        t
        for t in trials
        if len(t.fit.values) < len(top.fit.values) and t.score > near and related(t.candidate, top.candidate)
    ]
    if simpler:
        best = max(simpler, key=lambda t: (-len(t.fit.values), t.score))
        trials.remove(best)
        trials.insert(0, best)


def of_sampling(trial: Trial) -> bool:
    """Whether a delay or lag of an axis' input is within one sample: that is how the input was held between samples,
    not physics.
    """
    if trial.candidate.effect.id not in ("latency", "rate_lag") or not trial.candidate.port.name.endswith("_drive"):
        return False
    return float(trial.fit.values[-1]) < 1.05 * trial.period_s


def related(simple: Candidate, general: Candidate) -> bool:
    """Whether `general` is a finer shape of `simple`, at the same place."""
    a, b = simple.effect, general.effect
    return simple.port.name == general.port.name and (
        a.id == b.id or a.id in b.contains or bool(a.family and a.family == b.family)
    )


def good_enough(trial: Trial, base: Fit) -> bool:
    """Whether a trial earns its place: likelihood, blocks, size, and agreement of fitted and held-out parts."""
    more = max(len(trial.fit.values) - len(base.values), 0)
    gain = trial.heldout
    least = max(SMALLEST_SHARE, (COARSE if trial.replaced else SMALLEST_EXCESS) * gain.excess)
    return (
        not at_bound(trial.fit)
        and not of_sampling(trial)
        and gain.log_likelihood > ENOUGH + more
        and gain.p_value < SURE
        and gain.share > least
        and trial.trained.log_likelihood > ENOUGH + 2.0 * more
    )


def search(problem: Problem, pool: list[Candidate], tell: Tell) -> Found:
    """Nominal refit, then moves until none is earned."""
    tell("refitting the nominal model", 0.0)
    nominal = fit_nominal(problem)
    floor = np.array([noise.sigma for noise in problem.noise])
    best, steps = nominal, []
    rivals: dict[str, list[Trial]] = {}
    for _ in range(MOST_EFFECTS):
        ranked = screen(problem, best, pool, tell)
        trials = []
        promising = _varied([item for item in ranked if item.promise > 3.0])
        for count, item in enumerate(promising):
            tell(f"fitting {item.candidate.key}", count / len(promising))
            trials.append(try_fit(problem, best, item, floor))
        rank(trials, best)
        winner = next((trial for trial in trials if good_enough(trial, best)), None)
        if winner is None:
            steps.append(Step("stop", "", Gain(0.0, 1.0, 0.0), trials))
            break
        move = "upgrade" if len(winner.fit.terms) <= len(best.terms) else "forward"
        steps.append(Step(move, winner.candidate.key, winner.heldout, trials))
        rivals[winner.candidate.key] = [trial for trial in trials if trial is not winner]
        set_starts(problem, winner.starts)
        best = refined(problem, winner.fit)
        reweigh(problem, best)
        best = _prune(problem, best, floor, steps)
    return Found(nominal, best, steps, rivals)


def _varied(items: list[Screened]) -> list[Screened]:
    """The most promising, at most two of one effect so that rivals of other kinds get their chance."""
    kept: list[Screened] = []
    for item in items:
        same = sum(other.candidate.effect.id == item.candidate.effect.id for other in kept)
        if same < 3:
            kept.append(item)
        if len(kept) == FULL_FITS:
            break
    return kept


def _prune(problem: Problem, best: Fit, floor: Array, steps: list[Step]) -> Fit:
    """Backward: drop what no longer earns its place."""
    dropped = True
    while dropped and len(best.terms) > 1:
        dropped = False
        for term in best.terms:
            terms, values = without(best, problem, (term.candidate.key,))
            less = finish(problem, minimize(problem, terms, values, rounds=8, tolerance=1e-4))
            gain = compare(problem.pieces, "heldout", less.residuals, best.residuals, floor)
            least = 0.5 * max(SMALLEST_SHARE, SMALLEST_EXCESS * gain.excess)
            if gain.log_likelihood < 0.5 * ENOUGH + len(term.parameters) or gain.share < least:
                best, dropped = less, True
                steps.append(Step("backward", term.candidate.key, gain))
                break
    return best
