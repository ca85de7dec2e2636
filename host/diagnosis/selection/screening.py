"""Screening: what the signature of each candidate, seen past all active parameters, would take from the residual."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import (
    FAR,
    Fit,
    Problem,
    Term,
    free,
    free_states,
    get_starts,
    grid_points,
    jacobian,
    lines_of,
    moved,
    set_starts,
    size_of,
    starts,
    tuned,
)
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.model.dataset import one_clock
from host.diagnosis.model.effect import Candidate, Evidence, Parameter, Port, Reading, memory_keys, same_place
from host.diagnosis.model.model import Segment, scale_of
from host.diagnosis.model.operators import fill
from host.diagnosis.selection.responses import ResponseFrame, States, pointwise, states_of

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]
SCREEN_ROWS = 24000  # residuals to screen by, about
Slopes = dict[str, list[dict[str, Any]]]  # port -> of every segment that is fitted, what the model linearized there
START_STEP = 0.01  # of a port's RMS motion, by which the state at a recording's first sample is moved
ABSORBED = 1e-10  # share of a response that the active parameters do not explain, below which they absorb it
LARGEST = 30.0  # of a parameter's natural size: a start beyond it is made of what the active parameters hardly leave
LATE_STARTS = 3  # of a delay, in addition to its grid
GRID = 160  # grid points of one candidate where its effect is linearized, without a simulation


def term_of(problem: Problem, candidate: Candidate, fit: Fit, sizes: dict[str, float] | None = None) -> Term:
    """`candidate` with bounds and start values for these recordings. sizes: RMS needs of ports with this fit, kept."""
    sizes = {} if sizes is None else sizes
    if candidate.port.name not in sizes:
        sizes[candidate.port.name] = _need(problem, candidate.port, fit)
    rms = sizes[candidate.port.name]
    scale = scale_of(problem.model, problem.segments, candidate.port, candidate, rms)
    parameters = candidate.effect.parameters(scale, candidate.form)
    if problem.model.either_sign and candidate.effect.slots is not None and not candidate.port.against:
        nominal = fit.values[: len(problem.model.parameters)]
        own = {p.name: float(value) for p, value in zip(problem.model.parameters, nominal, strict=True)}
        parameters = tuple(_either(p, own) if p.linear and p.low == 0.0 else p for p in parameters)
    return Term(candidate, parameters)


def _need(problem: Problem, port: Port, fit: Fit) -> float:
    """RMS of what `port` would have to be moved by, over the samples to fit."""
    n = len(problem.model.parameters)
    needs = [
        problem.model.needs(segment, port, fit.values[:n], residual)[segment.fit]
        for segment, residual in zip(problem.segments, fit.residuals, strict=True)
        if segment.fit.any()
    ]
    together = np.concatenate(needs)
    return float(np.sqrt(np.nanmean(together**2))) if np.isfinite(together).any() else 1.0


def _either(p: Parameter, nominal: dict[str, float]) -> Parameter:
    """`p` of a force that may count either way: both signs, or the one of the `nominal` parameter that it follows."""
    sign = nominal.get(p.follows, 0.0)
    if sign > 0.0:
        return p
    return replace(p, low=-p.high, high=0.0) if sign < 0.0 else replace(p, low=-p.high)


def without(fit: Fit, problem: Problem, drop: tuple[str, ...]) -> tuple[tuple[Term, ...], Array]:
    """Terms and values of `fit` but for the candidates named in `drop`."""
    n = len(problem.model.parameters)
    terms = tuple(term for term in fit.terms if term.candidate.key not in drop)
    return terms, np.concatenate([fit.values[:n], *(fit.values_of(term) for term in terms)])


def replaced_by(fit: Fit, candidate: Candidate) -> tuple[str, ...] | None:
    """Active candidates that `candidate` would replace (it contains them), or None if it may not join."""
    drop = []
    for term in fit.terms:
        other = term.candidate
        if not same_place(other, candidate):
            continue
        if other.effect.spans and other.effect.spans == candidate.effect.spans:
            return None
        if other.effect.id == candidate.effect.id and other.source == candidate.source:
            if other.form == candidate.form and other.effect.order == candidate.effect.order:
                return None
            if candidate.effect.id in other.effect.contains:
                return None
            if not other.effect.several:
                drop.append(other.key)
        elif other.effect.id in candidate.effect.contains or (
            candidate.effect.family and candidate.effect.family == other.effect.family
        ):
            drop.append(other.key)
        elif candidate.effect.id in other.effect.contains:
            return None
    return tuple(drop)


@dataclass
class Screened:
    """A candidate with its promise by projection and the start values that earned it.

    nominal: parameters of all that is fitted already to start from with each of `begin`, where they are not those so far.
    """

    candidate: Candidate
    term: Term
    drop: tuple[str, ...]
    promise: float
    begin: list[Array]
    nominal: list[Array] = field(default_factory=list)


@dataclass
class Point:
    """One grid point: energy taken, start values of the term, and what it leaves."""

    taken: float
    begin: Array
    left: Array
    values: Array | None = None  # parameters of the terms before it, where they were fitted with it
    begun: int = 0  # states that recordings begin from, among what took it
    deepest: bool = False  # whether it is the delay of whole samples that leaves least (`Base.late_s`)


@dataclass
class Base:
    """What is fitted without the effects that a candidate replaces: responses are compared with what it leaves.

    residuals: (rows,), weighted and stacked; Q: (rows, columns), orthonormal, of the rates of all that is fitted.
    slopes: of ports that are linearized. lines: frequencies (Hz) that stand out of the residual.
    """

    problem: Problem
    terms: tuple[Term, ...]
    values: Array
    residuals: Array
    Q: Array
    slopes: Slopes
    lines: Array
    frames: dict[str, ResponseFrame] = field(default_factory=dict)  # of ports where outputs answer sample by sample

    @cached_property
    def rest(self) -> Array:
        """The residuals past all that is fitted: orthogonal to the columns of `Q`."""
        return np.asarray(self.residuals - self.Q @ (self.Q.T @ self.residuals))

    @cached_property
    def energy(self) -> float:
        """Squared error of `rest`."""
        return float(self.rest @ self.rest)

    @cached_property
    def used(self) -> list[Segment]:
        """The recordings to fit, which the stacked residuals are of."""
        return [segment for segment in self.problem.segments if segment.fit.any()]

    @cached_property
    def frame(self) -> ResponseFrame:
        """Responses as the stacked residuals have them."""
        rows = len(self.problem.noise)
        return ResponseFrame(self.Q, self.rest, np.cumsum([0, *(rows * int(segment.fit.sum()) for segment in self.used)]))

    def frame_of(self, port: str) -> ResponseFrame:
        """Responses of the motion at `port` where the outputs answer it sample by sample, else `frame`."""
        if not self.problem.model.pointwise or port not in self.slopes:
            return self.frame
        if port not in self.frames:
            weights = [
                np.where(np.isfinite(segment.y), np.asarray(slope[port]), 0.0)[:, segment.fit] / self.problem.scale[:, None]
                for segment, slope in zip(self.used, self.slopes[port], strict=True)
            ]
            self.frames[port] = pointwise(self.Q, self.rest, weights)
        return self.frames[port]

    def left(self, frame: ResponseFrame, response: Array) -> Array:
        """What `response` (points,) leaves of the residual, past all that is fitted."""
        return np.asarray(self.rest - frame.stacked(response) + self.Q @ (response @ frame.Q))

    @cached_property
    def late_s(self) -> list[float]:
        """Delays (s) at which the simulated outputs and their rates, shifted, leave least of the measured ones.

        The error has a minimum for each period of the motion, and a grid of few delays may miss the right one. Here all
        delays of whole samples are compared: columns X of the outputs and their rates, shifted by d, leave
        y'y - c' (X'X)^-1 c of the measured y, where c(d) = sum over t of y(t) X(t - d) is a correlation.
        """
        longest, columns, first = max(segment.n for segment in self.used) // 4, self.Q.shape[1] + 1, 0
        products, squares = np.zeros((longest, columns)), np.zeros((longest, columns, columns))
        energy, counted = np.zeros(longest), np.zeros(longest)
        for segment in self.used:
            n = int(segment.fit.sum())
            lags = min(longest, n)
            size = 1 << int(np.ceil(np.log2(2 * n)))
            for row in range(len(self.problem.noise)):
                part, first = slice(first, first + n), first + n
                y = np.nan_to_num(segment.y[row, segment.fit] / self.problem.scale[row])
                X = np.column_stack((y - self.residuals[part], self.Q[part]))
                across = np.fft.irfft(np.fft.rfft(y, size) * np.conj(np.fft.rfft(X.T, size)), size)
                products[:lags] += across[:, :lags].T
                squares[:lags] += np.cumsum(X[:, :, None] * X[:, None, :], axis=0)[::-1][:lags]
                energy[:lags] += np.cumsum(y[::-1] ** 2)[::-1][:lags]
                counted[:lags] += n - np.arange(lags)
        scale = np.sqrt(np.einsum("kii->ki", squares) + 1e-300)
        shaped = squares / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(columns)
        weights = np.linalg.solve(shaped, (products / scale)[:, :, None])[:, :, 0]
        left = (energy - np.einsum("ki,ki->k", products / scale, weights)) / np.maximum(counted, 1.0)
        valleys = np.flatnonzero((left[1:-1] < left[:-2]) & (left[1:-1] <= left[2:])) + 1
        best = valleys[np.argsort(left[valleys])[:LATE_STARTS]]
        return [float(lag) * self.problem.segments[0].recording.dt_s for lag in best]


def screen(
    problem: Problem, fit: Fit, candidate_effects: list[Candidate], progress: Progress, known_Hz: tuple[float, ...] = ()
) -> list[Screened]:
    """Promise of every candidate: what its signature, seen past all active parameters, takes from the residual (grid
    search). `known_Hz`: further frequencies to try.
    """
    problem = _smaller(problem)
    r = problem.stacked(fit.terms, fit.values)
    found = []
    bases: dict[tuple[str, ...], Base] = {}
    few = _independent(problem, r)
    sizes: dict[str, float] = {}
    slopes = _slopes(problem, fit)
    used = [
        np.where(segment.fit, r, np.nan)
        for segment, r in zip(problem.segments, fit.residuals, strict=True)
        if segment.fit.any()
    ]
    lines = np.concatenate((known_Hz, lines_of(used, problem.segments[0].recording.dt_s)))
    resting = _resting(problem)
    noisy = problem.noise_fed or problem.passed_share(fit) > problem.rules.noise_passed_share
    for count, candidate in enumerate(candidate_effects):
        progress("screening", count / len(candidate_effects))
        if candidate.effect.cancels_noise and noisy:
            continue
        drop = replaced_by(fit, candidate)
        if drop is None or (candidate.port.name in resting and not candidate.effect.at_rest and not candidate.source):
            continue
        if drop not in bases:
            terms, values = without(fit, problem, drop)
            base = problem.stacked(terms, values) if drop else r
            parameters = problem.parameters(terms)
            J = jacobian(problem, terms, values, base, [size_of(p, v) for p, v in zip(parameters, values, strict=True)])
            begins = free_states(problem, terms, values) if problem.joint_states else None
            if begins is not None:  # states of a linear plant take over what an offset or a ramp does at first
                J = np.hstack((J, begins.rates))
            bases[drop] = Base(problem, terms, values, base, np.linalg.qr(J)[0] if J.shape[1] else J, slopes, lines)
        term = _seeded(problem, fit, term_of(problem, candidate, fit, sizes))
        if not term.parameters or (candidate.effect.joins and _absorbs(bases[drop], term)):
            continue
        points = _scan(bases[drop], term)
        if not points:
            continue
        points.sort(key=lambda point: point.taken, reverse=True)
        reference = float(r @ r)
        left = max(bases[drop].energy - points[0].taken, 1e-300)
        n_eff = max(few, _independent(problem, points[0].left)) if reference > 1.05 * left else few
        promise = 0.5 * n_eff * np.log(reference / left) - term.fitted - points[0].begun
        # One step from a wrong delay may take more than one from the right delay, whose rates have farther to go.
        points.sort(key=lambda point: not point.deepest)
        nominal = [point.values for point in points[:2] if point.values is not None]
        begin = [point.begin for point in points[: len(nominal) or 3]]
        found.append(Screened(candidate, term, drop, float(promise), begin, nominal))
    return sorted(found, key=lambda item: item.promise, reverse=True)


def _absorbs(base: Base, term: Term) -> bool:
    """Whether the nominal parameters absorb one of the effects that `term` joins: then it is the other one alone."""
    for p in term.parameters:
        amplitude = {q.name: size_of(q, 0.0) if q is p else 0.0 for q in term.parameters}
        trial = np.concatenate((base.values, starts(term, amplitude, {})))
        change = base.residuals - base.problem.stacked((*base.terms, term), trial)
        left = change - base.Q @ (base.Q.T @ change)
        if float(left @ left) <= ABSORBED * float(change @ change):
            return True
    return False


def _resting(problem: Problem) -> set[str]:
    """Ports at which nothing ever moves: no effect that is made of their motion can be seen there."""
    found = set()
    for port in problem.model.ports:
        if port.kind.startswith("motion"):
            spans = [
                np.ptp(problem.model.motion(segment, port)[segment.fit]) for segment in problem.segments if segment.fit.any()
            ]
            sizes = [np.max(np.abs(problem.model.motion(segment, port))) for segment in problem.segments]
            if max(spans) <= 1e-9 * max(sizes):
                found.add(port.name)
    return found


def _slopes(problem: Problem, fit: Fit) -> Slopes:
    """Ports at which the model answers without a simulation, with what it needs for that."""
    parted = problem.parted(fit.terms, fit.values)
    found = [problem.model.slopes(segment, *parted) for segment in problem.segments if segment.fit.any()]
    return {name: found for name in found[0] if all(name in each for each in found)}


def _fast(base: Base, term: Term, trial: Array) -> Array:
    """Weighted change of the outputs by `term`, the last one of `trial`, linearized at its axis: (points,) of its frame."""
    problem, n, port = base.problem, len(base.problem.model.parameters), term.candidate.port.name
    values, frame, rows = trial[-len(term.parameters) :], base.frame_of(port), []
    if frame.units:
        moved = [problem.model.moved(segment, trial[:n], term.candidate, values)[segment.fit] for segment in base.used]
        return frame.of_motion(moved)
    for segment, S in zip(base.used, base.slopes[port], strict=True):
        change = problem.model.change(segment, trial[:n], S, term.candidate, values)
        rows.append(np.where(np.isfinite(segment.y), change, 0.0)[:, segment.fit] / problem.scale[:, None])
    return np.concatenate([row.ravel() for row in rows])


def enough(problem: Problem) -> Problem:
    """The problem with enough recordings to fit, spread over all; the others neither fitted nor simulated."""
    used = [index for index, segment in enumerate(problem.segments) if segment.fit.any()]
    count = max(
        1, min(len(used), int(np.ceil(problem.model.screen_samples / max(problem.segments[index].n for index in used))))
    )
    chosen = {used[round(k)] for k in np.linspace(0, len(used) - 1, count)}
    segments = [
        segment if index in chosen else replace(segment, fit=np.zeros(segment.n, dtype=bool))
        for index, segment in enumerate(problem.segments)
    ]
    return replace(problem, segments=segments)


def above_noise(problem: Problem, fit: Fit, factor: float) -> bool:
    """Whether `fit` leaves more than `factor` times the noise of some output, in samples to fit and held out alike."""
    for row, noise in enumerate(problem.noise):
        powers = []
        for which in ("fit", "heldout"):
            pairs = zip(problem.segments, fit.residuals, strict=True)
            left = np.concatenate([r[row][getattr(segment, which) & np.isfinite(r[row])] for segment, r in pairs])
            powers.append(float(np.mean(left**2)) if left.size else np.inf)
        if min(powers) > (factor * noise.sigma) ** 2:
            return True
    return False


def _smaller(problem: Problem) -> Problem:
    """Few recordings, every so many samples of them: enough to screen by."""
    few = enough(problem)
    stride = max(1, int(sum(segment.fit.sum() for segment in few.segments) * len(problem.noise) / SCREEN_ROWS))
    segments = [replace(segment, fit=segment.fit & (np.arange(segment.n) % stride == 0)) for segment in few.segments]
    return replace(problem, segments=segments)


def _independent(problem: Problem, left: Array) -> float:
    """Independent samples to fit in what would be `left`, weighted and stacked."""
    total, at, rows = 0.0, 0, len(problem.noise)
    for segment in problem.segments:
        n = int(segment.fit.sum())
        for row in left[at : at + rows * n].reshape(rows, n) if n else ():
            used = int(np.count_nonzero(row))
            total += used / correlation_time(np.where(row != 0.0, row, np.nan)) if used else 0.0
        at += rows * n
    return total


def _seeded(problem: Problem, fit: Fit, term: Term) -> Term:
    """`term` with the start values that its effect reads from the residual, if it does."""
    seeds = term.candidate.effect.seeds
    if seeds is None or not term.parameters:
        return term
    n = len(problem.model.parameters)
    used = [pair for pair in zip(problem.segments, fit.residuals, strict=True) if pair[0].fit.any()]
    readings = []
    for segment, residual in used:
        for row, output in enumerate(problem.model.outputs):
            good = segment.fit & np.isfinite(residual[row])
            course = segment.y[row] - residual[row]
            left, scale = residual[row][good], float(problem.scale[row])
            readings.append(Reading(output.unit, course[good], left, scale, fill(course)))
    needs = [problem.model.needs(segment, term.candidate.port, fit.values[:n], r)[segment.fit] for segment, r in used]
    times = [segment.recording.time_s[segment.fit] for segment, _ in used]
    shared = len(used) == 1 or one_clock([segment.recording for segment, _ in used])
    read = {output.channel for output in problem.model.outputs}
    others = tuple(
        tuple(fill(x) for name, x in segment.recording.channels.items() if name not in read and np.isfinite(x).any())
        for segment, _ in used
    )
    evidence = Evidence(tuple(times), tuple(needs), tuple(readings), shared, others)
    return replace(term, parameters=seeds(evidence, term.parameters, term.candidate.form))


def _scan(base: Base, term: Term) -> list[Point]:
    """Compute the response of `term` at each grid point.

    A term with memory gets the state that each recording begins from as further unknowns, and pays for them.
    """
    problem, values, terms = base.problem, base.values, (*base.terms, term)
    points: list[Point] = []
    most_taken = 0.0
    linear = [p for p in term.parameters if p.linear]
    fast, frame = term.candidate.port.name in base.slopes, base.frame_of(term.candidate.port.name)
    shifts = not linear and not fast and term.candidate.effect.shifts == "time"
    each = len(values) + 2 if shifts else max(len(linear), 1)  # simulations of one point
    most = GRID if fast else problem.model.scan_points
    tried, deepest = [*grid_points(tuned(term, base.lines), max(5, most // each))], {}
    if shifts and len(term.parameters) == 1 and term.parameters[0].dead_time:
        p = term.parameters[0]
        late = [{p.name: late_s} for late_s in base.late_s if p.low < late_s < p.high]
        tried, deepest = [*tried, *late], late[0] if late else {}
    for point in tried:
        columns = []
        options: list[Any] = [*linear] or [None]
        for p in options:
            amplitude = {q.name: 0.0 for q in linear}
            if p is not None:
                amplitude[p.name] = size_of(p, 0.0)
            trial = np.concatenate((values, starts(term, amplitude, point)))
            columns.append(_fast(base, term, trial) if fast else base.residuals - _known(base, terms, trial))
        states = states_of(frame, _begun(base, term, trial, columns[-1] if fast else None))
        begun = len(states.best)
        if shifts:
            again = _absorbed(base, terms, trial, states)
            if again is not None:
                found, left = again
                taken = base.energy - float(left @ left)
                own = point is deepest
                points.append(Point(taken, found[values.size :], left, found[: values.size], begun, own))
            continue
        if term.candidate.effect.memories:  # it is nothing but what each recording begins with
            left = base.left(frame, states.best @ states.responses)
            points.append(Point(states.taken, starts(term, {}, point), left, None, begun))
            continue
        D = np.array(columns)
        energy, B = np.einsum("rp,rp->r", D, D), D @ frame.Q
        N = states.along(D, B)
        G, g = D @ D.T - B @ B.T - N @ states.inverse @ N.T, D @ frame.rest - N @ states.best
        size = np.sqrt(np.maximum(np.diag(G), 1e-300))
        if not np.all(np.isfinite(G)) or float(np.max(np.diag(G) / (energy + 1e-300))) < ABSORBED:
            continue
        a = _solved(G / np.outer(size, size), g / size) / size
        if linear:
            a = np.clip(a, -LARGEST, LARGEST)
            a = np.array(
                [min(max(x * size_of(p, 0.0), p.low), p.high) / size_of(p, 0.0) for x, p in zip(a, linear, strict=True)]
            )
        elif not 0.2 < a[0] < 5.0:
            continue
        taken = float(2.0 * a @ g - a @ G @ a) + states.taken
        amplitude = {p.name: float(x) * size_of(p, 0.0) for x, p in zip(a, linear, strict=False)}
        left = base.rest
        if taken > most_taken:
            most_taken = taken
            left = base.left(frame, a @ D + (states.best - states.inverse @ (a @ N)) @ states.responses)
        points.append(Point(taken, starts(term, amplitude, point), left, None, begun))
    return points


def _solved(G: Array, g: Array) -> Array:
    """Least squares by normal equations of unit diagonal."""
    return g if g.size == 1 else np.asarray(np.linalg.lstsq(G, g, rcond=1e-10)[0])


def _known(base: Base, terms: tuple[Term, ...], trial: Array) -> Array:
    """Residuals of `trial`; those of `base` where a dead time makes them of what was before the recording."""
    r = base.problem.stacked(terms, trial, unseen=np.inf)
    return np.where(r >= FAR, base.residuals, r)


def _begun(base: Base, term: Term, trial: Array, now: Array | None) -> Array:
    """What the states at recordings' first samples do of the memory of `term`: (states, points) of its frame.

    They and the term share the residual. Without them an effect with a long memory is taken for what it would be if the
    first samples had told its state.

    now: the term's response with the states so far, where the model answers without a simulation.
    """
    problem, candidate = base.problem, term.candidate
    port, frame = candidate.port.name, base.frame_of(candidate.port.name)
    if not candidate.effect.remembers or not candidate.effect.timed:
        return np.zeros((0, frame.rest.size))  # a memory of places, not of times, is soon overwritten
    before, keys, used = get_starts(problem), memory_keys(candidate), base.used
    spread = (
        float(np.std(np.concatenate([problem.model.motion(segment, candidate.port)[segment.fit] for segment in used])))
        or 1.0
    )

    def response() -> Array:
        if port in base.slopes:
            return _fast(base, term, trial)
        return -problem.stacked((*base.terms, term), trial)

    now = response() if now is None else now
    rows = np.zeros((len(keys) * len(used), now.size))
    for number, key in enumerate(keys):
        for segment in used:
            segment.start[key] = segment.start.get(key, 0.0) + START_STEP * spread
        change = response() - now
        set_starts(problem, before)
        for index, (first, last) in enumerate(itertools.pairwise(frame.edges)):
            rows[number * len(used) + index, first:last] = change[first:last]
    return rows


def _absorbed(base: Base, terms: tuple[Term, ...], trial: Array, states: States) -> tuple[Array, Array] | None:
    """All parameters fitted again from a shift in time at a grid point, and the residual then; None where they cannot be.

    Rates of the nominal model take most of a small delay. Next to one that is fitted they have to give it back first: a
    change of the outputs at their present values says nothing then. Effects that are named already stay as they are where
    that leaves less. So does the shift itself, or else it moves: a delay of a part of a sample lies between the points of
    the grid.
    """
    problem, r = base.problem, _known(base, terms, trial)
    S = np.linalg.qr(states.responses.T - base.Q @ states.rates.T)[0]  # orthonormal, past all that is fitted
    parameters = problem.parameters(terms)
    sizes = [size_of(p, v) for p, v in zip(parameters, trial, strict=True)]
    J, aim = jacobian(problem, terms, trial, problem.stacked(terms, trial), sizes), r - S @ (S.T @ r)
    J -= S @ (S.T @ J)
    before = len(free(problem.parameters(terms[:-1])))
    own = len(free(problem.parameters(())))  # of the nominal model alone: the corner of a limit follows no rate so far
    if not np.all(np.isfinite(J)):
        return None
    ends = []
    for columns in dict.fromkeys((before, J.shape[1], own)):
        by = np.linalg.lstsq(J[:, :columns], aim, rcond=1e-10)[0]
        found = trial.copy()
        for index, step in zip(free(parameters), by, strict=False):
            found[index] = moved(parameters[index], trial[index], float(step), index >= len(problem.model.parameters))
        left = _known(base, terms, found)
        ends.append((found, left - S @ (S.T @ left)))
    return min(ends, key=lambda end: float(end[1] @ end[1]))
