"""The catheter pressed on a moving sphere: an elastic rod with large rotations, base moment and wall force found together.

r' = R e3, R' = R [u]x, u = (k0, 0, 0) + K^-1 R^T m, m' = -r' x F, m(L) = 0, F = F_wall(r(L)) + weight: a Kirchhoff rod, by
shooting from the base with Runge-Kutta steps. Written apart from `host.mechanics`, which the nominal model uses and which
shoots from the tip.
"""

from __future__ import annotations

import numpy as np
from numba import njit

Array = np.ndarray
STEPS = 24
WALL_SMOOTH_M = 2e-6  # depth over which contact sets in, so that Newton's method has a slope


@njit(cache=True)
def _turn(q: Array, v: Array, out: Array) -> None:
    """Write v (3,) turned by quaternion q (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a = 2.0 * (y * v[2] - z * v[1])
    b = 2.0 * (z * v[0] - x * v[2])
    c = 2.0 * (x * v[1] - y * v[0])
    out[0] = v[0] + w * a + y * c - z * b
    out[1] = v[1] + w * b + z * a - x * c
    out[2] = v[2] + w * c + x * b - y * a


@njit(cache=True)
def _slope(s: Array, k0: float, soft: Array, force: Array, out: Array) -> None:
    """Write the derivative of s (10,): place, quaternion, moment."""
    back, e3, u = np.empty(4), np.empty(3), np.empty(3)
    back[0], back[1], back[2], back[3] = s[3], -s[4], -s[5], -s[6]
    _turn(back, s[7:10], u)
    u[0] = k0 + soft[0] * u[0]
    u[1] *= soft[0]
    u[2] *= soft[1]
    axis = np.zeros(3)
    axis[2] = 1.0
    _turn(s[3:7], axis, e3)
    out[:3] = e3
    w, x, y, z = s[3], s[4], s[5], s[6]
    out[3] = -0.5 * (x * u[0] + y * u[1] + z * u[2])
    out[4] = 0.5 * (w * u[0] + y * u[2] - z * u[1])
    out[5] = 0.5 * (w * u[1] + z * u[0] - x * u[2])
    out[6] = 0.5 * (w * u[2] + x * u[1] - y * u[0])
    out[7] = -(e3[1] * force[2] - e3[2] * force[1])
    out[8] = -(e3[2] * force[0] - e3[0] * force[2])
    out[9] = -(e3[0] * force[1] - e3[1] * force[0])


@njit(cache=True)
def _shoot(length: float, k0: float, soft: Array, z: Array, weight: Array, end: Array) -> None:
    """Write the state (10,) at the tip for base moment z[:3] (scaled) and wall force z[3:6]."""
    force = z[3:6] + weight
    s, d, t = np.zeros(10), np.zeros((4, 10)), np.empty(10)
    s[3] = 1.0
    s[7:10] = z[:3] * 1e-2
    h = length / STEPS
    for _ in range(STEPS):
        _slope(s, k0, soft, force, d[0])
        for r in range(1, 4):
            share = 1.0 if r == 3 else 0.5
            for k in range(10):
                t[k] = s[k] + share * h * d[r - 1, k]
            _slope(t, k0, soft, force, d[r])
        for k in range(10):
            s[k] += h / 6.0 * (d[0, k] + 2.0 * d[1, k] + 2.0 * d[2, k] + d[3, k])
    end[:] = s


@njit(cache=True)
def _miss(end: Array, z: Array, wall: Array, out: Array) -> None:
    """Write the residuals of m(L) = 0 and F = F_wall. wall: centre (3,), radius, stiffness."""
    out[:3] = end[7:10] * 1e2
    away = end[:3] - wall[:3]
    far = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
    depth = wall[3] - far
    push = wall[4] * 0.5 * (depth + np.sqrt(depth * depth + WALL_SMOOTH_M**2))
    for k in range(3):
        out[3 + k] = z[3 + k] - push * away[k] / far


@njit(cache=True)
def _equilibrium(length: float, k0: float, soft: Array, wall: Array, weight: Array, z: Array, end: Array) -> bool:
    """Solve for z (6,) in place by Newton steps; True where it converged."""
    out, ahead, other, slope = np.empty(6), np.empty(6), np.empty(10), np.empty((6, 6))
    for _ in range(40):
        _shoot(length, k0, soft, z, weight, end)
        _miss(end, z, wall, out)
        size = np.max(np.abs(out))
        if size < 1e-9:
            return True
        for k in range(6):
            keep = z[k]
            z[k] = keep + 1e-6
            _shoot(length, k0, soft, z, weight, other)
            _miss(other, z, wall, ahead)
            z[k] = keep
            slope[:, k] = (ahead - out) / 1e-6
        step = np.linalg.solve(slope, -out)
        z += step * min(1.0, 0.2 / max(np.max(np.abs(step)), 1e-12))
    return False


@njit(cache=True)
def session(p: Array, handle: Array, centre: Array, wall: Array, weight: Array) -> tuple[Array, Array, bool]:
    """Return ((n, 3) tip, (n, 3) force on the tip, whether all converged), base frame.

    p: insertion offset, roll slope, knob gain, EI, torsion to bending, distal length. handle (n, 3). centre (n, 3) of the
    sphere, wall: its radius and stiffness. weight (3,) N, a dead load on the tip.
    """
    n = handle.shape[0]
    tip, force, z, end = np.empty((n, 3)), np.empty((n, 3)), np.zeros(6), np.empty(10)
    soft, here = np.array([1.0 / p[3], 1.0 / (p[3] * p[4])]), np.empty(5)
    here[3], here[4] = wall[0], wall[1]
    heavy = np.empty(3)
    for i in range(n):
        roll = p[1] * handle[i, 1]
        c, s = np.cos(roll), np.sin(roll)
        here[0], here[1], here[2] = c * centre[i, 0] + s * centre[i, 1], -s * centre[i, 0] + c * centre[i, 1], centre[i, 2]
        heavy[0], heavy[1], heavy[2] = c * weight[0] + s * weight[1], -s * weight[0] + c * weight[1], weight[2]
        if not _equilibrium(p[5] + handle[i, 0] + p[0], p[2] * handle[i, 2], soft, here, heavy, z, end):
            return tip, force, False
        tip[i, 0], tip[i, 1], tip[i, 2] = c * end[0] - s * end[1], s * end[0] + c * end[1], end[2]
        force[i, 0], force[i, 1], force[i, 2] = c * z[3] - s * z[4], s * z[3] + c * z[4], z[5]
    return tip, force, True
