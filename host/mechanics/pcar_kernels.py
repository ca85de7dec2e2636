"""Statics of tangent circular arcs as compiled kernels: evaluation, tangent, and the branch from the unloaded shape.

Symbols: arc i of n has length l, stiffness EI, curvature kappa, unloaded curvature kappa0 and turns by u = kappa l.
Virtual work (2.8), divided by the arc's length: the arc's elastic moment equals the mean of the external
moment over it; in this form an arc may be straight, and may have no length at all.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.arc_integrals import phi, phi3

Array = NDArray[np.float64]

# Rows of the work array (ROWS, n). Chord: end minus start of the arc. Lever 1, 2: first and second mean of the arm.
CHORD_X, CHORD_Y, LEVER1_X, LEVER1_Y, LEVER2_X, LEVER2_Y, LEVER3_X, LEVER3_Y = range(8)
MOMENT, COUPLING, DIAGONAL, SCALE, PIVOT, STEP, TANGENT, TRIAL, ARM_X, ARM_Y = range(8, 18)
ROWS = 18

CONVERGED, FOLD, NOT_CONVERGED = 0, 1, 2

FINAL_TOLERANCE_rad = 1e-8  # the last quadratic step leaves its square
PATH_TOLERANCE_rad = 2e-2  # between load steps the path only has to stay near the branch
FIRST_STEP_rad = 0.6  # turning that one load step may predict
LARGEST_STEP_rad = 1.2
CONTRACTION = 0.35  # a Newton step that shrinks less is taken as a warning of another branch
SMALLEST_LOAD_STEP = 0.02  # below this the path is followed by arc length
SMALLEST_ARC_STEP = 1e-5
EVALUATION_LIMIT = 400
SYMMETRIC_rad = 1e-13  # no moment at all: a straight arc under axial load, stable or not


class Shaft(NamedTuple):
    """The arcs outside the sheath, each array (n,), proximal first."""

    length: Array  # m
    EI: Array  # N m2
    cubic: Array  # m2: stiffening with the square of the change of curvature
    kappa0: Array  # 1/m, unloaded


class Load(NamedTuple):
    """External load in the base frame: tip force and distributed force."""

    force_x: float  # N, at the tip
    force_y: float
    drag: Array  # (n, 2) force per length on each arc, N/m; (0, 2) for none


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate(length: Array, kappa: Array, external: Load, load: float, work: Array) -> tuple[float, float, float]:
    """Moments and their derivatives at curvatures `kappa` under `load` times the external load.

    Arguments: `length`, `kappa` (n,), the arcs' lengths (m) and curvatures (1/m).
    Fills in `work`: the mean external moment of each arc (N m), the coupling of an arc with those before it and its
    own second derivative (both N m2 per m of arc). Result: tip x, y (m), tip angle (rad).
    """
    n, drag = length.size, external.drag
    loaded_along = drag.shape[0] == n
    cosine, sine, x, y, angle = 1.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        l = length[i]
        u = kappa[i] * l
        re0, im0, re1, im1, re2, im2, turn_cos, turn_sin = phi(u)
        a, b = l * cosine, l * sine
        work[CHORD_X, i], work[CHORD_Y, i] = a * re0 - b * im0, a * im0 + b * re0
        work[LEVER1_X, i], work[LEVER1_Y, i] = a * re1 - b * im1, a * im1 + b * re1
        work[LEVER2_X, i], work[LEVER2_Y, i] = a * re2 - b * im2, a * im2 + b * re2
        if loaded_along:
            re3, im3 = phi3(u, re2, im2, turn_cos, turn_sin)
            work[LEVER3_X, i], work[LEVER3_Y, i] = a * re3 - b * im3, a * im3 + b * re3
        x += work[CHORD_X, i]
        y += work[CHORD_Y, i]
        angle += u
        cosine, sine = cosine * turn_cos - sine * turn_sin, cosine * turn_sin + sine * turn_cos
    # Backwards: P is the conjugate of the force beyond the arc, T its complex moment about the arc's end
    # (real part: work-like, imaginary part: minus the moment).
    P_x, P_y = load * external.force_x, -load * external.force_y
    T_x, T_y = 0.0, 0.0
    for j in range(n):
        i = n - 1 - j
        X_x = T_x + P_x * work[LEVER1_X, i] - P_y * work[LEVER1_Y, i]
        X_y = T_y + P_x * work[LEVER1_Y, i] + P_y * work[LEVER1_X, i]
        S_x = T_x + P_x * work[LEVER2_X, i] - P_y * work[LEVER2_Y, i]
        T_x, T_y = (
            T_x + P_x * work[CHORD_X, i] - P_y * work[CHORD_Y, i],
            T_y + P_x * work[CHORD_Y, i] + P_y * work[CHORD_X, i],
        )
        if loaded_along:
            q_x, q_y = load * drag[i, 0] * length[i], -load * drag[i, 1] * length[i]
            d_x, d_y = work[LEVER1_X, i] - work[LEVER2_X, i], work[LEVER1_Y, i] - work[LEVER2_Y, i]
            X_x += q_x * d_x - q_y * d_y
            X_y += q_x * d_y + q_y * d_x
            d_x, d_y = work[LEVER2_X, i] - work[LEVER3_X, i], work[LEVER2_Y, i] - work[LEVER3_Y, i]
            S_x += q_x * d_x - q_y * d_y
            d_x, d_y = work[CHORD_X, i] - work[LEVER1_X, i], work[CHORD_Y, i] - work[LEVER1_Y, i]
            T_x += q_x * d_x - q_y * d_y
            T_y += q_x * d_y + q_y * d_x
            P_x += q_x
            P_y += q_y
        work[MOMENT, i], work[COUPLING, i], work[DIAGONAL, i] = -X_y, -X_x, -S_x
    return x, y, angle


@njit(cache=True, nogil=True, error_model="numpy")
def arms(work: Array) -> None:
    """Mean lever of the tip force on each arc after `evaluate`: d tip / d kappa_i = l_i (-ARM_Y, ARM_X) (2.15)."""
    n = work.shape[1]
    x = y = 0.0
    for j in range(n):
        i = n - 1 - j
        work[ARM_X, i], work[ARM_Y, i] = x + work[LEVER1_X, i], y + work[LEVER1_Y, i]
        x += work[CHORD_X, i]
        y += work[CHORD_Y, i]


@njit(cache=True, nogil=True, error_model="numpy")
def factorize(shaft: Shaft, kappa: Array, work: Array) -> int:
    """Pivots of the tangent stiffness (second variation of the energy), in O(n): returns how many are not positive.

    The tangent is EI' - l d2W, where d2W / (l_i l_k) is COUPLING of the later arc; eliminating an arc keeps this
    form, with COUPLING_max(i,k) + alpha COUPLING_i COUPLING_k.
    """
    length, EI, cubic, kappa0 = shaft.length, shaft.EI, shaft.cubic, shaft.kappa0
    negative = 0
    alpha = 0.0
    for i in range(length.size):
        coupling = work[COUPLING, i]
        scale = 1.0 + alpha * coupling
        delta = kappa[i] - kappa0[i]
        stiffness = EI[i] * (1.0 + 3.0 * cubic[i] * delta * delta)
        pivot = stiffness - length[i] * (work[DIAGONAL, i] + alpha * coupling * coupling)
        if not pivot > 0.0:
            negative += 1
            if pivot == 0.0:
                pivot = 1e-300
        alpha += length[i] * scale * scale / pivot
        work[SCALE, i], work[PIVOT, i] = scale, 1.0 / pivot
    return negative


@njit(cache=True, nogil=True, error_model="numpy")
def back_substitute(length: Array, work: Array, row: int) -> None:
    """Solves tangent * x = work[row] in place, after `factorize`."""
    n = length.size
    beta = 0.0
    for i in range(n):
        value = work[row, i] + work[COUPLING, i] * beta
        beta += length[i] * work[SCALE, i] * value * work[PIVOT, i]
        work[row, i] = value
    gamma = 0.0
    for j in range(n):
        i = n - 1 - j
        value = (work[row, i] + work[SCALE, i] * gamma) * work[PIVOT, i]
        gamma += length[i] * work[COUPLING, i] * value
        work[row, i] = value


@njit(cache=True, nogil=True, error_model="numpy")
def newton_step(shaft: Shaft, kappa: Array, work: Array) -> tuple[int, float]:
    """Newton's step into work[STEP] after `evaluate`. Result: pivots that are not positive, turning of the step."""
    length, EI, cubic, kappa0 = shaft.length, shaft.EI, shaft.cubic, shaft.kappa0
    negative = factorize(shaft, kappa, work)
    for i in range(length.size):
        delta = kappa[i] - kappa0[i]
        work[STEP, i] = work[MOMENT, i] - EI[i] * delta * (1.0 + cubic[i] * delta * delta)
    back_substitute(length, work, STEP)
    turning = 0.0
    for i in range(length.size):
        turning += abs(length[i] * work[STEP, i])
    return negative, turning


