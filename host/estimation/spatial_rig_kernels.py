"""One frame of poses on the rod of chapter 3: tip force together with the errors of insertion, curvature and roll.

Unknowns x (6,): force on the tip in the tip frame (N), errors of insertion (m), curvature (1/m) and roll (rad). The
sweep of `cosserat_kernels` gives the tangents by force and curvature. One more metre of insertion lengthens the rod at
the sheath, so its tangent is the sweep's own rate at the base: d rho = u x rho - e3, d n = u x n, d theta = -u.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.estimation.lasting_errors import Prior
from host.estimation.spatial_kernels import QUICK
from host.estimation.spatial_residuals import quaternion_error, section
from host.mechanics.cosserat_kernels import ALL_TANGENTS, BODY_1, K0, ROW, SHAFT_1, WORK, sweep
from host.mechanics.equilibrium import roll_quaternion, roll_vector

Array = NDArray[np.float64]

FORCE, INSERTION, CURVATURE, ROLL = slice(0, 3), 3, 4, 5
UNKNOWNS, ROWS_OF_POSE = 6, 6
MOST_STEPS = 25
END_N, END_m, END_per_m, END_rad = 1e-6, 1e-8, 1e-5, 1e-7
SHORTEST_m = 1e-3  # of the rod: nearer to the sheath a force has no lever
LARGEST_DAMPING = 1e6


class TrackedFrame(NamedTuple):
    """The poses of one frame of the tracker, the actuation at its time, and what is known before the poses are seen."""

    compliances: Array  # (6,) of shaft and body, 1/(N m2), as in a rod record
    distal_length_m: float
    actuation: Array  # (3,) insertion (m), curvature (1/m), roll (rad), as the controller has them
    offsets: Array  # (k,) of the sensors, arc lengths back from the tip, m
    poses: Array  # (k, 7) positions (m) and quaternions, base frame
    position_std_m: float
    angle_std_rad: float
    known: Array  # (m, 9) what is known before, whitened: rows by the force in the base frame (3) and by x (6)
    expected: Array  # (m,) values of these rows


def known_rows(prior: Prior, force_sd_N: float) -> tuple[Array, Array]:
    """Return `known` and `expected` of a frame: force and errors, scaled to independent errors of standard deviation 1.

    prior: of the force along the wall and all three joints. force_sd_N: standard deviation of each part of the force.
    """
    m = len(prior.across)
    rows = np.zeros((m + 3, 9))
    rows[:m, :3], rows[m:, 6:] = prior.across, np.eye(3)
    root = np.linalg.cholesky(prior.covariance)
    force = np.eye(3, 9, 3) / force_sd_N
    return np.vstack([force, np.linalg.solve(root, rows)]), np.concatenate([np.zeros(3), np.linalg.solve(root, prior.mean)])


class FrameFit(NamedTuple):
    """What `fit` leaves, arrays written in place."""

    x: Array  # (6,) unknowns; on entry the start
    information: Array  # (6, 6) inverse covariance of x, prior included
    force_N: Array  # (3,) on the tip, base frame
    by_x: Array  # (3, 6) its sensitivity to x
    residual: Array  # (k, 6) measured minus modelled: position (m), turn (rad)


def new_fit(sensors: int) -> FrameFit:
    """Return an empty result for the poses of so many sensors, to be filled by `fit`."""
    return FrameFit(np.zeros(6), np.zeros((6, 6)), np.zeros(3), np.zeros((3, 6)), np.zeros((sensors, 6)))


@njit(cache=True, error_model="numpy", nogil=True)
def _base_curvatures(rod: Array, base: Array, inside: bool, u: Array) -> None:
    """Set u (3,) = curvatures of the rod at the sheath, where `inside` says whether that is the distal shaft."""
    r1, r2, r3, n1, n2, n3 = base[0], base[1], base[2], base[3], base[4], base[5]
    first = SHAFT_1 if inside else BODY_1
    u[0] = rod[first] * (n2 * r3 - n3 * r2) + (rod[K0] if inside else 0.0)
    u[1] = rod[first + 1] * (n3 * r1 - n1 * r3)
    u[2] = rod[first + 2] * (n1 * r2 - n2 * r1)


@njit(cache=True, error_model="numpy", nogil=True)
def model(f: TrackedFrame, x: Array, rows: Array, work: Array, found: FrameFit, A: Array) -> None:
    """Residuals (found.residual), their sensitivity A (k, 6, 6) to x, and the force in the base frame, at the unknowns x.

    Arguments: rows (k + 1, 48) and work (672,), scratch.
    """
    k = f.offsets.shape[0]
    rod, stations, u = np.empty(9), np.empty(k), np.empty(3)
    rod[:6] = f.compliances
    body = f.actuation[0] + x[INSERTION]
    rod[6], rod[7] = max(f.distal_length_m + min(body, 0.0), SHORTEST_m), max(body, 0.0)
    rod[8] = f.actuation[1] + x[CURVATURE]
    total = rod[6] + rod[7]
    for i in range(k):
        stations[i] = min(f.offsets[i], total)
    sweep(rod, x[:3], stations, QUICK, ALL_TANGENTS, rows, work)
    base = rows[k]
    _base_curvatures(rod, base, body <= 0.0, u)
    longer = np.empty((3, 3))  # by insertion: d rho, d n, d theta of the base
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        longer[0, c] = u[a] * base[b] - u[b] * base[a] - (1.0 if c == 2 else 0.0)
        longer[1, c] = u[a] * base[3 + b] - u[b] * base[3 + a]
        longer[2, c] = -u[c]
    roll = f.actuation[2] + x[ROLL]
    r, q, R, error = np.empty(3), np.empty(4), np.empty((3, 3)), np.empty(3)
    position, quaternion = np.empty(3), np.empty(4)
    move, turn = np.empty((3, UNKNOWNS)), np.empty((3, UNKNOWNS))
    for i in range(k):
        inside = max(f.offsets[i] - total, 0.0)
        section(base, rows[i], inside, r, q, R)
        roll_vector(-roll, f.poses[i, :3], position)
        roll_quaternion(-roll, f.poses[i, 3:], quaternion)
        _pose_tangents(base, rows[i], R, r, longer, inside > 0.0, move, turn)
        w = quaternion_error(quaternion, q, error)
        for c in range(3):
            found.residual[i, c], found.residual[i, 3 + c] = position[c] - r[c], error[c]
        v0, v1, v2 = 0.5 * error[0], 0.5 * error[1], 0.5 * error[2]
        for c in range(UNKNOWNS):
            t0, t1, t2 = turn[0, c], turn[1, c], turn[2, c]
            A[i, 0, c], A[i, 1, c], A[i, 2, c] = move[0, c], move[1, c], move[2, c]
            A[i, 3, c] = w * t0 - (v1 * t2 - v2 * t1)
            A[i, 4, c] = w * t1 - (v2 * t0 - v0 * t2)
            A[i, 5, c] = w * t2 - (v0 * t1 - v1 * t0)
    roll_vector(roll, base[3:6], found.force_N)
    for c in range(UNKNOWNS - 1):
        for j in range(3):
            r[j] = longer[1, j] if c == INSERTION else base[24 + 4 * j + (3 if c == CURVATURE else c)]
        roll_vector(roll, r, position)
        for j in range(3):
            found.by_x[j, c] = position[j]
    found.by_x[0, ROLL], found.by_x[1, ROLL], found.by_x[2, ROLL] = -found.force_N[1], found.force_N[0], 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _pose_tangents(
    base: Array, row: Array, R: Array, r: Array, longer: Array, inside: bool, move: Array, turn: Array
) -> None:
    """Set move (3, 6; frame of zero roll) and turn (3, 6; own frame) of a section at r (3,), R (3, 3) by the unknowns."""
    for c in range(UNKNOWNS - 1):
        lane = 3 if c == CURVATURE else c
        for i in range(3):
            own = 0.0 if c == INSERTION else row[36 + 4 * i + lane]
            if c == INSERTION:
                b0, b1, b2 = longer[2, 0], longer[2, 1], longer[2, 2]
            else:
                b0, b1, b2 = base[36 + lane], base[40 + lane], base[44 + lane]
            turn[i, c] = own - R[0, i] * b0 - R[1, i] * b1 - R[2, i] * b2
        t0, t1, t2 = turn[0, c], turn[1, c], turn[2, c]
        v0, v1, v2 = t1 * row[2] - t2 * row[1], t2 * row[0] - t0 * row[2], t0 * row[1] - t1 * row[0]
        if c != INSERTION:
            v0, v1, v2 = v0 + row[12 + lane], v1 + row[16 + lane], v2 + row[20 + lane]
        for i in range(3):
            by_base = longer[0, i] if c == INSERTION else base[12 + 4 * i + lane]
            move[i, c] = R[i, 0] * v0 + R[i, 1] * v1 + R[i, 2] * v2 - by_base
        if inside:  # on the sheath's axis, whatever the force; insertion moves it along
            for i in range(3):
                move[i, c], turn[i, c] = (1.0 if c == INSERTION and i == 2 else 0.0), 0.0
    # the measured pose is turned back by the roll: more roll turns the modelled one forward
    move[0, ROLL], move[1, ROLL], move[2, ROLL] = -r[1], r[0], 0.0
    for i in range(3):
        turn[i, ROLL] = R[2, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _normal_equations(f: TrackedFrame, found: FrameFit, x: Array, A: Array, H: Array, g: Array) -> float:
    """Set H (6, 6) = information and g (6,) = slope of the weighted cost, prior included; returns the cost."""
    cost = 0.0
    g[:], H[:] = 0.0, 0.0
    slope = np.empty(UNKNOWNS)
    for t in range(f.known.shape[0]):
        z = f.expected[t]
        for j in range(UNKNOWNS):
            slope[j] = f.known[t, 3 + j]
            z -= f.known[t, 3 + j] * x[j]
        for i in range(3):
            z -= f.known[t, i] * found.force_N[i]
            for j in range(UNKNOWNS):
                slope[j] += f.known[t, i] * found.by_x[i, j]
        cost += z * z
        for i in range(UNKNOWNS):
            g[i] += slope[i] * z
            for j in range(UNKNOWNS):
                H[i, j] += slope[i] * slope[j]
    for s in range(f.offsets.shape[0]):
        for row in range(ROWS_OF_POSE):
            std = f.position_std_m if row < 3 else f.angle_std_rad
            weight, z = 1.0 / (std * std), found.residual[s, row]
            cost += weight * z * z
            for i in range(UNKNOWNS):
                g[i] += weight * A[s, row, i] * z
                for j in range(UNKNOWNS):
                    H[i, j] += weight * A[s, row, i] * A[s, row, j]
    return cost


@njit(cache=True, error_model="numpy", nogil=True)
def fit(f: TrackedFrame, largest_N: float, found: FrameFit) -> tuple[bool, float]:
    """Levenberg-Marquardt on the six unknowns from found.x, in place. Returns (settled, weighted cost at the answer)."""
    k = f.offsets.shape[0]
    rows, work, A = np.zeros((k + 1, ROW)), np.zeros(WORK), np.zeros((k, ROWS_OF_POSE, UNKNOWNS))
    H, g, trial = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
    x = found.x
    model(f, x, rows, work, found, A)
    cost, damping, settled = _normal_equations(f, found, x, A, H, g), 0.0, False
    for _ in range(MOST_STEPS):
        damped = H.copy()
        for i in range(UNKNOWNS):
            damped[i, i] += damping * H[i, i]
        step = np.linalg.solve(damped, g)
        force = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        small = force < END_N and abs(step[3]) < END_m and abs(step[4]) < END_per_m and abs(step[5]) < END_rad
        if small and damping < 1e-2:
            settled = True
            break
        trial[:] = x + step
        new = 1e300
        if trial[0] ** 2 + trial[1] ** 2 + trial[2] ** 2 <= largest_N**2:
            model(f, trial, rows, work, found, A)
            H_new, g_new = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
            new = _normal_equations(f, found, trial, A, H_new, g_new)
            if not math.isfinite(new):
                new = 1e300
        if new < cost or (small and new < cost * (1.0 + 1e-9)):
            x[:], H[:], g[:], cost = trial, H_new, g_new, new
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = 10.0 * damping if damping > 0.0 else 1e-3
            if damping > LARGEST_DAMPING:
                break
    model(f, x, rows, work, found, A)
    cost = _normal_equations(f, found, x, A, found.information, g)
    return settled, cost


@njit(cache=True, error_model="numpy", nogil=True)
def refit(f: TrackedFrame, found: FrameFit, at: FrameFit) -> None:
    """Correct the answer `found` of `fit` by one step whose sensitivities are those at the unknowns at.x.

    At the answer itself the sensitivities contain the noise of the poses, and their product with the residuals has a mean
    other than zero. At a point that the noise of this frame did not reach it is zero.

    Args:
        f: the frame; what is known before may be less than in `fit`.
        found: the answer of `fit`.
        at: on entry at.x is the point; on return all parts but the residual are those of the corrected answer.
    """
    k = f.offsets.shape[0]
    rows, work, A, g = np.zeros((k + 1, ROW)), np.zeros(WORK), np.zeros((k, ROWS_OF_POSE, UNKNOWNS)), np.zeros(UNKNOWNS)
    model(f, at.x, rows, work, at, A)
    at.residual[:], at.force_N[:], at.x[:] = found.residual, found.force_N, found.x
    _normal_equations(f, at, at.x, A, at.information, g)
    step = np.linalg.solve(at.information, g)
    for j in range(UNKNOWNS):
        at.x[j] += step[j]
        for i in range(3):
            at.force_N[i] += at.by_x[i, j] * step[j]
