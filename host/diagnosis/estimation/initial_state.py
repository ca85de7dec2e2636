"""The initial state of each recording: measured at its first samples, and estimated again from its outputs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import correlation_time
from host.diagnosis.model.model import ActiveEffect, Model, Segment

Array = npt.NDArray[np.float64]
FARTHEST = 4.0  # standard deviations of the measured state within which the estimated one stays


def estimate_state(model: Model, segment: Segment, theta: Array, active: list[ActiveEffect]) -> None:
    """Estimate `segment.begin` by one Gauss-Newton step from the measured state.

    Measured state and outputs are weighed by their variances; that of an output's mean counts correlated samples once.
    Nothing happens where the model knows its state.
    """
    begin = segment.begin
    if begin is None or not begin.estimated:
        return
    moving = np.flatnonzero(begin.spread > 0.0)
    if not moving.size:
        return
    begin.values = begin.measured.copy()
    base = model.simulate(segment, theta, active)
    r = segment.y - base
    changes = []
    for k in moving:
        begin.values = begin.measured + np.eye(begin.spread.size)[k] * begin.spread[k]
        changes.append(model.simulate(segment, theta, active) - base)
    scale = np.array([_weighing(row) for row in r])[:, None]
    used = np.isfinite(r)
    A = np.array([np.broadcast_to(change / scale, r.shape)[used] for change in changes]).T
    by = np.linalg.solve(A.T @ A + np.eye(moving.size), A.T @ (r / scale)[used])
    begin.values = begin.measured.copy()
    begin.values[moving] += np.clip(by, -FARTHEST, FARTHEST) * begin.spread[moving]


def _weighing(row: Array) -> float:
    """RMS of a residual (n,) times the root of its correlation time (samples)."""
    seen = row[np.isfinite(row)]
    return float(np.sqrt(np.mean(seen**2) * correlation_time(row))) or 1e-300 if seen.size else 1.0
