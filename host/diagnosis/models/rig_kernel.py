"""Shape of the rig's catheter, an arc plus linear elastic deflection by the tip force, and the contact force it meets."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
_NODES, _WEIGHTS = (np.ascontiguousarray(a) for a in np.polynomial.legendre.leggauss(5))
SHORTEST_M = 1e-3
_NO_LOAD = (0.0, 0.0, 0.0)


class Handle(NamedTuple):
    """Joints at n samples: insertion (m), roll (rad), unloaded curvature of the arc (1/m); each (n,)."""

    insertion: Array
    roll: Array
    kappa: Array


class Loads(NamedTuple):
    """Loads at n samples, base frame.

    force: (3, n) N on the tip. extra: (3, n) N, on the tip without contact too. per_length: (3, n) N/m on what is outside
    the sheath. point: (3, n) N at arc length point_at (n,), in m.
    """

    force: Array
    extra: Array
    per_length: Array
    point: Array
    point_at: Array


class ShaftBuild(NamedTuple):
    """Properties of the shaft.

    flex: (n,) 1/EI, 1/(N m^2). twist_ratio: EI/GJ. distal: length (m) of the arc when it is fully out. offset: distance (m)
    of the second sensor behind the tip.
    """

    flex: Array
    twist_ratio: float
    distal: float
    offset: float


class Wall(NamedTuple):
    """Law of contact: k r (depth/r)^exponent + damping depth' + crossley k depth depth' + a Maxwell branch.

    stiffness: (n,) k, N/m. exponent: 1 is linear. reference: r, m. relax, relax_time: the branch's stiffness relative to k,
    and its time constant (s).
    """

    stiffness: Array
    exponent: float
    reference: float
    damping: float
    crossley: float
    relax: float
    relax_time: float


class _Arc(NamedTuple):
    """The shaft of one sample at roll 0: length (m), straight part (m), curvature of the other part (1/m), 1/EI and 1/GJ."""

    length: float
    straight: float
    kappa: float
    flex: float
    twist: float


@njit(cache=True)
def _free_point(arc: _Arc, s: float) -> tuple[float, float, float, float]:
    """(y, z, cosine and sine of the angle) of the unloaded arc at arc length s, roll 0: bends towards -y."""
    if s <= arc.straight:
        return 0.0, s, 1.0, 0.0
    a = s - arc.straight
    theta = arc.kappa * a
    c, sn = math.cos(theta), math.sin(theta)
    if abs(theta) < 1e-5:
        return -0.5 * theta * a, arc.straight + a, c, sn
    return -(1.0 - c) / arc.kappa, arc.straight + sn / arc.kappa, c, sn


@njit(cache=True)
def _moments_beyond(arc: _Arc, s: float) -> tuple[float, float]:
    """Integrals of (y, z) along the unloaded arc from s to its tip, roll 0."""
    straight, kappa = arc.straight, arc.kappa
    k = kappa if abs(kappa) > 1e-3 else (1e-3 if kappa >= 0.0 else -1e-3)
    a, b = max(s - straight, 0.0), arc.length - straight
    sy = -((b - a) - (math.sin(k * b) - math.sin(k * a)) / k) / k
    sz = straight * (b - a) + (math.cos(k * a) - math.cos(k * b)) / (k * k)
    if s < straight:
        sz += 0.5 * (straight * straight - s * s)
    return sy, sz


@njit(cache=True)
def _is_zero(vector: Vector) -> bool:
    return vector[0] == 0.0 and vector[1] == 0.0 and vector[2] == 0.0


@njit(cache=True)
def _deflection(arc: _Arc, s1: float, force: Vector, load: Vector, out: Array) -> None:
    """Displacement out[0:3] and rotation out[3:6] at s1 by a tip force and a load per length, roll 0.

    They are integrals of the change of curvature over [0, s1].
    """
    out[:] = 0.0
    fx, fy, fz = force
    straight = arc.straight
    yt, zt, _, _ = _free_point(arc, arc.length)
    y1, z1, _, _ = _free_point(arc, s1)
    loaded = not _is_zero(load)
    for part in range(2):
        a = 0.0 if part == 0 else min(straight, s1)
        b = min(straight, s1) if part == 0 else s1
        if b - a <= 0.0:
            continue
        for k in range(_NODES.size):
            s = 0.5 * (a + b) + 0.5 * (b - a) * _NODES[k]
            w = 0.5 * (b - a) * _WEIGHTS[k]
            y, z, c, sn = _free_point(arc, s)
            dy, dz = yt - y, zt - z
            mx, my, mz = dy * fz - dz * fy, dz * fx, -dy * fx
            if loaded:
                sy, sz = _moments_beyond(arc, s)
                sy, sz = sy - (arc.length - s) * y, sz - (arc.length - s) * z
                mx, my, mz = mx + sy * load[2] - sz * load[1], my + sz * load[0], mz - sy * load[0]
            about_b = arc.flex * (my * c + mz * sn)
            about_t = arc.twist * (-my * sn + mz * c)
            kx, ky, kz = w * arc.flex * mx, w * (about_b * c - about_t * sn), w * (about_b * sn + about_t * c)
            ey, ez = y1 - y, z1 - z
            out[0] += ky * ez - kz * ey
            out[1] += -kx * ez
            out[2] += kx * ey
            out[3] += kx
            out[4] += ky
            out[5] += kz


@njit(cache=True)
def _add_point(arc: _Arc, s1: float, at: float, force: Vector, work: Array, out: Array) -> None:
    """Add to `out` (6,) the deflection at s1 by a force at arc length `at`, roll 0; beyond it the shaft only follows."""
    inner = _Arc(at, arc.straight, arc.kappa, arc.flex, arc.twist)
    _deflection(inner, min(s1, at), force, _NO_LOAD, work)
    y, z, _, _ = _free_point(arc, at)
    y1, z1, _, _ = _free_point(arc, max(s1, at))
    ey, ez = y1 - y, z1 - z
    out += work
    out[0] += work[4] * ez - work[5] * ey
    out[1] += -work[3] * ez
    out[2] += work[3] * ey


@njit(cache=True)
def _pose(arc: _Arc, s1: float, roll: float, bend: Array, p: Array, R: Array) -> None:
    """Position p (3,) and rotation R (3, 3) at s1 in the base frame after deflection `bend`."""
    y, z, ct, st = _free_point(arc, s1)
    c, s = math.cos(roll), math.sin(roll)
    x0, y0, z0 = bend[0], y + bend[1], z + bend[2]
    p[0], p[1], p[2] = c * x0 - s * y0, s * x0 + c * y0, z0
    rx, ry, rz = bend[3], bend[4], bend[5]
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-5 else 0.5
    for j in range(3):
        vx, vy, vz = (1.0, 0.0, 0.0) if j == 0 else (0.0, ct, st) if j == 1 else (0.0, -st, ct)
        ux, uy, uz = ry * vz - rz * vy, rz * vx - rx * vz, rx * vy - ry * vx
        wx, wy, wz = ry * uz - rz * uy, rz * ux - rx * uz, rx * uy - ry * ux
        gx, gy, gz = vx + a * ux + b * wx, vy + a * uy + b * wy, vz + a * uz + b * wz
        R[0, j], R[1, j], R[2, j] = c * gx - s * gy, s * gx + c * gy, gz


@njit(cache=True)
def _to_roll_0(c: float, s: float, vector: Vector) -> Vector:
    """Turn a vector of the base frame back by the roll of cosine c and sine s."""
    return c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]


@njit(cache=True)
def _column(values: Array, i: int) -> Vector:
    return values[0, i], values[1, i], values[2, i]


@njit(cache=True)
def shapes(
    handle: Handle, loads: Loads, build: ShaftBuild, normal: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Poses under load, and the free tip with its compliance.

    Args:
        handle: joints at n samples.
        loads: loads at n samples.
        build: stiffness and lengths.
        normal: (3,) of the wall.

    Returns:
        Tip position (3, n) m, tip rotation (3, 3, n), the same of the second sensor, the tip without contact (3, n) m, and
        its compliance (3, n) m/N by a unit force along the normal.
    """
    insertion, roll, kappa = handle
    n = insertion.size
    tip, shaft, free, soft = np.empty((3, n)), np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    tip_R, shaft_R = np.empty((3, 3, n)), np.empty((3, 3, n))
    bend, unit, p, R = np.zeros(6), np.zeros(6), np.zeros(3), np.zeros((3, 3))
    for i in range(n):
        straight = max(insertion[i], 0.0)
        length = straight + max(build.distal + min(insertion[i], 0.0), SHORTEST_M)
        c, s = math.cos(roll[i]), math.sin(roll[i])
        arc = _Arc(length, straight, kappa[i], build.flex[i], build.flex[i] * build.twist_ratio)
        at = min(loads.point_at[i], length)
        even = _to_roll_0(c, s, _column(loads.per_length, i))
        press = _to_roll_0(c, s, _column(loads.point, i))
        always = _column(loads.extra, i)
        fx, fy, fz = _column(loads.force, i)
        push = _to_roll_0(c, s, (fx + always[0], fy + always[1], fz + always[2]))
        # The tip under all loads.
        _deflection(arc, length, push, even, bend)
        if not _is_zero(press):
            _add_point(arc, length, at, press, unit, bend)
        _pose(arc, length, roll[i], bend, p, R)
        tip[:, i] = p
        tip_R[:, :, i] = R
        # The second sensor; in the sheath it lies on the axis.
        s1 = length - build.offset
        if s1 > 0.0:
            _deflection(arc, s1, push, even, bend)
            if not _is_zero(press):
                _add_point(arc, s1, at, press, unit, bend)
            _pose(arc, s1, roll[i], bend, p, R)
        else:
            bend[:] = 0.0
            _pose(arc, 0.0, roll[i], bend, p, R)
            p[2] = s1
        shaft[:, i] = p
        shaft_R[:, :, i] = R
        # The tip without contact.
        bend[:] = 0.0
        if not (_is_zero(always) and _is_zero(even)):
            _deflection(arc, length, _to_roll_0(c, s, always), even, bend)
        if not _is_zero(press):
            _add_point(arc, length, at, press, unit, bend)
        y, z, _, _ = _free_point(arc, length)
        x0, y0 = bend[0], y + bend[1]
        free[0, i], free[1, i], free[2, i] = c * x0 - s * y0, s * x0 + c * y0, z + bend[2]
        # Its displacement by a unit force along the normal.
        _deflection(arc, length, _to_roll_0(c, s, (normal[0], normal[1], normal[2])), _NO_LOAD, bend)
        soft[0, i], soft[1, i], soft[2, i] = c * bend[0] - s * bend[1], s * bend[0] + c * bend[1], bend[2]
    return tip, tip_R, shaft, shaft_R, free, soft


