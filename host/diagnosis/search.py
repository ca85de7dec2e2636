"""Which effects are missing: screening by projection, joint refits, forward, upgrade, swap and backward moves on held-out evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.effect import Candidate
from host.diagnosis.evidence import Gain, compare, correlation_time
from host.diagnosis.fit import (
    Fit,
    Problem,
    Term,
    finish,
    first_needs,
    get_starts,
    grid_points,
    jacobian,
    lines_of,
    minimize,
    reweigh,
    set_starts,
    size_of,
    starts,
    tuned,
)
from host.diagnosis.model import Piece, scale_of

Array = npt.NDArray[np.float64]
Tell = Callable[[str, float], None]
FULL_FITS = 8              # candidates refitted in full at each step
MOST_EFFECTS = 5
ENOUGH = 6.0               # held-out log-likelihood a new effect has to bring, besides its parameters' penalty
SURE = 1e-2                # p-value a new effect has to reach on held-out blocks
SMALLEST_SHARE = 0.015     # of the held-out error of some output it has to take away,
SMALLEST_EXCESS = 0.10     # and this much of what is above noise
COARSE = 0.15              # far above noise, a finer shape has to take this share of the error to be told from a simpler one
INEXACT = 0.02             # part of the likelihood that a coarser shape of the same effect may lack and still be preferred if simpler
NATURAL_BOUNDS = frozenset({"rectified_sensor", "saturation", "missed_steps", "dead_zone"})
REMEMBER = frozenset({"backlash", "presliding_friction", "load_dependent_friction", "coulomb_friction", "stribeck_friction"})
SCREEN_ROWS = 24000        # residuals to screen by, about
GRID = 160                 # grid points of one candidate at most
SCAN_SECONDS = 0.4         # time to screen one candidate, about


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
    """Nominal fit, best fit, the moves between, and all trials that were fitted beside the best structure."""

    nominal: Fit
    best: Fit
    steps: list[Step]
    rivals: dict[str, list[Trial]] = field(default_factory=dict)
    nominal_full: Fit = field(default_factory=lambda: Fit((), np.zeros(0)))
    best_full: Fit = field(default_factory=lambda: Fit((), np.zeros(0)))


def fit_nominal(problem: Problem) -> Fit:
    """Nominal parameters refitted on all samples to fit; sets the weights of outputs and the start of memories."""
    start = problem.model.guess(problem.pieces)
    fit = Fit((), start)
    for _ in range(3):
        reweigh(problem, fit)
        fit = minimize(problem, (), fit.values)
        settle = getattr(problem.model, "settle", None)
        if settle is not None:
            for piece in problem.pieces:
                settle(piece, fit.values)
    reweigh(problem, fit)
    finish(problem, fit)
    set_starts(problem, first_needs(problem, fit))
    return fit


def term_of(problem: Problem, candidate: Candidate, fit: Fit) -> Term:
    """`candidate` with bounds and start values for these recordings."""
    needs = [problem.model.needs(piece, candidate.port, fit.values, residual)[piece.fit]
             for piece, residual in zip(problem.pieces, fit.residuals, strict=True) if piece.fit.any()]
    together = np.concatenate(needs)
    rms = float(np.sqrt(np.nanmean(together**2))) if np.isfinite(together).any() else 1.0
    scale = scale_of(problem.model, problem.pieces, candidate.port, candidate, rms)
    parameters = candidate.effect.parameters(scale, candidate.form)
    if problem.model.kind == "impedance":
        parameters = tuple(replace(p, low=-np.inf) if p.linear and p.low == 0.0 else p for p in parameters)
    return Term(candidate, parameters)


def without(fit: Fit, problem: Problem, drop: tuple[str, ...]) -> tuple[tuple[Term, ...], Array]:
    """Terms and values of `fit` but for the candidates named in `drop`."""
    n = len(problem.model.parameters)
    terms, values, at = [], list(fit.values[:n]), n
    for term in fit.terms:
        part = fit.values[at: at + len(term.parameters)]
        at += len(term.parameters)
        if term.candidate.key not in drop:
            terms.append(term)
            values += list(part)
    return tuple(terms), np.array(values)


def replaced_by(fit: Fit, candidate: Candidate) -> tuple[str, ...] | None:
    """Active candidates that `candidate` would replace (it contains them), or None if it may not join."""
    drop = []
    for term in fit.terms:
        other = term.candidate
        if other.port.name != candidate.port.name:
            continue
        if other.effect.id == candidate.effect.id and other.source == candidate.source:
            if other.form == candidate.form and other.effect.order == candidate.effect.order:
                return None
            if other.effect.id not in ("creep_relaxation", "periodic_disturbance"):
                drop.append(other.key)
        elif other.effect.id in candidate.effect.contains or (candidate.effect.family and candidate.effect.family == other.effect.family):
            drop.append(other.key)
        elif candidate.effect.id in other.effect.contains:
            return None
    return tuple(drop)


@dataclass
class Screened:
    """A candidate with its promise by projection and the start values that earned it."""

    candidate: Candidate
    term: Term
    drop: tuple[str, ...]
    promise: float
    begin: list[Array]


def screen(problem: Problem, fit: Fit, pool: list[Candidate], tell: Tell) -> list[Screened]:
    """Promise of every candidate: what its signature, seen past all active parameters, takes from the residual (grid search)."""
    problem = _smaller(problem)
    r = problem.stacked(fit.terms, fit.values)
    found = []
    bases: dict[tuple[str, ...], tuple[tuple[Term, ...], Array, Array, Array, Array]] = {}
    n_eff = _independent(problem, fit)
    slopes = _slopes(problem, fit)
    used = [np.where(piece.fit, r, np.nan) for piece, r in zip(problem.pieces, fit.residuals, strict=True) if piece.fit.any()]
    lines = lines_of(used, problem.pieces[0].recording.dt_s)
    began = perf_counter()
    problem.stacked(fit.terms, fit.values)
    most = int(np.clip(SCAN_SECONDS / max(perf_counter() - began, 1e-5), 12, GRID))
    for count, candidate in enumerate(pool):
        tell("screening", count / len(pool))
        drop = replaced_by(fit, candidate)
        if drop is None:
            continue
        if drop not in bases:
            terms, values = without(fit, problem, drop)
            base = problem.stacked(terms, values) if drop else r
            parameters = problem.parameters(terms)
            J = jacobian(problem, terms, values, base, [size_of(p, v) for p, v in zip(parameters, values, strict=True)])
            Q = np.linalg.qr(J)[0] if J.shape[1] else J
            bases[drop] = (terms, values, base, Q, base - Q @ (Q.T @ base))
        terms, values, base, Q, rest = bases[drop]
        term = term_of(problem, candidate, fit)
        quick = slopes is not None and candidate.port.name in slopes[0]
        if not term.parameters:
            continue
        points = _scan(problem, (*terms, term), values, term, base, Q, rest, GRID if quick else most, slopes, lines)
        if not points:
            continue
        points.sort(key=lambda point: point[0], reverse=True)
        reference = float(r @ r)
        left = max(float(rest @ rest) - points[0][0], 1e-300)
        promise = 0.5 * n_eff * np.log(reference / left) - len(term.parameters)
        found.append(Screened(candidate, term, drop, float(promise), [begin for _, begin in points[:3]]))
    return sorted(found, key=lambda item: item.promise, reverse=True)


Slopes = list[dict[str, Array]]


def _slopes(problem: Problem, fit: Fit) -> Slopes | None:
    """Sensitivity of the outputs to each axis, per piece, where the model offers it."""
    sensitivity = getattr(problem.model, "sensitivity", None)
    if sensitivity is None:
        return None
    n = len(problem.model.parameters)
    acts, at = [], n
    for term in fit.terms:
        acts.append((term.candidate, fit.values[at: at + len(term.parameters)]))
        at += len(term.parameters)
    axes = [port.name for port in problem.model.ports if port.kind.startswith("motion")]
    return [{axis: sensitivity(piece, fit.values[:n], axis, acts) for axis in axes} if piece.fit.any() else {axis: piece.y for axis in axes}
            for piece in problem.pieces]


def _fast(problem: Problem, terms: tuple[Term, ...], trial: Array, slopes: Slopes) -> Array:
    """Weighted change of the outputs by the last term, linearized at its axis."""
    term = terms[-1]
    n = len(problem.model.parameters)
    rows = []
    for piece, S in zip(problem.pieces, slopes, strict=True):
        if piece.fit.any():
            change = problem.model.change(piece, trial[:n], S, term.candidate, trial[-len(term.parameters):])  # type: ignore[attr-defined]
            rows.append(np.where(np.isfinite(piece.y), change, 0.0)[:, piece.fit] / problem.scale[:, None])
    return np.concatenate([row.ravel() for row in rows])


def _few(problem: Problem) -> Problem:
    """The problem with enough recordings to fit, spread over all; the rest neither fitted nor simulated."""
    used = [index for index, piece in enumerate(problem.pieces) if piece.fit.any()]
    count = max(1, min(len(used), int(np.ceil(problem.model.screen_samples / max(problem.pieces[index].n for index in used)))))
    chosen = {used[round(k)] for k in np.linspace(0, len(used) - 1, count)}
    pieces = [piece if index in chosen else replace(piece, fit=np.zeros(piece.n, dtype=bool)) for index, piece in enumerate(problem.pieces)]
    return replace(problem, pieces=pieces)


def _smaller(problem: Problem) -> Problem:
    """Few recordings, every so many samples of them: enough to screen by."""
    few = _few(problem)
    stride = max(1, int(sum(piece.fit.sum() for piece in few.pieces) * len(problem.noise) / SCREEN_ROWS))
    pieces = [replace(piece, fit=piece.fit & (np.arange(piece.n) % stride == 0)) for piece in few.pieces]
    return replace(problem, pieces=pieces)


def _independent(problem: Problem, fit: Fit) -> float:
    total = 0.0
    for piece, residual in zip(problem.pieces, fit.residuals, strict=True):
        if piece.fit.any():
            for row in residual:
                n = int(np.sum(piece.fit & np.isfinite(row)))
                total += n / correlation_time(np.where(piece.fit, row, np.nan))
    return total


def _scan(problem: Problem, terms: tuple[Term, ...], values: Array, term: Term, base: Array, Q: Array,
          rest: Array, most: int, slopes: Slopes | None, lines: Array) -> list[tuple[float, Array]]:
    """(energy taken, start values of the term) at each grid point; `rest` is orthogonal to the columns of `Q`."""
    points = []
    linear = [p for p in term.parameters if p.linear]
    for point in grid_points(tuned(term, lines), max(5, most // max(len(linear), 1))):
        columns = []
        options: list[Any] = [*linear] or [None]
        for p in options:
            amplitude = {q.name: 0.0 for q in linear}
            if p is not None:
                amplitude[p.name] = size_of(p, 0.0)
            trial = np.concatenate((values, starts(term, amplitude, point)))
            fast = slopes is not None and term.candidate.port.name in slopes[0]
            columns.append(_fast(problem, terms, trial, slopes) if fast and slopes is not None else base - problem.stacked(terms, trial))
        D = np.array(columns)
        B = D @ Q
        G, g = D @ D.T - B @ B.T, D @ rest
        size = np.sqrt(np.maximum(np.diag(G), 1e-300))
        if not np.all(np.isfinite(G)) or float(np.max(np.diag(G) / (np.sum(D * D, axis=1) + 1e-300))) < 1e-10:
            continue
        a = np.linalg.lstsq(G / np.outer(size, size), g / size, rcond=1e-10)[0] / size
        if linear:
            a = np.array([min(max(x * size_of(p, 0.0), p.low), p.high) / size_of(p, 0.0) for x, p in zip(a, linear, strict=True)])
        elif not 0.2 < a[0] < 5.0:
            continue
        taken = float(2.0 * a @ g - a @ G @ a)
        amplitude = {p.name: float(x) * size_of(p, 0.0) for x, p in zip(a, linear, strict=False)}
        points.append((taken, starts(term, amplitude, point)))
    return points


def try_fit(problem: Problem, base: Fit, item: Screened, floor: Array) -> Trial:
    """Full joint refit of one candidate from its best starts."""
    terms, values = without(base, problem, item.drop)
    fits, few = [], _few(problem)
    for begin in item.begin[: 2 if any(not p.linear for p in item.term.parameters) else 1]:
        fits.append(minimize(few, (*terms, item.term), np.concatenate((values, begin)), rounds=12, tolerance=1e-4))
    fit = min(fits, key=lambda f: f.cost)
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
    return Trial(item.candidate, fit, heldout, trained, heldout.log_likelihood - more, after, bool(item.drop), problem.pieces[0].recording.dt_s)


def at_bound(fit: Fit) -> bool:
    """Whether the last term ended at a bound that is none of nature's: its shape is then not what it stands for."""
    term = fit.terms[-1]
    values = fit.values[-len(term.parameters):]
    return any(p.high > p.low and ((np.isfinite(p.low) and p.low != 0.0 and value <= p.low * (1.001 if p.low > 0 else 0.999))
                                   or (np.isfinite(p.high) and value >= p.high - 1e-3 * abs(p.high)))
               for p, value in zip(term.parameters, values, strict=True)) and term.candidate.effect.id not in NATURAL_BOUNDS


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
    needs = [problem.model.needs(piece, candidate.port, fit.values[:n], r) for piece, r in zip(problem.pieces, fit.residuals, strict=True)]
    return float(np.sqrt(np.nanmean(np.concatenate(needs) ** 2)))


