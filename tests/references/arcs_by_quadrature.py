"""Tangent circular arcs a second time, by Gauss-Legendre quadrature of the shape's definition: slow, plain, complex-safe.

Shares nothing with `host.mechanics`: it integrates cos and sin of the angle (2.1) and the energy (2.6), so that it can
judge the kernels' closed forms, and it follows the branch in tiny steps of arc length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray

NODES, WEIGHTS = leggauss(24)
NODES, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS


def point(length: ArrayLike, kappa: NDArray, station: float | None = None) -> tuple:
    """x, y, angle at arc length `station` (the tip by default); `kappa` may be complex (for the complex step)."""
    length = np.asarray(length, dtype=float)
    station = length.sum() if station is None else station
    x = y = angle = 0.0 * kappa[0]
    before = 0.0
    for l, k in zip(length, kappa, strict=True):
        part = min(max(station - before, 0.0), l)
        x = x + part * np.sum(WEIGHTS * np.cos(angle + k * part * NODES))
        y = y + part * np.sum(WEIGHTS * np.sin(angle + k * part * NODES))
        angle = angle + k * part
        before += l
    return x, y, angle


def work_of_drag(length: ArrayLike, kappa: NDArray, drag: NDArray) -> complex:
    """Integral of q . r ds for a force per length q (n, 2) on each arc."""
    length = np.asarray(length, dtype=float)
    total, before = 0.0, 0.0
    for l, q in zip(length, drag, strict=True):
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            x, y, _ = point(length, kappa, before + l * node)
            total = total + weight * l * (q[0] * x + q[1] * y)
        before += l
    return total


def gradient(function: Callable, kappa: NDArray, step: float = 1e-30) -> NDArray:
    """Derivatives of a real function of curvatures by the complex step: exact to rounding."""
    found = []
    for i in range(kappa.size):
        shifted = kappa.astype(complex)
        shifted[i] += 1j * step
        found.append(np.imag(function(shifted)) / step)
    return np.array(found)


def moments(length: NDArray, kappa: NDArray, force: NDArray) -> tuple[NDArray, NDArray]:
    """Mean external moment of each arc and its derivatives by the curvatures, from first principles.

    The moment at s is (tip - r(s)) x F; the mean over the arc and its derivatives follow by integrating twice.
    """
    start = np.concatenate([[0.0], np.cumsum(length * kappa)[:-1]])
    power = np.array([[np.sum(WEIGHTS * NODES**m * np.exp(1j * u * NODES)) for u in length * kappa] for m in range(3)])
    edge = length * np.exp(1j * start)
    ends = np.cumsum(edge * power[0])
    arm = edge * power[1] + (ends[-1] - ends)
    own = edge * power[2] + (ends[-1] - ends)
    conjugate = force[0] - 1j * force[1]
    index = np.arange(length.size)
    coupling = -(conjugate * arm).real
    by = coupling[np.maximum.outer(index, index)]
    by[index, index] = -(conjugate * own).real
    return (conjugate * 1j * arm).real, by * length[None, :]


def follow(length: NDArray, EI: NDArray, kappa0: NDArray, force: NDArray, step: float = 0.02) -> NDArray | None:
    """Curvatures at full load on the branch from the unloaded shape, in steps of `step` rad; None where it folds."""
    kappa, load = kappa0.astype(float).copy(), 0.0
    root = np.sqrt(length + 1e-12)
    while True:
        mean, by = moments(length, kappa, force)
        stiffness = np.diag(EI) - load * by
        symmetric = root[:, None] * stiffness / root[None, :]
        if np.linalg.eigvalsh(0.5 * (symmetric + symmetric.T))[0] <= 0.0:
            return None
        tangent = np.linalg.solve(stiffness, mean)
        advance = step / np.sqrt(np.sum((length * tangent) ** 2) + 1.0)
        last = load + advance >= 1.0
        advance = 1.0 - load if last else advance
        reached, found = _correct(length, EI, kappa0, force, kappa + advance * tangent, load + advance, tangent, last)
        if last:
            return found
        if reached <= load:
            return None
        kappa, load = found, reached


def _correct(
    length: NDArray, EI: NDArray, kappa0: NDArray, force: NDArray, kappa: NDArray, load: float, tangent: NDArray, last: bool
) -> tuple[float, NDArray]:
    n = length.size
    for _ in range(25):
        mean, by = moments(length, kappa, force)
        residual = EI * (kappa - kappa0) - load * mean
        stiffness = np.diag(EI) - load * by
        if last:
            change, shift = np.linalg.solve(stiffness, -residual), 0.0
        else:
            bordered = np.block([[stiffness, -mean[:, None]], [(length**2 * tangent)[None, :], np.ones((1, 1))]])
            solution = np.linalg.solve(bordered, np.append(-residual, 0.0))
            change, shift = solution[:n], float(solution[n])
        kappa, load = kappa + change, load + shift
        if np.sum(np.abs(length * change)) < 1e-13:
            break
    return load, kappa