@njit(cache=True)
def contact(gap: Array, soft: Array, wall: Wall, dt_s: float) -> Array:
    """Return the normal force (n,) in N on the wall in equilibrium with the shaft.

    Args:
        gap: (n,) m, how far the free tip would be inside; depth = gap - soft * force.
        soft: (n,) m/N, normal compliance of the shaft.
        wall: law of contact.
        dt_s: period of the samples.
    """
    out = np.zeros(gap.size)
    depth_old, slow = 0.0, 0.0
    plain = wall.exponent == 1.0 and wall.damping == 0.0 and wall.crossley == 0.0 and wall.relax == 0.0
    decay = math.exp(-dt_s / wall.relax_time) if wall.relax_time > 0.0 else 0.0
    for i in range(gap.size):
        k, c = wall.stiffness[i], max(soft[i], 0.0)
        if gap[i] <= 0.0:
            depth_old, slow = 0.0, slow * decay
            continue
        low, high = 0.0, gap[i] / max(c, 1e-9)
        high = min(high, 50.0)
        f = min(gap[i] / (1.0 / k + c), high)
        for _ in range(0 if plain else 60):
            depth = gap[i] - c * f
            rate = (depth - depth_old) / dt_s
            branch = depth + (slow - depth) * decay
            law = (
                k * wall.reference * (max(depth, 0.0) / wall.reference) ** wall.exponent
                + wall.damping * rate
                + wall.crossley * k * max(depth, 0.0) * rate
            )
            law += wall.relax * k * (depth - branch)
            if law > f:
                low = f
            else:
                high = f
            if high - low < 1e-7:
                break
            f = 0.5 * (low + high)
        out[i] = f
        depth_old = gap[i] - c * f
        slow = depth_old + (slow - depth_old) * decay
    return out


