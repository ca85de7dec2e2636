"""Confidence intervals that stand coloured residuals and modules that are not quite true: sandwich covariance over blocks
longer than the correlation time, and over halves of recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from host.diagnosis.evidence import correlation_time
from host.diagnosis.fit import Fit, Problem, free, jacobian, size_of

Array = npt.NDArray[np.float64]
LARGER = 0.95  # chance below which scatter between recordings stays, if formulas are true


def intervals(problem: Problem, fit: Fit, level: float = 0.95) -> list[tuple[float, float]]:
    """Interval of every parameter (nominal, then effects) of `fit`; those held have none (value twice).

    Linearized at the fit, in each parameter's own scale (logarithm for positive ones). Scores are summed over blocks of
    at least four correlation times and taken as independent (Liang and Zeger 1986); quantiles of Student's t with as
    many degrees of freedom as blocks beyond parameters. A module whose formula is not quite the true one errs alike all
    through one excitation and otherwise in the next. The same sums over halves of recordings, held-out ones too, show
    that: where these scatter more than chance would, the interval is made of them.
    """
    parameters = problem.parameters(fit.terms)
    sizes = [size_of(p, v) for p, v in zip(parameters, fit.values, strict=True)]
    base = problem.stacked(fit.terms, fit.values)
    J = np.column_stack([jacobian(problem, fit.terms, fit.values, base, sizes), _by_begin(problem, fit, base)])
    A = J.T @ J
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12 * (np.max(np.diag(A), initial=0.0) + 1e-300)))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-11) / np.outer(scale, scale)
    scores = _block_scores(problem, J, base)
    blocks, k = scores.shape
    covariance = inverse @ (scores.T @ scores * (blocks / max(blocks - k, 1))) @ inverse
    quantile = float(stats.t.ppf(0.5 + 0.5 * level, max(blocks - k, 2)))
    fine, (coarse, count) = np.diag(covariance), _across_recordings(problem, fit, sizes, inverse)
    scattered = coarse > stats.f.ppf(LARGER, count - 1, max(blocks - k, 2)) * fine
    wide = float(stats.t.ppf(0.5 + 0.5 * level, count - 1)) * np.sqrt(np.maximum(coarse, 0.0))
    widths = np.where(scattered, wide, quantile * np.sqrt(np.maximum(fine, 0.0)))
    out = [(float(v), float(v)) for v in fit.values]
    for place, index in enumerate(free(parameters)):
        p, value, half = parameters[index], float(fit.values[index]), float(widths[place])
        if p.log:
            half = min(half, 20.0)
            low, high = value * np.exp(-half), value * np.exp(half)
        else:
            low, high = value - half * sizes[index], value + half * sizes[index]
        out[index] = (float(max(low, p.low)), float(min(high, p.high)))
    return out


def _across_recordings(problem: Problem, fit: Fit, sizes: list[float], inverse: Array) -> tuple[Array, int]:
    """Variances from the scatter of scores between halves of recordings, fitted and held-out ones alike; their number."""
    both = replace(problem, pieces=[replace(piece, fit=piece.fit | piece.heldout) for piece in problem.pieces])
    base = both.stacked(fit.terms, fit.values)
    J = jacobian(both, fit.terms, fit.values, base, sizes)
    J = np.column_stack([J, np.zeros((base.size, inverse.shape[0] - J.shape[1]))])
    scores, at, rows = [], 0, len(problem.model.outputs)
    for piece, given in zip(both.pieces, problem.pieces, strict=True):
        n = int(piece.fit.sum())
        part = slice(at, at + rows * n)
        products = (J[part] * base[part, None]).reshape(rows, n, -1).sum(axis=0)
        at += rows * n
        for mask in (given.fit[piece.fit], given.heldout[piece.fit]):
            scores += [half.sum(axis=0) for half in np.array_split(products[mask], 2) if half.size]
    S, count = np.array(scores), len(scores)
    share = sum(p.fit.sum() for p in problem.pieces) / max(sum(p.fit.sum() for p in both.pieces), 1)
    covariance = inverse @ (S.T @ S * (share * count / max(count - 1, 1))) @ inverse
    return np.diag(covariance), max(count, 2)


def _by_begin(problem: Problem, fit: Fit, base: Array) -> Array:
    """Rate of the weighted simulation by the state from which each recording runs freely, where a model has one: it
    is estimated too.
    """
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


def _block_scores(problem: Problem, J: Array, base: Array) -> Array:
    """Sums of J^T r over blocks of time, all outputs of a block together. Shape (blocks, parameters)."""
    scores, at = [], 0
    for piece in problem.pieces:
        n = int(piece.fit.sum())
        if n == 0:
            continue
        rows = len(problem.model.outputs)
        r = base[at : at + rows * n].reshape(rows, n)
        product = (J[at : at + rows * n] * base[at : at + rows * n, None]).reshape(rows, n, -1).sum(axis=0)
        at += rows * n
        tau = max(correlation_time(row) for row in r)
        parts = int(np.clip(n / max(4.0 * tau, 10.0), 1, 60))
        scores += [part.sum(axis=0) for part in np.array_split(product, parts)]
    return np.array(scores)