@njit(cache=True, nogil=True, error_model="numpy")
def correct(
    shaft: Shaft,
    external: Load,
    load: float,
    tolerance: float,
    first: float,
    kappa: Array,
    work: Array,
) -> tuple[bool, int, float, float]:
    """Newton at fixed `load` from `kappa` (changed in place); gives up where the steps could lead to another branch.

    Result: accepted, evaluations, the turning of the first step, the worst contraction.
    """
    length = shaft.length
    previous, worst, start = 0.0, 0.0, 0.0
    for count in range(1, 12):
        evaluate(shaft.length, kappa, external, load, work)
        negative, turning = newton_step(shaft, kappa, work)
        if not turning <= first:
            return False, count, turning, worst
        if negative > 0 and turning > SYMMETRIC_rad:
            return False, count, turning, worst
        if count == 1:
            start = turning
        elif previous > tolerance * 0.1:
            worst = max(worst, turning / previous)
            if worst > CONTRACTION:
                return False, count, start, worst
        for i in range(length.size):
            kappa[i] += work[STEP, i]
        previous = turning
        if turning < tolerance:
            return True, count, start, worst
    return False, 11, start, worst


@njit(cache=True, nogil=True, error_model="numpy")
def tangent(
    shaft: Shaft,
    external: Load,
    load: float,
    kappa: Array,
    work: Array,
) -> tuple[int, float, float, float]:
    """Put d kappa / d load into work[TANGENT], residual step into work[STEP]. Result: pivots not positive, squared turning
    of the tangent, its product with the residual step, turning of the residual step.
    """
    length = shaft.length
    evaluate(shaft.length, kappa, external, load, work)
    inverse = 1.0 / load if load > 0.0 else 0.0
    for i in range(length.size):
        work[TANGENT, i] = work[MOMENT, i] * inverse
    negative, turning = newton_step(shaft, kappa, work)
    back_substitute(length, work, TANGENT)
    square = product = 0.0
    for i in range(length.size):
        square += (length[i] * work[TANGENT, i]) ** 2
        product += length[i] * length[i] * work[TANGENT, i] * work[STEP, i]
    return negative, square, product, turning


