"""Instants of single events: only the samples around one show it, and these may be held out from the fit.

A fit by slopes stays where it began if that is several samples from the instant, and sees no slope where a step lies between
two samples. Instants and their intervals are therefore found from the squared error itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from host.diagnosis.estimation.fit import Fit, Problem, finish, minimize, robust
from host.diagnosis.estimation.noise import correlation_time

Array = npt.NDArray[np.float64]
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
FITTED = 4.0  # samples around an instant, up to which the fit has seen it
FINE = 0.02  # of a sample: width of the last bracket


def placed(problem: Problem, fit: Fit) -> Fit:
    """`fit` with each instant put where the fitted samples leave least, and between two of them where the samples held out
    there leave least.

    The fit has no slope between fitted samples: wherever a step lies there, they are the same. Squared errors of a step that
    is misplaced grow with its distance, so a golden-section search finds the instant.
    """
    parameters, moved = problem.parameters(fit.terms), False
    if not any(p.event for p in parameters):
        return fit
    fit = _split_again(problem, fit)
    values = fit.values.copy()
    used = [segment for segment in problem.segments if segment.fit.any()]
    for index in (index for index, p in enumerate(parameters) if p.event):
        dt_s, at = used[0].recording.dt_s, values[index]
        seen = np.concatenate([segment.recording.time_s[segment.fit] for segment in used])
        low, high = np.max(seen[seen <= at - dt_s], initial=-np.inf), np.min(seen[seen >= at + dt_s], initial=np.inf)
        if not np.isfinite(high - low) or high - low <= FITTED * dt_s:
            continue
        values[index], moved = _least(problem, fit, values, index, float(low), float(high)), True
    return finish(problem, replace(fit, values=values)) if moved else fit


def _split_again(problem: Problem, fit: Fit) -> Fit:
    """`fit` with instants where the fitted samples leave least, by what they leave with the event before and behind all.

    That is exact for an event that changes a reading, and a guess where a plant answers to it: it is taken where it leaves
    less.
    """
    parameters = problem.parameters(fit.terms)
    for index in (index for index, p in enumerate(parameters) if p.event):
        at, p = float(fit.values[index]), parameters[index]
        squares = []
        for instant in (p.high, p.low):
            trial = fit.values.copy()
            trial[index] = instant
            squares.append(_squares(problem, fit, trial))
        (time_s, before), (_, after) = squares
        left = np.concatenate(([0.0], np.cumsum(before))) + np.concatenate((np.cumsum(after[::-1])[::-1], [0.0]))
        best = int(np.argmin(left[1:-1])) + 1
        trial = fit.values.copy()
        trial[index] = float(np.clip(0.5 * (time_s[best - 1] + time_s[best]), p.low, p.high))
        if abs(trial[index] - at) < FITTED * problem.segments[0].recording.dt_s:
            continue
        if not robust(problem.stacked(fit.terms, trial))[0] < fit.cost:
            continue
        other = minimize(problem, fit.terms, trial, rounds=problem.rules.further_iterations, tolerance=1e-4)
        if other.cost < fit.cost:
            fit = finish(problem, other)
    return fit


def _squares(problem: Problem, fit: Fit, values: Array) -> tuple[Array, Array]:
    """Times of fitted samples (n,) in order, and the squared weighted error of each."""
    used = [segment for segment in problem.segments if segment.fit.any()]
    left = np.split(
        problem.stacked(fit.terms, values) ** 2, np.cumsum([len(problem.noise) * int(s.fit.sum()) for s in used])[:-1]
    )
    error = np.concatenate([r.reshape(len(problem.noise), -1).sum(axis=0) for r in left])
    time_s = np.concatenate([segment.recording.time_s[segment.fit] for segment in used])
    order = np.argsort(time_s, kind="stable")
    return time_s[order], error[order]


def instant_interval(problem: Problem, fit: Fit, index: int, level: float) -> tuple[float, float]:
    """Interval of the instant that is parameter `index` (s): where all samples leave little more than at the fit.

    The bound is that of a likelihood ratio, chi squared of one degree of freedom, with what the fit leaves as the noise and
    its correlation time. No end is nearer than half a sample: nothing shows where between two samples a step lies.
    """
    used = [replace(s, fit=s.fit | s.heldout) for s in problem.segments if s.fit.any() or s.heldout.any()]
    whole, p, at = replace(problem, segments=used), problem.parameters(fit.terms)[index], float(fit.values[index])
    rows = [r[row] for s, r in zip(problem.segments, fit.residuals, strict=True) if s.fit.any() for row in range(len(r))]
    at_fit = whole.stacked(fit.terms, fit.values)
    coloured = max(correlation_time(row) for row in rows)
    most = float(stats.chi2.ppf(level, 1)) * float(np.mean(at_fit**2)) * coloured
    dt_s = used[0].recording.dt_s

    def over(instant: float) -> bool:
        trial = fit.values.copy()
        trial[index] = instant
        return float(np.sum(whole.stacked(fit.terms, trial) ** 2 - at_fit**2)) > most

    def end(way: float, limit: float) -> float:
        """Farthest instant that way which is not over, to half a sample, where that grows with the distance."""
        inside, step = 0.0, 0.5 * dt_s
        while not over(at + way * step):
            inside, step = step, 2.0 * step
            if step >= abs(limit - at):
                return limit
        while step - inside > 0.5 * dt_s:
            middle = 0.5 * (inside + step)
            inside, step = (inside, middle) if over(at + way * middle) else (middle, step)
        return at + way * max(step, 0.5 * dt_s)

    return end(-1.0, p.low), end(1.0, p.high)


def _least(problem: Problem, fit: Fit, values: Array, index: int, low: float, high: float) -> float:
    """The value of parameter `index` between `low` and `high` (s) at which all samples between them leave least."""
    near = [(s.fit | s.heldout) & (s.recording.time_s >= low) & (s.recording.time_s <= high) for s in problem.segments]
    segments = [replace(s, fit=m) for s, m in zip(problem.segments, near, strict=True)]
    whole = replace(problem, segments=segments)

    def left(at: float) -> float:
        trial = values.copy()
        trial[index] = at
        return float(np.sum(whole.stacked(fit.terms, trial) ** 2))

    least = FINE * problem.segments[0].recording.dt_s
    a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_a, at_b = left(a), left(b)
    while high - low > least:
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - GOLDEN * (high - low)
            at_a = left(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + GOLDEN * (high - low)
            at_b = left(b)
    return 0.5 * (low + high)
