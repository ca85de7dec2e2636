"""Energy of a chain of helical segments with a force on its tip: gradient and Hessian by Gauss points, Newton, loading."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

GAUSS = 3
ABSCISSAE = np.array([0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15)])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
TOLERANCE_rad, ON_THE_WAY_rad = 1e-9, 1e-3  # of the last step's turn, at full load and before
LARGEST_GUESS_ERROR_rad = 0.3
SMALLEST_LOAD_STEP = 1e-5


@njit(cache=True, error_model="numpy", nogil=True)
def screw(u: Array, length: float, R: Array, p: Array) -> None:
    """R (3, 3), p (3,): a helix of constant curvature u (3,) in its own frame, from its start to `length`.

    R = exp([u] L), p = integral of R e3. Series below 1e-3 rad, so that straight segments are ordinary.
    """
    x, y, z = u[0] * length, u[1] * length, u[2] * length
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-2:
        a = 1.0 - square / 6.0 + square * square / 120.0
        b = 0.5 - square / 24.0 + square * square / 720.0
        c = 1.0 / 6.0 - square / 120.0 + square * square / 5040.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
        c = (1.0 - a) / square
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    p[0] = length * (b * y + c * x * z)
    p[1] = length * (-b * x + c * y * z)
    p[2] = length * (1.0 - c * (x * x + y * y))


@njit(cache=True, error_model="numpy", nogil=True)
def place(segments: Array, u: Array, R: Array, r: Array, R_end: Array, r_end: Array) -> None:
    """Frames R (n, 3, 3, 3) and positions r (n, 3, 3) at the Gauss points, R_end (n + 1, 3, 3), r_end (n + 1, 3) at ends."""
    S, p = np.empty((3, 3)), np.empty(3)
    R_end[0] = np.eye(3)
    r_end[0] = 0.0
    for i in range(u.shape[0]):
        for g in range(GAUSS + 1):
            screw(u[i], segments[i, 0] * (ABSCISSAE[g] if g < GAUSS else 1.0), S, p)
            to_R, to_r = (R[i, g], r[i, g]) if g < GAUSS else (R_end[i + 1], r_end[i + 1])
            for a in range(3):
                to_r[a] = r_end[i, a] + R_end[i, a, 0] * p[0] + R_end[i, a, 1] * p[1] + R_end[i, a, 2] * p[2]
                for b in range(3):
                    to_R[a, b] = R_end[i, a, 0] * S[0, b] + R_end[i, a, 1] * S[1, b] + R_end[i, a, 2] * S[2, b]


@njit(cache=True, error_model="numpy", nogil=True)
def work_of_force(  # noqa: C901 - one loop over the points of a segment; cut in two it would need nine arguments
    segments: Array, R: Array, r: Array, tip: Array, force: Array, slope: Array, curve: Array
) -> None:
    """Set slope (3 n,), curve (3 n, 3 n): first and second change of force . tip by the curvatures.

    A turn alpha of everything beyond s moves the tip by alpha x (tip - r(s)), and a turn beta further out at t adds
    alpha x (beta x p), p = tip - r(t): force . that = alpha' [p force' - (force . p) 1] beta.
    """
    n = segments.shape[0]
    A, B, X = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.empty((3, 3))
    for i in range(n):
        own = np.zeros((3, 3))
        for a in range(3):
            slope[3 * i + a] = 0.0
        for g in range(GAUSS):
            w = WEIGHTS[g] * segments[i, 0]
            p0, p1, p2 = tip[0] - r[i, g, 0], tip[1] - r[i, g, 1], tip[2] - r[i, g, 2]
            along = p0 * force[0] + p1 * force[1] + p2 * force[2]
            t0, t1 = p1 * force[2] - p2 * force[1], p2 * force[0] - p0 * force[2]
            t2 = p0 * force[1] - p1 * force[0]
            for b in range(3):
                f_b = force[0] * R[i, g, 0, b] + force[1] * R[i, g, 1, b] + force[2] * R[i, g, 2, b]
                X[0, b], X[1, b] = w * (p0 * f_b - along * R[i, g, 0, b]), w * (p1 * f_b - along * R[i, g, 1, b])
                X[2, b] = w * (p2 * f_b - along * R[i, g, 2, b])
                slope[3 * i + b] += w * (t0 * R[i, g, 0, b] + t1 * R[i, g, 1, b] + t2 * R[i, g, 2, b])
            for a in range(3):
                for b in range(3):
                    # of the segment's own points those before this one count, and half of this one
                    for c in range(3):
                        own[a, b] += (A[i, c, a] + 0.5 * w * R[i, g, c, a]) * X[c, b]
                    B[i, a, b] += X[a, b]
            for a in range(3):
                for b in range(3):
                    A[i, a, b] += w * R[i, g, a, b]
        for a in range(3):
            for b in range(3):
                curve[3 * i + a, 3 * i + b] = own[a, b] + own[b, a]
    for i in range(n):
        for j in range(i + 1, n):
            for a in range(3):
                for b in range(3):
                    total = A[i, 0, a] * B[j, 0, b] + A[i, 1, a] * B[j, 1, b] + A[i, 2, a] * B[j, 2, b]
                    curve[3 * i + a, 3 * j + b] = curve[3 * j + b, 3 * i + a] = total


@njit(cache=True, error_model="numpy", nogil=True)
def factorize(H: Array) -> int:
    """H (m, m) symmetric -> L D L' in place (D on the diagonal); returns how many pivots are negative: unstable modes."""
    m, negative = H.shape[0], 0
    for j in range(m):
        for k in range(j):
            H[j, j] -= H[j, k] * H[j, k] * H[k, k]
        if H[j, j] < 0.0:
            negative += 1
        for i in range(j + 1, m):
            for k in range(j):
                H[i, j] -= H[i, k] * H[j, k] * H[k, k]
            H[i, j] /= H[j, j]
    return negative