@njit(cache=True, nogil=True, error_model="numpy")
def arc_length_path(
    shaft: Shaft,
    external: Load,
    evaluations: int,
    kappa: Array,
    work: Array,
) -> tuple[int, int, float]:
    """Follow the branch from its start by arc length in (turning of the arcs, load).

    This passes a sharp turn of the branch and recognizes a fold: the second variation stays positive up to the fold.
    Arguments and result: `load_path`.
    """
    length, kappa0 = shaft.length, shaft.kappa0
    n = length.size
    load, before, step = 1e-6, -1.0, 0.1
    for i in range(n):
        kappa[i] = kappa0[i]
    while evaluations < EVALUATION_LIMIT and step > SMALLEST_ARC_STEP:
        negative, square, _, _ = tangent(shaft, external, load, kappa, work)
        evaluations += 1
        if negative > 0:
            if before < 0.0 or turned_back(length, work):
                return FOLD, evaluations, load
            load = restore(before, kappa, work)  # the step ended on another branch
            before, step = -1.0, step * 0.4
            continue
        advance = step / math.sqrt(square + 1.0)
        if load + advance >= 1.0:
            advance = 1.0 - load
        for i in range(n):
            work[TRIAL, i], work[ARM_X, i] = kappa[i], work[TANGENT, i]
            kappa[i] += advance * work[TANGENT, i]
        before = load
        if load + advance >= 1.0:
            accepted, count, _, worst = correct(shaft, external, 1.0, FINAL_TOLERANCE_rad, step, kappa, work)
            if accepted:
                return CONVERGED, evaluations + count, 1.0
        else:
            accepted, count, load, worst = correct_on_arc(shaft, external, load + advance, step, kappa, work)
        evaluations += count
        if accepted:
            step *= 1.5 if worst < 0.1 else 1.0
        else:
            load = restore(before, kappa, work)
            step *= 0.4
    return NOT_CONVERGED, evaluations, load