def _best_start(problem: Problem, fit: Fit, piece: Piece, port: str, reach: float) -> None:
    """Start of memory at `port` that leaves the least error in `piece`: a scan over [-reach, reach], then its best cell halved."""
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
    """Sorts trials by held-out likelihood, with one effective sample size for all, that of the trial with the least error."""
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
    simpler = [t for t in trials if len(t.fit.values) < len(top.fit.values) and t.score > near and related(t.candidate, top.candidate)]
    if simpler:
        best = max(simpler, key=lambda t: (-len(t.fit.values), t.score))
        trials.remove(best)
        trials.insert(0, best)


def of_sampling(trial: Trial) -> bool:
    """Whether a delay or lag of an axis' input is within one sample: that is how the input was held between samples, not physics."""
    if trial.candidate.effect.id not in ("latency", "rate_lag") or not trial.candidate.port.name.endswith("_drive"):
        return False
    return float(trial.fit.values[-1]) < 1.05 * trial.period_s


def related(simple: Candidate, general: Candidate) -> bool:
    """Whether `general` is a finer shape of `simple`, at the same place."""
    a, b = simple.effect, general.effect
    return simple.port.name == general.port.name and (a.id == b.id or a.id in b.contains or bool(a.family and a.family == b.family))


def good_enough(trial: Trial, base: Fit) -> bool:
    """Whether a trial earns its place: likelihood, blocks, size, and agreement of fitted and held-out parts."""
    more = max(len(trial.fit.values) - len(base.values), 0)
    gain = trial.heldout
    least = max(SMALLEST_SHARE, (COARSE if trial.replaced else SMALLEST_EXCESS) * gain.excess)
    return (not at_bound(trial.fit) and not of_sampling(trial) and gain.log_likelihood > ENOUGH + more and gain.p_value < SURE and gain.share > least
            and trial.trained.log_likelihood > ENOUGH + 2.0 * more)


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
        best = finish(problem, minimize(problem, winner.fit.terms, winner.fit.values))
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
