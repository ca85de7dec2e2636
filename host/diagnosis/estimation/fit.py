"""Free-run simulation-error fits: robust Levenberg-Marquardt on scaled parameters, all recordings jointly."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from host.diagnosis.estimation.evidence import Gain, compare
from host.diagnosis.estimation.noise import Noise, correlation_time
from host.diagnosis.estimation.rules import RULES, Budget, SelectionRules
from host.diagnosis.model.effect import Candidate, Parameter, Port, cornered
from host.diagnosis.model.model import ActiveEffect, Model, Segment

Array = npt.NDArray[np.float64]
RAN_AWAY = 1e12  # residual, in units of noise, beyond which a simulation has run away
HUBER = 4.0  # residuals beyond this many scales pull with constant force
ENDLESS = 1e150  # output of a simulation that ran away: its square is still a number
FAR = 1e6  # residual, in units of noise, at which those of a fit are cut
LARGEST_AMPLITUDE = 1000.0  # of an effect, in natural sizes
BEGIN = "begin:"  # key of a state that a recording begins from, among its starts of memory
WAIT = 1.3  # of a dead time's start value: so much of a recording is left out while it is fitted
RATE_STEP = 1e-3  # of a parameter in its own scale, for differences
MODE_LINES = 3  # highest lines of the residual at which a mode is tried, before its grid


@dataclass(frozen=True)
class Term:
    """An active effect with its parameter declarations."""

    candidate: Candidate
    parameters: tuple[Parameter, ...]

    @property
    def fitted(self) -> int:
        """Return how many of its parameters are fitted: a middle or a range that the recordings give costs no evidence.

        An instant counts twice: it is chosen among all samples (modified BIC, Zhang and Siegmund 2007).
        """
        return sum(2 if self.parameters[index].event else 1 for index in free(list(self.parameters)))


@dataclass
class Fit:
    """A structure with fitted values. `values`: nominal parameters, then those of each term."""

    terms: tuple[Term, ...]
    values: Array
    residuals: list[Array] = field(default_factory=list)  # per segment (outputs, n): measured - simulated
    cost: float = np.inf

    @property
    def names(self) -> tuple[str, ...]:
        """Return the keys of the active candidates."""
        return tuple(term.candidate.key for term in self.terms)

    @property
    def fitted(self) -> int:
        """Return how many parameters of its effects are fitted. The nominal ones are those of every structure."""
        return sum(term.fitted for term in self.terms)

    def values_of(self, term: Term) -> Array:
        """Return the values of `term`, which is one of `terms` itself, not one equal to it."""
        first = self.first_of(term)
        return self.values[first : first + len(term.parameters)]

    def first_of(self, term: Term) -> int:
        """Return the index of the first of these values among all."""
        place = next(index for index, other in enumerate(self.terms) if other is term)
        return len(self.values) - sum(len(other.parameters) for other in self.terms[place:])


@dataclass
class Problem:
    """A model, its prepared recordings and the noise of each output. `scale` (outputs,) weighs residuals."""

    model: Model
    segments: list[Segment]
    noise: list[Noise]
    scale: Array
    columns: dict[str, str] = field(default_factory=dict)  # channel -> column, for equations
    rules: SelectionRules = RULES
    budget: Budget = field(default_factory=Budget)
    joint_states: bool = False  # whether parameters and initial states are fitted together: the model is a linear path
    noise_fed: bool = False  # the residual is mostly noise that a controller fed back (`find_feedback`)
    noise_passed: float = 0.0  # share of the residual's variance that is noise of measured inputs, through the nominal law,
    passed: Array = field(default_factory=lambda: np.zeros(0))  # and its variance in each output (outputs,)
    waits_s: float = 0.0  # time from the first sample on that is left out at least, while a dead time is fitted
    ends_s: float = 0.0  # and before the last one, while the drift of a clock is
    recorded_s: float = 0.0  # period of the samples as recorded, of which several may be averaged into one; 0: untimed

    @property
    def apart(self) -> bool:
        """Return whether whole recordings are held out, not blocks between the fitted ones."""
        return any(segment.heldout.any() and not segment.fit.any() for segment in self.segments)

    @property
    def noise_sd(self) -> Array:
        """Return the standard deviation of each output's noise (outputs,), in its own unit."""
        return np.array([noise.sigma for noise in self.noise])

    def passed_share(self, fit: Fit) -> float:
        """Share of what `fit` leaves that is noise of measured inputs, in the output where that is most."""
        if not self.passed.any():
            return 0.0
        power = np.sum([np.nansum(r**2, axis=1) for r in fit.residuals], axis=0)
        samples = np.sum([np.sum(np.isfinite(r), axis=1) for r in fit.residuals], axis=0)
        return float(np.max(np.minimum(self.passed * samples / np.maximum(power, 1e-300), 1.0)))

    def reading_step(self, row: int) -> float:
        """Step in which an output is read; 0 where none is seen."""
        steps = [float(segment.resolution[row]) for segment in self.segments if segment.resolution is not None]
        return math.sqrt(12.0) * max(steps, default=0.0)

    def gain(self, which: str, before: list[Array], after: list[Array], segments: list[Segment] | None = None) -> Gain:
        """Gain of the residuals `after` over `before` on samples `which` (`fit`, `heldout`, `both`), see `compare`.

        segments: those that the residuals belong to, where they are not all of the problem's own.
        """
        return compare(self.segments if segments is None else segments, which, before, after, self.noise_sd, self.rules)

    def parameters(self, terms: tuple[Term, ...]) -> list[Parameter]:
        """All parameters of a structure, nominal first."""
        return [*self.model.parameters, *(p for term in terms for p in term.parameters)]

    def simulate(self, segment: Segment, terms: tuple[Term, ...], values: Array) -> Array:
        """Outputs (outputs, n) of one recording."""
        return self.simulate_all([segment], terms, values)[0]

    def simulate_all(self, segments: list[Segment], terms: tuple[Term, ...], values: Array) -> list[Array]:
        """Outputs (outputs, n) of several recordings; a simulation that ran away is far from every recording.

        Where a sensor is read more seldom than it is logged, its simulated readings are repeated as the recorded ones are.
        """
        found = [_bounded(out) for out in self.model.simulate_all(segments, *self.parted(terms, values))]
        for segment, out in zip(segments, found, strict=True):
            for row, places in segment.repeats.items():
                out[row] = out[row, places]
        return found

    def parted(self, terms: tuple[Term, ...], values: Array) -> tuple[Array, list[ActiveEffect]]:
        """Nominal parameters, and every effect with its own."""
        at = len(self.model.parameters)
        nominal, active = values[:at], []
        for term in terms:
            active.append((term.candidate, values[at : at + len(term.parameters)]))
            at += len(term.parameters)
        return nominal, active

    def passive(self, fit: Fit) -> bool:
        """Whether no part of the law with the effects of `fit` is a mass, damper or spring below zero."""
        return self.model.passive(*self.parted(fit.terms, fit.values))

    def late_s(self, terms: tuple[Term, ...], values: Array) -> float:
        """Dead time of all terms together (s)."""
        return sum(max(dead_s, 0.0) for dead_s in self._dead_times_s(terms, values))

    def unseen(self, segment: Segment, terms: tuple[Term, ...], values: Array, dead_s: float | None = None) -> int:
        """First samples (number) that a dead time makes of what was before the recording: nothing can predict them.

        dead_s: `late_s` of these terms, where it is known already.
        """
        late_s = max(self.late_s(terms, values) if dead_s is None else dead_s, self.waits_s)
        late = math.ceil(late_s / segment.recording.dt_s - 1e-9) + segment.spread  # a test function reaches so far back
        return min(late, segment.n // 2) if late_s > 0.0 else 0

    def early_s(self, terms: tuple[Term, ...], values: Array) -> float:
        """Time (s) by which leads, and clocks that run faster, are ahead at the end of a recording, at most."""
        used = [segment for segment in self.segments if segment.fit.any()]
        return self.lead_s(terms, values) + max((_ahead_s(segment, terms, values) for segment in used), default=0.0)

    def lead_s(self, terms: tuple[Term, ...], values: Array) -> float:
        """Lead of all terms together (s): dead times below zero."""
        return sum(max(-dead_s, 0.0) for dead_s in self._dead_times_s(terms, values))

    def _dead_times_s(self, terms: tuple[Term, ...], values: Array) -> list[float]:
        return [float(value) for p, value in zip(self.parameters(terms), values, strict=True) if p.dead_time]

    def ends(self, segment: Segment, terms: tuple[Term, ...], values: Array) -> int:
        """Last samples (number) that a lead, or a clock which runs faster, makes of what came after the recording."""
        early_s = max(self.lead_s(terms, values) + _ahead_s(segment, terms, values), self.ends_s)
        return min(math.ceil(early_s / segment.recording.dt_s - 1e-9), segment.n // 2) if early_s > 0.0 else 0

    def left(self, segment: Segment, terms: tuple[Term, ...], values: Array, out: Array | None = None) -> Array:
        """Measured minus simulated (outputs, n), NaN where nothing was measured or nothing can be predicted.

        out: the simulation, where it is known already.
        """
        r = segment.y - (self.simulate(segment, terms, values) if out is None else out)
        r[:, : self.unseen(segment, terms, values)] = np.nan
        r[:, segment.n - self.ends(segment, terms, values) :] = np.nan
        return np.asarray(r)

    def needs(self, fit: Fit, port: Port) -> list[Array]:
        """The displacement or force (n,) of each recording that `port` would need to explain what `fit` leaves."""
        nominal = fit.values[: len(self.model.parameters)]
        pairs = zip(self.segments, fit.residuals, strict=True)
        return [self.model.needs(segment, port, nominal, r) for segment, r in pairs]

    def residuals(self, terms: tuple[Term, ...], values: Array, which: str = "fit") -> list[Array]:
        """Measured minus simulated, NaN outside the requested part (`fit`, `heldout` or `all`)."""
        out = []
        for segment in self.segments:
            mask = np.ones(segment.n, dtype=bool) if which == "all" else getattr(segment, which)
            if not mask.any():
                out.append(np.full_like(segment.y, np.nan))
                continue
            out.append(np.where(mask, self.left(segment, terms, values), np.nan))
        return out

    def stacked(self, terms: tuple[Term, ...], values: Array, unseen: float = 0.0) -> Array:
        """Weighted residuals of the samples to fit, one vector; missing samples are zero.

        unseen: of samples that nothing can predict.
        """
        rows = []
        used = [segment for segment in self.segments if segment.fit.any()]
        dead_s = self.late_s(terms, values)
        for segment, out in zip(used, self.simulate_all(used, terms, values), strict=True):
            first = self.unseen(segment, terms, values, dead_s)
            last = segment.n - self.ends(segment, terms, values)
            rows.append(_weighted(segment.y, np.ascontiguousarray(out), segment.fit, self.scale, first, last, unseen))
        return np.concatenate(rows)

    def seen_share(self, terms: tuple[Term, ...], values: Array) -> float:
        """Share of the samples to fit that can be predicted: the others are behind a dead time at a recording's begin."""
        used = [segment for segment in self.segments if segment.fit.any()]
        hidden = sum(int(segment.fit[: self.unseen(segment, terms, values)].sum()) for segment in used)
        hidden += sum(int(segment.fit[segment.n - self.ends(segment, terms, values) :].sum()) for segment in used)
        return 1.0 - hidden / max(sum(int(segment.fit.sum()) for segment in used), 1)


@njit(cache=True)
def _bounded(out: Array) -> Array:
    """`out` (outputs, n) with a large number wherever the simulation ran away, or gave no number."""
    found = np.empty(out.shape)
    for row in range(out.shape[0]):
        for i in range(out.shape[1]):
            found[row, i] = out[row, i] if abs(out[row, i]) < ENDLESS else ENDLESS
    return found


@njit(cache=True, error_model="numpy")
def _weighted(
    measured: Array, out: Array, fit: npt.NDArray[np.bool_], scale: Array, first: int, last: int, unseen: float
) -> Array:
    """Residuals (outputs * samples to fit,) over `scale`, cut at FAR; 0 where nothing was measured, and `unseen` before
    sample `first` and from `last` on.
    """
    found = np.empty(measured.shape[0] * int(np.sum(fit)))
    at = 0
    for row in range(measured.shape[0]):
        for i in range(measured.shape[1]):
            if not fit[i]:
                continue
            r = (measured[row, i] - out[row, i]) / scale[row]
            if i < first or i >= last:
                r = unseen if np.isfinite(measured[row, i]) else 0.0
            found[at] = 0.0 if np.isnan(r) else min(max(r, -FAR), FAR)
            at += 1
    return found


def _ahead_s(segment: Segment, terms: tuple[Term, ...], values: Array) -> float:
    """Time (s) by which clocks that run faster, by `values`, are ahead at the end of `segment`."""
    last_s, ahead_s, first = float(segment.recording.time_s[-1]), 0.0, len(values)
    for term in reversed(terms):
        first -= len(term.parameters)
        if term.candidate.effect.shifts == "rate":
            rate, agree_s = float(values[first]), float(values[first + 1]) if len(term.parameters) > 1 else 0.0
            ahead_s = max(ahead_s, -rate * (last_s - agree_s))
    return ahead_s


def free(parameters: list[Parameter]) -> list[int]:
    """Indices of parameters that may move."""
    return [index for index, p in enumerate(parameters) if p.high > p.low]


def size_of(p: Parameter, value: float) -> float:
    """Natural size of a signed parameter."""
    if p.step > 0.0:
        return p.step
    return max(abs(value), max((abs(g) for g in p.grid), default=0.0)) or 1.0


def moved(p: Parameter, value: float, by: float, of_effect: bool) -> float:
    """`value` moved by `by` in the parameter's own scale, kept in bounds and finite.

    Where a simulation has diverged, no parameter changes it and the step of least squares has no bound. Amplitudes of an
    effect stay within multiples of their natural size: two jumps a sample apart, or two forces along a direction that no
    output shows, cancel each other at any size, and a simulator that gets such inputs may take very long.
    """
    new = value * np.exp(np.clip(by, -3.0, 3.0)) if p.log else value + float(np.clip(by, -FAR, FAR)) * size_of(p, value)
    if of_effect and p.linear:
        most = max(LARGEST_AMPLITUDE * size_of(p, 0.0), abs(value))
        new = min(max(new, -most), most)
    return float(min(max(new, p.low), p.high))


def jacobian(problem: Problem, terms: tuple[Term, ...], values: Array, base: Array, sizes: list[float]) -> Array:
    """Rate of the weighted simulation by each free parameter in its own scale, by one-sided differences that stay in
    bounds.
    """
    moving = free(problem.parameters(terms))
    columns = [rate(problem, terms, values, base, index, sizes[index]) for index in moving]
    return np.array(columns).T if columns else np.zeros((base.size, 0))


def rate(problem: Problem, terms: tuple[Term, ...], values: Array, base: Array, index: int, size: float) -> Array:
    """Rate (samples,) of the weighted simulation by the parameter `index`, as in `jacobian`. base: stacked residuals."""
    p, changed = problem.parameters(terms)[index], values.copy()
    step = RATE_STEP if p.log else RATE_STEP * size
    up = values[index] * (1.0 + step) if p.log else values[index] + step
    down = values[index] * (1.0 - step) if p.log else values[index] - step
    changed[index] = up if up <= p.high else down
    by = (changed[index] / values[index] - 1.0) if p.log else (changed[index] - values[index]) / size
    return np.asarray((base - problem.stacked(terms, changed)) / by)


def parameter_rates(problem: Problem, fit: Fit, segment: Segment) -> Array:
    """Change (k, outputs, n) of what `fit` simulates of a recording, per step of each free nominal parameter."""
    base, rates = problem.simulate(segment, fit.terms, fit.values), []
    for index in free(list(problem.model.parameters)):
        p, values = problem.model.parameters[index], fit.values.copy()
        step = RATE_STEP * (abs(values[index]) if p.log else size_of(p, values[index]))
        values[index] += step if values[index] + step <= p.high else -step
        by = (values[index] - fit.values[index]) / step
        rates.append((problem.simulate(segment, fit.terms, values) - base) / by)
    return np.array(rates) if rates else np.zeros((0, *base.shape))


def robust(r: Array) -> tuple[float, Array]:
    """Return the Huber cost of residuals (n,) and the square roots of their weights (n,)."""
    size = np.abs(r)
    inside = size <= HUBER
    cost = float(np.sum(np.where(inside, 0.5 * r * r, HUBER * size - 0.5 * HUBER**2)))
    return cost, np.sqrt(np.where(inside, 1.0, HUBER / np.maximum(size, 1e-300)))


@dataclass(frozen=True)
class FreeStates:
    """Rates (m, k) of the weighted residuals by all initial states that are fitted, and their estimate from residuals.

    A state and a parameter can cause much the same (the first speed of a free mass, and its gain). Estimated in turn, each
    takes over the error of the other and neither moves far. Residuals `freed` of what a change of the states explains are
    those of the states that belong to the parameters tried (variable projection; Golub and Pereyra 2003). A state that is
    measured is held by its variance, in the units of `estimate_state`.
    """

    rates: Array
    gains: Array  # (k, m): estimate of the change of the states from residuals
    pull: Array  # (k,): change towards the measured states without residuals
    away: Array  # (k,): states less the measured ones, in standard deviations
    weight: Array  # (k,): of a standard deviation, in the units of the residuals

    def freed(self, r: Array) -> Array:
        """Residuals (m + k,) without what a change of the initial states explains, and how far these are from measured."""
        change = self.gains @ r + self.pull
        return np.concatenate((r - self.rates @ change, self.weight * (self.away + change)))

    def freed_rates(self, J: Array) -> Array:
        """Rates (m + k, p) of freed residuals by the parameters."""
        change = self.gains @ J
        return np.vstack((J - self.rates @ change, self.weight[:, None] * change))


def answers_to_begin(
    problem: Problem, terms: tuple[Term, ...], values: Array, base: Array, segment: Segment
) -> list[tuple[int, Array]]:
    """Change of the weighted simulation by each unknown state that a recording begins with, for one standard deviation.

    base: stacked residuals with the states as they are. Where the simulation runs away from there, as that of a loop that
    saturates may, the state moves by a thousandth; if it runs away even so, the change is zero.
    """
    begin = segment.begin
    if begin is None:
        return []
    out, now = [], begin.values
    for k in problem.model.begins_with(segment, *problem.parted(terms, values)):
        column = np.zeros(base.size)
        for share in (1.0, 1e-3):
            begin.values = now + np.eye(now.size)[k] * share * begin.spread[k]
            moved = problem.stacked(terms, values)
            if float(np.max(np.abs(moved), initial=0.0)) < FAR:
                column = (base - moved) / share
                break
        out.append((int(k), column))
    begin.values = now
    return out


def free_states(problem: Problem, terms: tuple[Term, ...], values: Array) -> FreeStates | None:
    """Initial states that are estimated, linearized where they are now; None if no recording has any."""
    base = problem.stacked(terms, values)
    columns, away, levels, at, rows = [], [], [], 0, len(problem.model.outputs)
    for segment in problem.segments:
        part = slice(at, at + rows * int(segment.fit.sum()))
        at, begin = part.stop, segment.begin
        if part.start == part.stop or begin is None or not begin.estimated:
            continue
        left = base[part].reshape(rows, -1)
        level = float(np.mean([np.mean(row**2) * correlation_time(row) for row in left]))
        for k, column in answers_to_begin(problem, terms, values, base, segment):
            columns.append(column)
            away.append((begin.values[k] - begin.measured[k]) / begin.spread[k])
            levels.append(level)
    if not columns:
        return None
    S, prior = np.array(columns).T, np.array(levels)
    inverse = np.linalg.pinv(S.T @ S + np.diag(prior), rcond=1e-13, hermitian=True)
    return FreeStates(S, inverse @ S.T, -inverse @ (prior * np.array(away)), np.array(away), np.sqrt(prior))


def minimize(
    problem: Problem,
    terms: tuple[Term, ...],
    start: Array,
    rounds: int = 40,
    tolerance: float = 1e-7,
    states: bool = False,
) -> Fit:
    """Values that minimize the Huber cost of the weighted simulation error, from `start`.

    A dead time hides the first samples, a lead and a clock that runs faster the last ones. How many is held while they are
    fitted: the cost would jump with each of them.
    states: whether initial states follow the values tried; they are not changed, the caller estimates them again.
    """
    late = any(p.dead_time for term in terms for p in term.parameters)
    drifts = any(term.candidate.effect.shifts == "rate" for term in terms)
    if problem.waits_s == 0.0 == problem.ends_s and (late or drifts):
        dt_s = problem.segments[0].recording.dt_s
        for _ in range(3):
            waits_s = WAIT * problem.late_s(terms, start) + 3.0 * dt_s if late else 0.0
            early_s = problem.early_s(terms, start)
            ends_s = WAIT * early_s + 3.0 * dt_s if drifts or early_s > 0.0 else 0.0
            held = replace(problem, waits_s=waits_s, ends_s=ends_s)
            fit = minimize(held, terms, start, rounds, tolerance, states)
            fit.cost /= max(held.seen_share(terms, start), 1e-3)  # that a longer dead time gains nothing by hiding samples
            start = fit.values
            if problem.late_s(terms, start) <= waits_s + 1e-12 and problem.early_s(terms, start) <= ends_s + 1e-12:
                break
        return fit
    parameters, nominal = problem.parameters(terms), len(problem.model.parameters)
    values = np.array([min(max(v, p.low), p.high) for v, p in zip(start, parameters, strict=True)])
    moving = free(parameters)
    begins = free_states(problem, terms, values) if states and moving else None
    raw = problem.stacked(terms, values)
    r = raw if begins is None else begins.freed(raw)
    cost, w = robust(r)
    damping = 1e-3
    for _ in range(rounds if moving else 0):
        sizes = [size_of(p, v) for p, v in zip(parameters, values, strict=True)]
        J = jacobian(problem, terms, values, raw, sizes)
        J = J if begins is None else begins.freed_rates(J)
        A, g = (J * w[:, None]).T @ (J * w[:, None]), J.T @ (w * w * r)
        diagonal = np.maximum(np.diag(A), 1e-12 * (np.max(np.diag(A)) + 1e-300))
        better = False
        for _ in range(8):
            by = _solve(A, g, diagonal, damping)
            trial = values.copy()
            for place, index in enumerate(moving):
                p = parameters[index]
                # A nominal parameter may be any number of natural sizes away: its columns may be in another unit.
                trial[index] = (
                    moved(p, values[index], by[place], of_effect=True)
                    if p.log or index >= nominal
                    else min(max(values[index] + by[place] * sizes[index], p.low), p.high)
                )
            raw_new = problem.stacked(terms, trial)
            r_new = raw_new if begins is None else begins.freed(raw_new)
            cost_new, w_new = robust(r_new)
            if cost_new < cost:
                better = True
                break
            damping = max(damping * 6.0, 1e-6)
        if not better:
            break
        gained = (cost - cost_new) / cost
        values, raw, r, cost, w = trial, raw_new, r_new, cost_new, w_new
        damping = max(damping / 8.0, 1e-9)
        if gained < tolerance:
            break
    return Fit(terms, values, cost=cost)


def _solve(A: Array, g: Array, diagonal: Array, damping: float) -> Array:
    scale = np.sqrt(diagonal)
    M = A / np.outer(scale, scale) + damping * np.eye(A.shape[0])
    return np.asarray(np.linalg.lstsq(M, g / scale, rcond=1e-13)[0] / scale)


def reweigh(problem: Problem, fit: Fit) -> None:
    """Scale of each output: what this fit leaves, robustly, but no less than the noise."""
    left: list[list[Array]] = [[] for _ in problem.model.outputs]
    for segment in problem.segments:
        if segment.fit.any():
            r = problem.left(segment, fit.terms, fit.values)
            for row, rest in zip(r[:, segment.fit], left, strict=True):
                rest.append(row[np.isfinite(row)])
    for index, rest in enumerate(left):
        together = np.concatenate(rest) if rest else np.zeros(0)
        rms = float(np.sqrt(np.mean(together**2))) if together.size else 1.0
        problem.scale[index] = max(rms, problem.noise[index].sigma, 1e-12)
    for segment in problem.segments:
        segment.weight = problem.scale


def finish(problem: Problem, fit: Fit) -> Fit:
    """`fit` with its residuals on every sample, each effect under the id that its values stand for."""
    _, active = problem.parted(fit.terms, fit.values)
    fit.terms = tuple(
        replace(term, candidate=cornered(candidate, values))
        for term, (candidate, values) in zip(fit.terms, active, strict=True)
    )
    found = problem.simulate_all(problem.segments, fit.terms, fit.values)
    fit.residuals = [
        problem.left(segment, fit.terms, fit.values, out) for segment, out in zip(problem.segments, found, strict=True)
    ]
    return fit


def first_needs(problem: Problem, fit: Fit) -> list[dict[str, float]]:
    """Displacement that each port still needs at the start of each recording, after `fit` (with residuals)."""
    n = len(problem.model.parameters)
    out = []
    for segment, residual in zip(problem.segments, fit.residuals, strict=True):
        first = slice(0, max(5, round(0.3 / segment.recording.dt_s)) if segment.recording.timed else 5)
        needs = {
            port.name: problem.model.needs(segment, port, fit.values[:n], residual)[first] for port in problem.model.ports
        }
        out.append({name: float(np.nanmedian(need)) if np.isfinite(need).any() else 0.0 for name, need in needs.items()})
    return out


def get_starts(problem: Problem) -> list[dict[str, float]]:
    """Starts of memory of every recording, and the states that it begins from."""
    return [{**segment.start, **_begun(segment)} for segment in problem.segments]


def _begun(segment: Segment) -> dict[str, float]:
    return {} if segment.begin is None else {f"{BEGIN}{k}": float(v) for k, v in enumerate(segment.begin.values)}


def set_starts(problem: Problem, given: list[dict[str, float]]) -> None:
    """Set the stored initial states of all recordings again; the states that they begin from where `given` has them."""
    for segment, start in zip(problem.segments, given, strict=True):
        segment.start.clear()
        segment.start.update({key: value for key, value in start.items() if not key.startswith(BEGIN)})
        if segment.begin is not None and f"{BEGIN}0" in start:
            segment.begin.values = np.array([start[f"{BEGIN}{k}"] for k in range(segment.begin.values.size)])


def starts(term: Term, linear_value: dict[str, float], nonlinear: dict[str, float]) -> Array:
    """Start values of a term: grid values for nonlinear parameters, projected amplitudes for linear ones."""
    return np.array([linear_value.get(p.name, nonlinear.get(p.name, p.grid[0] if p.grid else 0.0)) for p in term.parameters])


def tuned(term: Term, lines: Array) -> tuple[Parameter, ...]:
    """Parameters of a term to scan over; a frequency is tried at the `lines` (Hz) that stand out in the residual.

    A disturbance is at one of them. A mode may lie between them, where nothing excites it: it keeps its grid as well.
    """
    found = []
    for p in term.parameters:
        near = tuple(float(f) for f in lines if p.low < f < p.high) if p.spectral else ()
        grid = (*near[:MODE_LINES], *p.grid) if p.log else near or p.grid[:3]
        found.append(replace(p, grid=grid) if p.spectral else p)
    return tuple(found)


def lines_of(residuals: list[Array], dt_s: float, count: int = 5) -> Array:
    """Frequencies (Hz) at which the residuals' spectra, summed over outputs in units of their own power, stand highest."""
    size = 1 << int(np.ceil(np.log2(2 * max(r.shape[1] for r in residuals))))
    power = np.zeros(size // 2 + 1)
    for r in residuals:
        x = np.nan_to_num(r)
        x = (x - x.mean(axis=1, keepdims=True)) * np.hanning(x.shape[1])
        each = np.abs(np.fft.rfft(x, size, axis=1)) ** 2
        power += np.max(each / (np.median(each, axis=1, keepdims=True) + 1e-300), axis=0)
    inside = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    best = inside[np.argsort(-power[inside])[:count]]
    return np.asarray(best / (size * dt_s))


def grid_points(parameters: tuple[Parameter, ...], most: int) -> Iterator[dict[str, float]]:
    """Combinations of grid values of the parameters that are not linear, thinned to about `most`."""
    from itertools import product

    rest = [p for p in parameters if not p.linear]
    points = list(product(*(p.grid for p in rest)))
    step = max(1, int(np.ceil(len(points) / most)))
    for point in points[::step]:
        yield {p.name: value for p, value in zip(rest, point, strict=True)}
