"""The thesis' own spatial schemes, kept as printed (errata applied): Euler 500, Algorithm 3.1, its force estimate, a BVP."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.integrate import solve_bvp
from scipy.optimize import least_squares

Array = np.ndarray
ELEMENTS = 500
THRESHOLD = 1e-3  # of the L1 difference of the tip's quaternion vector between two iterations
MOST_ITERATIONS = 60
STATE = 13  # a row along the rod: position 0:3, quaternion 3:7, n 7:10, m 10:13


@njit(cache=True)
def _derivative(m: Array, n: Array, rod: Array, body: bool, tension: float, out: Array) -> None:
    """out (9,): n', m' of (3.18), (3.19) and the curvatures u; compliances from `rod`, see cosserat_kernels."""
    at = 3 if body else 0
    k0, pull = (0.0, 0.0) if body else (rod[8], tension)
    u1, u2, u3 = rod[at] * m[0] + k0, rod[at + 1] * m[1], rod[at + 2] * m[2]
    out[0] = u3 * n[1] - u2 * n[2] - pull * u2
    out[1] = u1 * n[2] - u3 * n[0] + pull * u1
    out[2] = u2 * n[0] - u1 * n[1]
    out[3] = u3 * m[1] - u2 * m[2] + n[1]
    out[4] = u1 * m[2] - u3 * m[0] - n[0]
    out[5] = u2 * m[0] - u1 * m[1]
    out[6], out[7], out[8] = u1, u2, u3


@njit(cache=True)
def euler(rod: Array, force: Array, tension: float, elements: int) -> tuple[Array, Array]:
    """Arc lengths (n + 1,) from the base, and rows (n + 1, 13), by one sweep to the base and one back; force (3,) N at the tip.

    First (3.18) and (3.19) from the tip, then (3.16) and (3.17) from the base, both by Euler's method. `force` is in the
    tip frame; the quaternion is scalar first and brought back to unit length at every node.
    """
    total = rod[6] + rod[7]
    in_body = int(round(elements * rod[7] / total))
    s, rows, u = np.zeros(elements + 1), np.zeros((elements + 1, STATE)), np.zeros((elements + 1, 3))
    rate = np.zeros(9)
    rows[elements, 7:10] = force
    rows[elements, 9] -= tension
    s[elements] = total
    for i in range(elements, 0, -1):
        body = i <= in_body
        h = rod[7] / in_body if body else rod[6] / (elements - in_body)
        if i == in_body:
            rows[i, 9] += tension
        _derivative(rows[i, 10:13], rows[i, 7:10], rod, body, tension, rate)
        for j in range(6):
            rows[i - 1, 7 + j] = rows[i, 7 + j] - h * rate[j]
        u[i - 1] = rate[6:9]
        s[i - 1] = s[i] - h
    rows[0, 3] = 1.0
    for i in range(elements):
        h, y, z = s[i + 1] - s[i], rows[i], rows[i + 1]
        w, a, b, c = y[3], y[4], y[5], y[6]
        z[0] = y[0] + h * 2.0 * (a * c + w * b)
        z[1] = y[1] + h * 2.0 * (b * c - w * a)
        z[2] = y[2] + h * (2.0 * (w * w + c * c) - 1.0)
        u1, u2, u3 = u[i]
        z[3] = w - 0.5 * h * (a * u1 + b * u2 + c * u3)
        z[4] = a + 0.5 * h * (w * u1 - c * u2 + b * u3)
        z[5] = b + 0.5 * h * (c * u1 + w * u2 - a * u3)
        z[6] = c + 0.5 * h * (-b * u1 + a * u2 + w * u3)
        z[3:7] /= np.sqrt(z[3] ** 2 + z[4] ** 2 + z[5] ** 2 + z[6] ** 2)
    return s, rows


@njit(cache=True)
def matrix(q: Array) -> Array:
    """Rotation matrix (3.15), corrected, of a scalar-first quaternion."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    return np.array([[2 * (w * w + a * a) - 1, 2 * (a * b - w * c), 2 * (a * c + w * b)],
                     [2 * (a * b + w * c), 2 * (w * w + b * b) - 1, 2 * (b * c - w * a)],
                     [2 * (a * c - w * b), 2 * (b * c + w * a), 2 * (w * w + c * c) - 1]])


class FixedPoint(NamedTuple):
    """Algorithm 3.1's end: centre lines of each iteration, and whether it settled."""

    converged: bool
    iterations: int
    lines_m: list[Array]
    rows: Array