@njit(cache=True)
def drag_along(tangent: Array, distance: float) -> Array:
    """Vector friction state (3, n), length at most one, dragged along by the tip's tangential path (3, n) over
    `distance`.
    """
    out = np.zeros(tangent.shape)
    z = np.zeros(3)
    for i in range(1, tangent.shape[1]):
        size = 0.0
        for j in range(3):
            z[j] += (tangent[j, i] - tangent[j, i - 1]) / distance
            size += z[j] * z[j]
        if size > 1.0:
            z /= math.sqrt(size)
        out[:, i] = z
    return out


@njit(cache=True)
def rotation_logs(reference: Array, R: Array) -> Array:
    """Rotation vectors (3, n) of reference^T R, both (3, 3, n)."""
    n = R.shape[2]
    out, m = np.empty((3, n)), np.zeros((3, 3))
    for i in range(n):
        for a in range(3):
            for b in range(3):
                m[a, b] = reference[0, a, i] * R[0, b, i] + reference[1, a, i] * R[1, b, i] + reference[2, a, i] * R[2, b, i]
        wx, wy, wz = 0.5 * (m[2, 1] - m[1, 2]), 0.5 * (m[0, 2] - m[2, 0]), 0.5 * (m[1, 0] - m[0, 1])
        sine = math.sqrt(wx * wx + wy * wy + wz * wz)
        cosine = 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1.0)
        angle = math.atan2(sine, cosine)
        scale = angle / sine if sine > 1e-9 else 1.0
        out[0, i], out[1, i], out[2, i] = scale * wx, scale * wy, scale * wz
    return out


def matrices(quaternion: Array) -> Array:
    """Rotation matrices (3, 3, n) of quaternions (4, n), scalar first; NaN stays NaN."""
    w, x, y, z = quaternion / np.sqrt(np.sum(quaternion**2, axis=0))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
