"""Confidence intervals that stand coloured residuals: sandwich covariance over blocks longer than the correlation time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import stats

from host.diagnosis.evidence import correlation_time
from host.diagnosis.fit import Fit, Problem, free, jacobian, size_of

Array = npt.NDArray[np.float64]


def intervals(problem: Problem, fit: Fit, level: float = 0.95) -> list[tuple[float, float]]:
    """Interval of every parameter (nominal, then effects) of `fit`; those held have none (value twice).

    Linearized at the fit, in each parameter's own scale (logarithm for positive ones). Scores are summed over blocks of at least four
    correlation times and taken as independent (Liang and Zeger 1986); quantiles of Student's t with as many degrees of freedom as blocks
    beyond parameters.
    """
    parameters = problem.parameters(fit.terms)
    sizes = [size_of(p, v) for p, v in zip(parameters, fit.values, strict=True)]
    base = problem.stacked(fit.terms, fit.values)
    J = np.column_stack([jacobian(problem, fit.terms, fit.values, base, sizes), _by_begin(problem, fit, base)])
    A = J.T @ J
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12 * (np.max(np.diag(A), initial=0.0) + 1e-300)))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-11) / np.outer(scale, scale)
    scores = _block_scores(problem, fit, J, base)
    blocks, k = scores.shape
    bread = blocks / max(blocks - k, 1)
    covariance = inverse @ (scores.T @ scores * bread) @ inverse
    quantile = float(stats.t.ppf(0.5 + 0.5 * level, max(blocks - k, 2)))
    out = [(float(v), float(v)) for v in fit.values]
    for place, index in enumerate(free(parameters)):
        p, value = parameters[index], float(fit.values[index])
        half = quantile * float(np.sqrt(max(covariance[place, place], 0.0)))
        if p.log:
            half = min(half, 20.0)
            low, high = value * np.exp(-half), value * np.exp(half)
        else:
            low, high = value - half * sizes[index], value + half * sizes[index]
        out[index] = (float(max(low, p.low)), float(min(high, p.high)))
    return out


def _by_begin(problem: Problem, fit: Fit, base: Array) -> Array:
    """Rate of the weighted simulation by the state from which each recording runs freely, where a model has one: it is estimated too."""
    columns = []
    for piece in problem.pieces:
        if piece.fit.any() and hasattr(problem.model, "begin_anew") and "measured" in piece.extra:
            begin, spread = piece.extra["begin"], piece.extra["measured"][1]
            for k in range(2):
                piece.extra["begin"] = begin + np.eye(2)[k] * spread[k]
                columns.append(base - problem.stacked(fit.terms, fit.values))
            piece.extra["begin"] = begin
    used = [column for column in columns if np.any(column)]
    return np.array(used).T if used else np.zeros((base.size, 0))


def _block_scores(problem: Problem, fit: Fit, J: Array, base: Array) -> Array:
    """Sums of J^T r over blocks of time, all outputs of a block together. Shape (blocks, parameters)."""
    scores, at = [], 0
    for piece in problem.pieces:
        n = int(piece.fit.sum())
        if n == 0:
            continue
        rows = len(problem.model.outputs)
        r = base[at: at + rows * n].reshape(rows, n)
        product = (J[at: at + rows * n] * base[at: at + rows * n, None]).reshape(rows, n, -1).sum(axis=0)
        at += rows * n
        tau = max(correlation_time(row) for row in r)
        parts = int(np.clip(n / max(4.0 * tau, 10.0), 1, 60))
        scores += [part.sum(axis=0) for part in np.array_split(product, parts)]
    return np.array(scores)