def algorithm_3_1(rod: Array, force: Array, tension: float = 0.0, elements: int = ELEMENTS, keep: bool = False) -> FixedPoint:
    """Iterate F_m = R' F_g from F_m = 0 until the tip's quaternion moves by less than 0.001; force (3,) N, base frame."""
    _, rows = euler(rod, np.zeros(3), tension, elements)
    lines = [rows[:, :3].copy()] if keep else []
    for iteration in range(1, MOST_ITERATIONS + 1):
        before = rows[-1, 4:7]
        _, rows = euler(rod, matrix(rows[-1, 3:7]).T @ force, tension, elements)
        if keep:
            lines.append(rows[:, :3].copy())
        if np.abs(rows[-1, 4:7] - before).sum() < THRESHOLD:
            return FixedPoint(True, iteration, lines, rows)
    return FixedPoint(False, MOST_ITERATIONS, lines, rows)


def quaternion_error(q_measured: Array, q_model: Array) -> Array:
    """Vector part (3,) of the relative quaternion, (5.5) corrected, on the short side."""
    w, v = q_measured[0], q_measured[1:]
    error = w * q_model[1:] - q_model[0] * v - np.cross(q_model[1:], v)
    return np.asarray(-error if float(q_measured @ q_model) < 0.0 else error)


def case_residuals(case: int, r_measured: Array, q_measured: Array, r: Array, q: Array, length: float) -> Array:
    """Residuals of (5.6) to (5.11), stacked; poses (k, 3), (k, 4) from the tip backwards, length of the shaft in m."""
    if case == 1:
        return np.asarray(r_measured[0] - r[0]) / length
    if case == 2:
        return np.concatenate([(r_measured[0] - r[0]) / length, quaternion_error(q_measured[0], q[0])])
    apart = (r_measured[1] - r_measured[0] - r[1] + r[0]) / length
    if case == 3:
        return np.asarray(apart)
    if case == 4:
        return np.concatenate([apart, *(quaternion_error(q_measured[j], q[j]) for j in (0, 1))])
    others = (1,) if case == 5 else (1, 2)
    return np.concatenate([quaternion_error(q_measured[0], q_measured[j]) - quaternion_error(q[0], q[j]) for j in others])


def poses(rod: Array, force: Array, offsets: Array, elements: int = ELEMENTS) -> tuple[Array, Array]:
    """Positions (k, 3) and quaternions (k, 4) at `offsets` (k,) m back from the tip, at the nearest nodes of Euler's rows."""
    s, rows = euler(rod, force, 0.0, elements)
    at = np.rint(np.interp(s[-1] - offsets, s, np.arange(len(s)))).astype(int)
    return rows[at, :3], rows[at, 3:7]


def estimate_force(rod: Array, case: int, offsets: Array, r_measured: Array, q_measured: Array) -> Array:
    """Force (3,) N in the tip frame by Levenberg-Marquardt from zero, unweighted, Jacobian by finite differences."""
    def residuals(x: Array) -> Array:
        error = case_residuals(case, r_measured, q_measured, *poses(rod, 0.1 * x, offsets), rod[6])
        return np.nan_to_num(error, nan=1e3, posinf=1e3, neginf=-1e3)

    return np.asarray(0.1 * least_squares(residuals, np.zeros(3), method="lm", xtol=1e-10, ftol=1e-12, max_nfev=400).x)


def conventional(rod: Array, force: Array, nodes: int = ELEMENTS + 1) -> tuple[bool, Array]:
    """The rod in the global frame as a boundary value problem for scipy's solve_bvp: (converged, tip (3,) m). No body.

    State: position, quaternion, moment in the base frame; the force (3,) N is constant along the rod.
    """
    c = rod[:3]

    def rates(_s: Array, y: Array) -> Array:
        w, v, m = y[3], y[4:7], y[7:10]
        R = np.array([[2 * (w * w + v[0] * v[0]) - 1, 2 * (v[0] * v[1] - w * v[2]), 2 * (v[0] * v[2] + w * v[1])],
                      [2 * (v[0] * v[1] + w * v[2]), 2 * (w * w + v[1] * v[1]) - 1, 2 * (v[1] * v[2] - w * v[0])],
                      [2 * (v[0] * v[2] - w * v[1]), 2 * (v[1] * v[2] + w * v[0]), 2 * (w * w + v[2] * v[2]) - 1]])
        u = c[:, None] * np.einsum("jis,js->is", R, m)
        u[0] += rod[8]
        d3 = R[:, 2]
        turn = 0.5 * np.vstack([-(v * u).sum(axis=0), w * u + np.cross(v.T, u.T).T])
        return np.vstack([d3, turn, -np.cross(d3.T, force).T])

    def ends(a: Array, b: Array) -> Array:
        return np.concatenate([a[:3], a[3:7] - [1.0, 0.0, 0.0, 0.0], b[7:10]])

    s, rows = euler(rod, np.zeros(3), 0.0, nodes - 1)
    found = solve_bvp(rates, ends, s, np.vstack([rows[:, :7].T, np.zeros((3, nodes))]), tol=1e-3, max_nodes=20 * nodes)
    return bool(found.success), np.asarray(found.y[:3, -1])
