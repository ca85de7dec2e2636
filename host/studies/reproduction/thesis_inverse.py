"""The thesis' inverse kinematics of the simulated catheter (7.3.2): polynomials for the inverse of (7.2), then (7.1).

Three polynomials of 9th order give the curvature for the tip's place across: one between the two folds, where the tip is
furthest across, one beyond each. They are fitted at equal steps of curvature. The middle one has the error that the thesis
prints, 0.26 1/m RMS, for its distal shaft of 70 mm. Where two curvatures belong to a place, the one nearest to the last is
taken, as in Algorithm 6.1.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from realtime.control.inverse_kinematics import FOLD_BEND, FOLD_REACH

Array = NDArray[np.float64]

ORDER, SAMPLES = 9, 2000
GREATEST_BEND = 5.2
# Bends (rad) between which each polynomial holds.
BRANCHES = ((-GREATEST_BEND, -FOLD_BEND), (-FOLD_BEND, FOLD_BEND), (FOLD_BEND, GREATEST_BEND))

# Tip across over the length at the greatest bend: nearer to the axis, only the middle polynomial holds.
LEAST_OUTER_REACH = (1.0 - math.cos(GREATEST_BEND)) / GREATEST_BEND


def unit_tip(bend: Array) -> tuple[Array, Array]:
    """Return the tip along and across of an arc of unit length with `bend` (n,) rad; (7.1), (7.2) with d = 0."""
    return np.sinc(bend / np.pi), 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2


def branch_bends(branch: int) -> Array:
    """Return the bends (SAMPLES,) rad that a polynomial is fitted to."""
    return np.linspace(*BRANCHES[branch], SAMPLES)


def fitted_polynomials() -> Array:
    """Return the coefficients (3, ORDER + 1), ascending powers, of the bend (rad) over the place across for unit length."""
    rows = []
    for branch in range(len(BRANCHES)):
        bend = branch_bends(branch)
        rows.append(np.polynomial.Polynomial.fit(unit_tip(bend)[1], bend, ORDER).convert().coef)
    return np.array(rows)


@njit(cache=True)
def polynomial_bend(coefficients: Array, reach: float, branch: int) -> float:
    """Return the bend (rad) of a branch (0, 1, 2) for the tip across over the length, by Horner's rule."""
    bend = 0.0
    for k in range(coefficients.shape[1] - 1, -1, -1):
        bend = bend * reach + coefficients[branch, k]
    return bend


@njit(cache=True)
def polynomial_inverse(
    coefficients: Array, x: float, y: float, length_m: float, last_curvature: float
) -> tuple[float, float]:
    """Return curvature (1/m) and body outside (m) for the tip (x, y) in m; out of reach across, those of the fold."""
    reach = min(max(y / length_m, -FOLD_REACH), FOLD_REACH)
    bend = polynomial_bend(coefficients, reach, 1)
    outer = 2 if reach > 0.0 else 0
    other = polynomial_bend(coefficients, reach, outer)
    last = last_curvature * length_m
    if abs(reach) > LEAST_OUTER_REACH and abs(other - last) < abs(bend - last):
        bend = other
    return bend / length_m, x - length_m * (1.0 if abs(bend) < 1e-6 else math.sin(bend) / bend)
