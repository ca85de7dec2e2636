"""The seed thesis' own numerical schemes, kept for comparison: Euler with 500 elements, Algorithm 3.1, fsolve-like fits.

Two sweeps: moments and forces from the tip down, (3.18) and (3.19) with their tendon terms corrected; then position and
quaternion from the base up, (3.16) and (3.17) with r'_x put right. Nothing else in the package uses this.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.rotations import conjugate, normalized_into, quaternion_product, turn_back

Array = NDArray[np.float64]

ELEMENTS = 500
ORIENTATION_THRESHOLD = 1e-3  # section 3.2.2.2
MOST_PASSES = 100
DIFFERENCE_N = 1e-6


class Iteration(NamedTuple):
    """Outcome of Algorithm 3.1: tip pose, last force in the tip frame, passes, and whether the threshold was met."""

    position_m: Array
    quaternion_wxyz: Array
    force_tip_N: Array
    passes: int
    converged: bool


@njit(cache=True, error_model="numpy", nogil=True)
def euler_sweep(rod: Array, force: Array, tension_N: float, elements: int, shape: Array) -> None:
    """Set shape (elements + 1, 7): positions and quaternions from base to tip, for the force (3,) in the tip frame.

    Arguments: rod (9,) record of `rod.rod_record`; tension_N of the tendon; the curvature k0 is part of the record.
    """
    total = rod[6] + rod[7]
    h = total / elements
    u = np.empty((elements + 1, 3))
    n1, n2, n3 = force[0], force[1], force[2] - tension_N
    m1 = m2 = m3 = 0.0
    on_shaft = True
    for i in range(elements, -1, -1):
        if on_shaft and i * h < rod[7] - 1e-12:
            on_shaft = False
            n3 += tension_N  # the tendon's contact ends here: its thrust leaves the rod
        c1, c2, c3 = (rod[0], rod[1], rod[2]) if on_shaft else (rod[3], rod[4], rod[5])
        k0, pull = (rod[8], tension_N) if on_shaft else (0.0, 0.0)
        u1, u2, u3 = c1 * m1 + k0, c2 * m2, c3 * m3
        u[i, 0], u[i, 1], u[i, 2] = u1, u2, u3
        d1 = -u2 * n3 + u3 * n2 - u2 * pull
        d2 = u1 * n3 - u3 * n1 + u1 * pull
        d3 = u2 * n1 - u1 * n2
        e1, e2, e3 = u3 * m2 - u2 * m3 + n2, u1 * m3 - u3 * m1 - n1, u2 * m1 - u1 * m2
        n1, n2, n3 = n1 - h * d1, n2 - h * d2, n3 - h * d3
        m1, m2, m3 = m1 - h * e1, m2 - h * e2, m3 - h * e3
    _lay_out(u, h, shape)


@njit(cache=True, error_model="numpy", nogil=True)
def _lay_out(u: Array, h: float, shape: Array) -> None:
    """Set shape (elements + 1, 7) from the curvatures u (elements + 1, 3): (3.16), (3.17) by Euler, quaternion kept unit."""
    shape[0] = 0.0
    shape[0, 3] = 1.0
    for i in range(u.shape[0] - 1):
        q1, q2, q3, q4 = shape[i, 3], shape[i, 4], shape[i, 5], shape[i, 6]
        k1, k2, t = u[i, 0], u[i, 1], u[i, 2]
        shape[i + 1, 0] = shape[i, 0] + h * 2.0 * (q2 * q4 + q1 * q3)
        shape[i + 1, 1] = shape[i, 1] + h * 2.0 * (q3 * q4 - q1 * q2)
        shape[i + 1, 2] = shape[i, 2] + h * (2.0 * (q1 * q1 + q4 * q4) - 1.0)
        shape[i + 1, 3] = q1 + 0.5 * h * (-q2 * k1 - q3 * k2 - q4 * t)
        shape[i + 1, 4] = q2 + 0.5 * h * (q1 * k1 - q4 * k2 + q3 * t)
        shape[i + 1, 5] = q3 + 0.5 * h * (q4 * k1 + q1 * k2 - q2 * t)
        shape[i + 1, 6] = q4 + 0.5 * h * (-q3 * k1 + q2 * k2 + q1 * t)
        normalized_into(shape[i + 1, 3:], shape[i + 1, 3:])


@njit(cache=True, error_model="numpy", nogil=True)
def algorithm_3_1(rod: Array, force: Array, tension_N: float, elements: int, threshold: float) -> Iteration:
    """Fixed point of the thesis for a force (3,) in the base frame, from the unloaded shape (its text; F_m = 0)."""
    shape, x, before = np.empty((elements + 1, 7)), np.zeros(3), np.zeros(4)
    for passes in range(1, MOST_PASSES + 1):
        euler_sweep(rod, x, tension_N, elements, shape)
        q = shape[elements, 3:]
        change = abs(q[1] - before[1]) + abs(q[2] - before[2]) + abs(q[3] - before[3])
        before[:] = q
        turn_back(q, force, x)
        if passes > 1 and change < threshold:
            return Iteration(shape[elements, :3].copy(), q.copy(), x, passes, True)
    return Iteration(shape[elements, :3].copy(), shape[elements, 3:].copy(), x, MOST_PASSES, False)


def residual(case: int, length_m: float, positions: Array, quaternions: Array, model: tuple[Array, Array]) -> Array:
    """Components under the norms of (5.6) to (5.11), unweighted: positions over the shaft's length, quaternion errors.

    Arguments: measured positions (k, 3) and quaternions (k, 4) of sensors 0, 1, 2; model, the same of the model.
    """
    r, q = model
    move = positions[0] - r[0] if case <= 2 else positions[1] - positions[0] - r[1] + r[0] if case <= 4 else None
    if case in (1, 3) and move is not None:
        return move
    if case in (2, 4) and move is not None:
        turns = [quaternion_error(quaternions[j], q[j]) for j in range(case // 2)]
        return np.concatenate([move / length_m, *turns])
    turns = [quaternion_error(quaternions[0], quaternions[j]) - quaternion_error(q[0], q[j]) for j in range(1, case - 3)]
    return np.concatenate(turns)


def quaternion_error(q_star: Array, q_bar: Array) -> Array:
    """Difference (3,) of two orientations by (5.5), with q_4(s_0) corrected: the vector part of conj(q_star) q_bar."""
    return quaternion_product(conjugate(q_star), q_bar)[1:]


def estimate(
    rod: Array, length_m: float, case: int, offsets: Array, positions: Array, quaternions: Array, elements: int = ELEMENTS
) -> tuple[Array, int]:
    """Force (3,) in the tip frame as the thesis finds it: unweighted, from zero, finite differences. And model sweeps."""
    total = rod[6] + rod[7]
    nodes = np.rint((total - offsets) / total * elements).astype(int)
    shape = np.empty((elements + 1, 7))
    sweeps = 0

    def of(x: Array) -> Array:
        nonlocal sweeps
        sweeps += 1
        euler_sweep(rod, x, 0.0, elements, shape)
        return residual(case, length_m, positions, quaternions, (shape[nodes, :3], shape[nodes, 3:]))

    x, damping = np.zeros(3), 1e-2
    z = of(x)
    for _ in range(60):
        J = np.column_stack([(of(x + DIFFERENCE_N * e) - z) / DIFFERENCE_N for e in np.eye(3)])
        H, slope = J.T @ J, -J.T @ z
        for _ in range(20):
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-300 * np.eye(3), slope)
            new = of(x + step)
            if new @ new < z @ z:
                break
            damping *= 10.0
        else:
            return x, sweeps
        x, z, damping = x + step, new, 0.1 * damping
        if np.linalg.norm(step) < 1e-6 * (np.linalg.norm(x) + 1e-6):
            break
    return x, sweeps


def tip_pose_500(rod: Array, force: Array) -> tuple[Array, Array]:
    """Tip position (3,) and quaternion (4,) with the thesis' 500 elements; the force in the tip frame."""
    shape = np.empty((ELEMENTS + 1, 7))
    euler_sweep(rod, force, 0.0, ELEMENTS, shape)
    return shape[-1, :3].copy(), shape[-1, 3:].copy()