@njit(cache=True, error_model="numpy", nogil=True)
def back_substitute(H: Array, b: Array) -> None:
    """Set b (m,) = solution of the system that `factorize` left in H."""
    m = H.shape[0]
    for i in range(m):
        for k in range(i):
            b[i] -= H[i, k] * b[k]
    for i in range(m - 1, -1, -1):
        b[i] /= H[i, i]
        for k in range(i + 1, m):
            b[i] -= H[k, i] * b[k]


@njit(cache=True, error_model="numpy", nogil=True)
def newton(
    segments: Array, force: Array, load: float, u: Array, trust: float, tolerance: float, rate: Array
) -> tuple[bool, float, int, int]:
    """Newton on the curvatures u (n, 3), in place, at the force times `load`. (converged, first turn, passes, unstable).

    rate (n, 3), written: change of u with the load. A turn is the largest change of a segment's bend, in rad.
    """
    n = segments.shape[0]
    R, r, R_end, r_end = np.empty((n, 3, 3, 3)), np.empty((n, 3, 3)), np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    slope, H, step = np.empty(3 * n), np.empty((3 * n, 3 * n)), np.empty(3 * n)
    first = before = 0.0
    unstable = 0
    for passes in range(1, 13):
        place(segments, u, R, r, R_end, r_end)
        work_of_force(segments, R, r, r_end[n], force, slope, H)
        for i in range(3 * n):
            for j in range(3 * n):
                H[i, j] *= -load
        for i in range(n):
            for a in range(3):
                stiffness = segments[i, 0] * segments[i, 1 + a]
                natural = segments[i, 4] if a == 0 else 0.0
                H[3 * i + a, 3 * i + a] += stiffness
                step[3 * i + a] = load * slope[3 * i + a] - stiffness * (u[i, a] - natural)
        unstable = factorize(H)
        back_substitute(H, step)
        back_substitute(H, slope)
        turn = 0.0
        for i in range(n):
            square = 0.0
            for a in range(3):
                u[i, a] += step[3 * i + a]
                rate[i, a] = slope[3 * i + a]
                square += (segments[i, 0] * step[3 * i + a]) ** 2
            turn = max(turn, math.sqrt(square))
        if passes == 1:
            first = turn
        if turn < tolerance:
            return True, first, passes, unstable
        if not turn < (trust if passes == 1 else max(0.5 * before, tolerance)):
            return False, first, passes, unstable
        before = turn
    return False, first, 12, unstable


@njit(cache=True, error_model="numpy", nogil=True)
def load_up(segments: Array, force: Array, first_step: float, u: Array) -> tuple[bool, float, int, int]:
    """Carry u (n, 3) along the branch from the unloaded shape to full load. (converged, load reached, passes, unstable)."""
    n = segments.shape[0]
    rate, trial, new_rate = np.zeros((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    u[:] = 0.0
    for i in range(n):
        u[i, 0] = segments[i, 4]
    load, h, passes, unstable = 0.0, first_step, 0, 0
    while load < 1.0:
        h = min(h, 1.0 - load)
        trial[:] = u + h * rate
        trust = LARGEST_GUESS_ERROR_rad if load > 0.0 else 2.0
        tolerance = TOLERANCE_rad if load + h >= 1.0 else ON_THE_WAY_rad
        done, error, used, modes = newton(segments, force, load + h, trial, trust, tolerance, new_rate)
        passes += used
        if done and modes != unstable and h > 1e-3:
            done = False
        if done:
            u[:], rate[:] = trial, new_rate
            load, unstable = load + h, modes
            h *= min(3.0, max(0.5, math.sqrt(0.3 * LARGEST_GUESS_ERROR_rad / max(error, 1e-9))))
        else:
            h *= 0.3
        if h < SMALLEST_LOAD_STEP and load < 1.0:
            return False, load, passes, unstable
    return True, load, passes, unstable
