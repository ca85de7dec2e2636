"""Instants of single events: only the samples around one show it, and these may be held out from the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.fit import Fit, Problem, finish

Array = npt.NDArray[np.float64]
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
FITTED = 4.0  # samples around an instant, up to which the fit has seen it
FINE = 0.02  # of a sample: width of the last bracket


def placed(problem: Problem, fit: Fit) -> Fit:
    """`fit` with each instant that lies between fitted samples put where the samples held out there leave least.

    The fit has no slope there: wherever between them a step lies, the fitted samples are the same. Squared errors of a step
    that is misplaced grow with its distance, so a golden-section search finds the instant.
    """
    parameters, values, moved = problem.parameters(fit.terms), fit.values.copy(), False
    used = [segment for segment in problem.segments if segment.fit.any()]
    for index in (index for index, p in enumerate(parameters) if p.event):
        dt_s, at = used[0].recording.dt_s, values[index]
        seen = np.concatenate([segment.recording.time_s[segment.fit] for segment in used])
        low, high = np.max(seen[seen <= at - dt_s], initial=-np.inf), np.min(seen[seen >= at + dt_s], initial=np.inf)
        if not np.isfinite(high - low) or high - low <= FITTED * dt_s:
            continue
        values[index], moved = _least(problem, fit, values, index, float(low), float(high)), True
    return finish(problem, replace(fit, values=values)) if moved else fit


def _least(problem: Problem, fit: Fit, values: Array, index: int, low: float, high: float) -> float:
    """The value of parameter `index` between `low` and `high` (s) at which all samples between them leave least."""
    near = [(s.fit | s.heldout) & (s.recording.time_s >= low) & (s.recording.time_s <= high) for s in problem.segments]
    segments = [replace(s, fit=m if s.fit.any() else s.fit) for s, m in zip(problem.segments, near, strict=True)]
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