@njit(cache=True, nogil=True, error_model="numpy")
def restore(load: float, kappa: Array, work: Array) -> float:
    """Back to the last point of the path, kept in work[TRIAL]; returns its load."""
    for i in range(kappa.size):
        kappa[i] = work[TRIAL, i]
    return load


@njit(cache=True, nogil=True, error_model="numpy")
def turned_back(length: Array, work: Array) -> bool:
    """Whether the path, going on in its own direction, now goes towards smaller loads: the mark of a fold."""
    product = 1.0
    for i in range(length.size):
        product += length[i] * length[i] * work[TANGENT, i] * work[ARM_X, i]
    return product < 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def correct_on_arc(
    shaft: Shaft,
    external: Load,
    load: float,
    step: float,
    kappa: Array,
    work: Array,
) -> tuple[bool, int, float, float]:
    """Newton back to the branch, at right angles to the tangent kept in work[ARM_X] (borrowed).

    Result: accepted, evaluations, load, worst contraction.
    """
    length = shaft.length
    previous, worst = 0.0, 0.0
    for count in range(1, 9):
        _, _, _, _ = tangent(shaft, external, load, kappa, work)
        along, slope = 0.0, 1.0
        for i in range(length.size):
            weight = length[i] * length[i] * work[ARM_X, i]
            along += weight * work[STEP, i]
            slope += weight * work[TANGENT, i]
        shift = -along / slope
        turning = abs(shift)
        for i in range(length.size):
            work[STEP, i] += shift * work[TANGENT, i]
            turning += abs(length[i] * work[STEP, i])
        if not turning <= step:
            return False, count, load, worst
        if count > 1:
            worst = max(worst, turning / previous)
            if worst > CONTRACTION:
                return False, count, load, worst
        for i in range(length.size):
            kappa[i] += work[STEP, i]
        load += shift
        previous = turning
        if turning < 0.01 * step or turning < FINAL_TOLERANCE_rad:
            return True, count, load, worst
    return False, 8, load, worst


@njit(cache=True, nogil=True, error_model="numpy")
def load_path(
    shaft: Shaft,
    external: Load,
    kappa: Array,
    work: Array,
) -> tuple[int, int, float]:
    """Curvatures at full load on the branch that starts at the unloaded shape. Writes `kappa`.

    Result: status (CONVERGED, FOLD, NOT_CONVERGED), evaluations, share of the load that was reached.
    """
    length, EI, kappa0 = shaft.length, shaft.EI, shaft.kappa0
    n = length.size
    for i in range(n):
        kappa[i] = kappa0[i]
    evaluate(shaft.length, kappa, external, 1.0, work)
    turning = 0.0
    for i in range(n):
        turning += length[i] * abs(work[MOMENT, i]) / EI[i]
    evaluations, load = 1, 0.0
    step = 1.0 if turning <= FIRST_STEP_rad else FIRST_STEP_rad / turning
    while evaluations < EVALUATION_LIMIT:
        target = 1.0 if load + 1.001 * step >= 1.0 else load + step
        for i in range(n):
            work[TRIAL, i] = kappa[i]
        tolerance = FINAL_TOLERANCE_rad if target == 1.0 else PATH_TOLERANCE_rad
        accepted, count, _, worst = correct(shaft, external, target, tolerance, LARGEST_STEP_rad, kappa, work)
        evaluations += count
        if accepted:
            if target == 1.0:
                return CONVERGED, evaluations, 1.0
            load = target
            step *= 1.6 if worst < 0.1 else 1.1
            continue
        for i in range(n):
            kappa[i] = work[TRIAL, i]
        step *= 0.4
        if step < SMALLEST_LOAD_STEP:
            return arc_length_path(shaft, external, evaluations, kappa, work)
    return NOT_CONVERGED, evaluations, load
