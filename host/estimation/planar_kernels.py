"""Force from the tip's planar pose, compiled: least-energy curvatures, force by statics, then maximum likelihood."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import pcar_kernels as kernels
from host.mechanics.pcar_kernels import Load, Shaft

Array = NDArray[np.float64]

# Columns of a result row
FORCE_X, FORCE_Y, INFO_XX, INFO_XY, INFO_YY, CHI_SQUARE, ERROR_X, ERROR_Y, ERROR_ANGLE, ENDED, EVALUATIONS = range(11)
COLUMNS = 11

STEP_LIMIT_rad = 0.8
CURVATURE_TOLERANCE_rad = 1e-3  # the maximum-likelihood stage takes over from here
EXACT_TOLERANCE_rad = 1e-10
END_rad = 1e-10  # turning of the last step
END_N = 1e-9  # force of the last step
FORCE_LIMIT_N = 10.0  # a pose that needs more is one that no force explains
CURVATURE_STEPS, LIKELIHOOD_STEPS = 50, 40
# Keeps fewer than three arcs solvable: the pose is met up to this share of its covariance, 1e-4 m/N at 0.3 mm
SOFTNESS_per_N_m = 1e-4
# The first steps may miss the pose as freely as they bend: without that, three arcs fall into other solutions of
# (2.12)-(2.14) in one case of ten
FIRST_SOFTNESS_per_N_m, SOFTENING = 1e8, 0.15
SECOND_START_CHI_SQUARE = 6.0  # of one degree of freedom
SCAN_DIRECTIONS, SCAN_FORCES_N, SCAN_BEST = 12, (0.08, 0.25), 3


class Measurement(NamedTuple):
    """One measured pose of the tip, or N with a first axis of N in `pose` and `prior`."""

    pose: Array  # (3,) x, y (m), angle (rad)
    covariance: Array  # (3, 3) of the pose
    weight: Array  # (3, 3), its inverse
    prior: Array  # (5,): force (N), then its information xx, xy, yy (1/N^2); zeros for none


@njit(cache=True, nogil=True, error_model="numpy")
def solve3(a: Array, b0: float, b1: float, b2: float) -> tuple[float, float, float]:
    """Solution of the symmetric positive 3 x 3 system (a: xx, xy, xz, yy, yz, zz) by Cholesky; NaN where singular."""
    d0 = a[0]
    l1, l2 = a[1] / d0, a[2] / d0
    d1 = a[3] - l1 * a[1]
    m = a[4] - l1 * a[2]
    l3 = m / d1
    d2 = a[5] - l2 * a[2] - l3 * m
    if not (d0 > 0.0 and d1 > 0.0 and d2 > 0.0):
        return math.nan, math.nan, math.nan
    y1 = b1 - l1 * b0
    z = (b2 - l2 * b0 - l3 * y1) / d2
    y = y1 / d1 - l3 * z
    return b0 / d0 - l1 * y - l2 * z, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def least_energy_curvatures(
    shaft: Shaft, pose: Array, covariance: Array, tolerance: float, kappa: Array, work: Array
) -> tuple[bool, int]:
    """Curvatures that reach the tip pose with the least bending energy, from the unloaded shape. Writes `kappa`.

    Arguments: `pose` (3,) x, y, angle; `covariance` (3, 3) of the pose, which decides how it is missed where fewer
    than three arcs cannot meet it. Result: converged, evaluations. Source: (4.3); with three arcs the energy has no
    say and this is Newton's method on (2.12)-(2.14).
    """
    length, EI, kappa0 = shaft.length, shaft.EI, shaft.kappa0
    n, free = length.size, Load(0.0, 0.0, np.zeros((0, 2)))
    normal = np.empty(6)
    for i in range(n):
        kappa[i] = kappa0[i]
    for count in range(1, CURVATURE_STEPS + 1):
        x, y, angle = kernels.evaluate(length, kappa, free, 0.0, work)
        kernels.arms(work)
        e0, e1, e2 = pose[0] - x, pose[1] - y, pose[2] - angle
        normal[0], normal[1], normal[2] = covariance[0, 0], covariance[0, 1], covariance[0, 2]
        normal[3], normal[4], normal[5] = covariance[1, 1], covariance[1, 2], covariance[2, 2]
        softness = max(SOFTNESS_per_N_m, FIRST_SOFTNESS_per_N_m * SOFTENING ** (count - 1))
        for k in range(6):
            normal[k] *= softness
        for i in range(n):
            j0, j1 = -work[kernels.ARM_Y, i], work[kernels.ARM_X, i]
            weight = length[i] / EI[i]
            normal[0] += weight * j0 * j0
            normal[1] += weight * j0 * j1
            normal[2] += weight * j0
            normal[3] += weight * j1 * j1
            normal[4] += weight * j1
            normal[5] += weight
            back = length[i] * (kappa[i] - kappa0[i])
            e0 += j0 * back
            e1 += j1 * back
            e2 += back
        w0, w1, w2 = solve3(normal, e0, e1, e2)
        turning = 0.0
        for i in range(n):
            target = kappa0[i] + (w2 - work[kernels.ARM_Y, i] * w0 + work[kernels.ARM_X, i] * w1) / EI[i]
            work[kernels.STEP, i] = target - kappa[i]
            turning += abs(length[i] * work[kernels.STEP, i])
        if not turning < math.inf:
            return False, count
        scale = 1.0 if turning <= STEP_LIMIT_rad else STEP_LIMIT_rad / turning
        for i in range(n):
            kappa[i] += scale * work[kernels.STEP, i]
        if turning < tolerance:
            return True, count
    return False, CURVATURE_STEPS


@njit(cache=True, nogil=True, error_model="numpy")
def force_by_statics(shaft: Shaft, kappa: Array, work: Array) -> tuple[float, float]:
    """Force that best explains `kappa`, each arc's moment weighted by its compliance (least energy of the misfit).

    Result: Fx, Fy (N). Source: (4.4), linear least squares of (2.8).
    """
    length, EI, cubic, kappa0 = shaft.length, shaft.EI, shaft.cubic, shaft.kappa0
    kernels.evaluate(length, kappa, Load(0.0, 0.0, np.zeros((0, 2))), 0.0, work)
    kernels.arms(work)
    xx = xy = yy = bx = by = 0.0
    for i in range(length.size):
        weight = length[i] / EI[i]
        delta = kappa[i] - kappa0[i]
        moment = EI[i] * delta * (1.0 + cubic[i] * delta * delta)
        j0, j1 = -work[kernels.ARM_Y, i], work[kernels.ARM_X, i]
        xx += weight * j0 * j0
        xy += weight * j0 * j1
        yy += weight * j1 * j1
        bx += weight * j0 * moment
        by += weight * j1 * moment
    determinant = xx * yy - xy * xy
    if not determinant > 1e-14 * (xx + yy) ** 2:
        # one lever only (a single arc, or a straight one): the shortest force
        trace = xx + yy
        return (bx / trace, by / trace) if trace > 0.0 else (0.0, 0.0)
    return (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant


@njit(cache=True, nogil=True, error_model="numpy")
def two_stage(shaft: Shaft, pose: Array, covariance: Array, kappa: Array, work: Array) -> tuple[bool, float, float]:
    """The thesis' estimate: curvatures from the pose (4.3), then force from the curvatures (4.4).

    Result: converged, Fx, Fy (N); writes `kappa`.
    """
    converged, _ = least_energy_curvatures(shaft, pose, covariance, EXACT_TOLERANCE_rad, kappa, work)
    fx, fy = force_by_statics(shaft, kappa, work)
    return converged, fx, fy


@njit(cache=True, nogil=True, error_model="numpy")
def sensitivities(shaft: Shaft, external: Load, pose: Array, kappa: Array, work: Array, out: Array) -> None:
    """Linearization at (`kappa`, force), in equilibrium or not: `out` gets 6 of d(pose)/d(force) row by row, then the
    pose's error after the shape has been corrected to equilibrium (3). Leaves the steps in work[STEP, ARM_X, ARM_Y].
    """
    length = shaft.length
    x, y, angle = kernels.evaluate(length, kappa, external, 1.0, work)
    kernels.newton_step(shaft, kappa, work)
    kernels.arms(work)
    for i in range(length.size):
        j0, j1 = -work[kernels.ARM_Y, i], work[kernels.ARM_X, i]
        work[kernels.TRIAL, i], work[kernels.TANGENT, i] = j0, j1
        work[kernels.ARM_X, i], work[kernels.ARM_Y, i] = j0, j1
    kernels.back_substitute(length, work, kernels.ARM_X)
    kernels.back_substitute(length, work, kernels.ARM_Y)
    for k in range(6):
        out[k] = 0.0
    out[6], out[7], out[8] = pose[0] - x, pose[1] - y, pose[2] - angle
    for i in range(length.size):
        j0, j1 = length[i] * work[kernels.TRIAL, i], length[i] * work[kernels.TANGENT, i]
        step, by_x, by_y = work[kernels.STEP, i], work[kernels.ARM_X, i], work[kernels.ARM_Y, i]
        out[0] += j0 * by_x
        out[1] += j0 * by_y
        out[2] += j1 * by_x
        out[3] += j1 * by_y
        out[4] += length[i] * by_x
        out[5] += length[i] * by_y
        out[6] -= j0 * step
        out[7] -= j1 * step
        out[8] -= length[i] * step


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(out: Array, measured: Measurement, fx: float, fy: float, row: Array) -> tuple[float, float]:
    """Information of the force into `row`, chi square too. Result: gradient."""
    weight, prior = measured.weight, measured.prior
    gx = gy = xx = xy = yy = chi = 0.0
    for k in range(3):
        wx = wy = we = 0.0
        for m in range(3):
            wx += weight[k, m] * out[2 * m]
            wy += weight[k, m] * out[2 * m + 1]
            we += weight[k, m] * out[6 + m]
        xx += out[2 * k] * wx
        xy += out[2 * k] * wy
        yy += out[2 * k + 1] * wy
        gx += out[2 * k] * we
        gy += out[2 * k + 1] * we
        chi += out[6 + k] * we
    px, py = prior[0] - fx, prior[1] - fy
    row[INFO_XX], row[INFO_XY], row[INFO_YY] = xx + prior[2], xy + prior[3], yy + prior[4]
    row[CHI_SQUARE] = chi + prior[2] * px * px + 2.0 * prior[3] * px * py + prior[4] * py * py
    return gx + prior[2] * px + prior[3] * py, gy + prior[3] * px + prior[4] * py


@njit(cache=True, nogil=True, error_model="numpy")
def likelihood(
    shaft: Shaft, measured: Measurement, start: tuple[float, float], kappa: Array, work: Array, row: Array
) -> None:
    """Maximum-likelihood force from the start (`kappa` and the force `start`): Gauss-Newton on shape and force together.

    Writes `kappa` and `row` (COLUMNS,).
    """
    out, length, none = np.empty(9), shaft.length, np.zeros((0, 2))
    fx, fy = start
    row[ENDED] = 0.0
    dx = dy = 0.0
    for count in range(1, LIKELIHOOD_STEPS + 1):
        sensitivities(shaft, Load(fx, fy, none), measured.pose, kappa, work, out)
        gx, gy = normal_equations(out, measured, fx, fy, row)
        # the lower limit, of a force of 1 kN, prevents a division by 0 along a direction that the pose does not determine
        xx, yy = row[INFO_XX] + 1e-6, row[INFO_YY] + 1e-6
        determinant = xx * yy - row[INFO_XY] ** 2
        dx = (yy * gx - row[INFO_XY] * gy) / determinant
        dy = (xx * gy - row[INFO_XY] * gx) / determinant
        turning = 0.0
        for i in range(length.size):
            step = work[kernels.STEP, i] + dx * work[kernels.ARM_X, i] + dy * work[kernels.ARM_Y, i]
            work[kernels.STEP, i] = step
            turning += abs(length[i] * step)
        row[EVALUATIONS] = count
        if not turning < math.inf:
            break
        scale = 1.0 if turning <= STEP_LIMIT_rad else STEP_LIMIT_rad / turning
        for i in range(length.size):
            kappa[i] += scale * work[kernels.STEP, i]
        fx += scale * dx
        fy += scale * dy
        if not math.hypot(fx, fy) < FORCE_LIMIT_N:
            break
        if turning < END_rad and abs(dx) + abs(dy) < END_N:
            row[ENDED] = 1.0
            break
    row[FORCE_X], row[FORCE_Y] = fx, fy
    # what the last step has left of the error
    row[ERROR_X] = out[6] - out[0] * dx - out[1] * dy
    row[ERROR_Y] = out[7] - out[2] * dx - out[3] * dy
    row[ERROR_ANGLE] = out[8] - out[4] * dx - out[5] * dy


@njit(cache=True, nogil=True, error_model="numpy")
def estimate_cold(shaft: Shaft, measured: Measurement, enough: float, kappa: Array, work: Array, row: Array) -> None:
    """Maximum likelihood from the unloaded shape; other starts where that does not end or does not explain the pose.

    Arguments: `enough`, the chi square below which no other start is tried. Writes `kappa` and `row` of the best.
    """
    kappa[:] = shaft.kappa0
    likelihood(shaft, measured, (0.0, 0.0), kappa, work, row)
    if row[ENDED] == 1.0 and row[CHI_SQUARE] < enough:
        return
    other, second = np.empty(kappa.size), np.empty(COLUMNS)
    least_energy_curvatures(shaft, measured.pose, measured.covariance, CURVATURE_TOLERANCE_rad, other, work)
    likelihood(shaft, measured, force_by_statics(shaft, other, work), other, work, second)
    keep_better(other, second, kappa, row)
    if row[ENDED] == 1.0 and row[CHI_SQUARE] < enough:
        return
    scan(shaft, measured, kappa, work, row)


@njit(cache=True, nogil=True, error_model="numpy")
def keep_better(other: Array, second: Array, kappa: Array, row: Array) -> None:
    """Takes over the second result where it ended and explains the pose better."""
    if second[ENDED] == 1.0 and (row[ENDED] != 1.0 or second[CHI_SQUARE] < row[CHI_SQUARE]):
        row[:] = second
        kappa[:] = other


@njit(cache=True, nogil=True, error_model="numpy")
def scan(shaft: Shaft, measured: Measurement, kappa: Array, work: Array, row: Array) -> None:
    """The last resort: solves the statics for forces all around, and starts from those nearest to the pose."""
    count, none = SCAN_DIRECTIONS * len(SCAN_FORCES_N), np.zeros((0, 2))
    miss, shapes = np.full(count, np.inf), np.empty((count, kappa.size))
    forces, other, second = np.empty((count, 2)), np.empty(kappa.size), np.empty(COLUMNS)
    for k in range(count):
        angle = 2.0 * math.pi * (k % SCAN_DIRECTIONS) / SCAN_DIRECTIONS
        size = SCAN_FORCES_N[k // SCAN_DIRECTIONS]
        forces[k, 0], forces[k, 1] = size * math.cos(angle), size * math.sin(angle)
        external = Load(forces[k, 0], forces[k, 1], none)
        status, _, _ = kernels.load_path(shaft, external, shapes[k], work)
        if status == kernels.CONVERGED:
            x, y, turn = kernels.evaluate(shaft.length, shapes[k], external, 0.0, work)
            error = measured.pose - np.array([x, y, turn])
            miss[k] = 0.0
            for i in range(3):
                for j in range(3):
                    miss[k] += error[i] * measured.weight[i, j] * error[j]
    order = np.argsort(miss)
    for k in order[:SCAN_BEST]:
        other[:] = shapes[k]
        likelihood(shaft, measured, (forces[k, 0], forces[k, 1]), other, work, second)
        keep_better(other, second, kappa, row)


@njit(cache=True, nogil=True, error_model="numpy")
def estimate_many(shafts: Shaft, measured: Measurement, kappa: Array, rows: Array) -> None:
    """`estimate_cold` for N independent samples: `length`, `kappa0`, `kappa` (N, n), `pose` (N, 3), `prior` (N, 5) or
    (1, 5) for all, `rows` (N, COLUMNS). Releases the interpreter's lock, so that threads may share a recording.
    """
    work = np.empty((kernels.ROWS, shafts.length.shape[1]))
    for i in range(shafts.length.shape[0]):
        pose = measured.pose[i]
        if not math.isfinite(pose[0] + pose[1] + pose[2]):
            rows[i] = math.nan
            continue
        shaft = Shaft(shafts.length[i], shafts.EI, shafts.cubic, shafts.kappa0[i])
        prior = measured.prior[i if measured.prior.shape[0] > 1 else 0]
        one = Measurement(pose, measured.covariance, measured.weight, prior)
        estimate_cold(shaft, one, SECOND_START_CHI_SQUARE, kappa[i], work, rows[i])
