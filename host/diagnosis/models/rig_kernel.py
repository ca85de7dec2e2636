"""Shape of the rig's catheter, an arc plus linear elastic deflection by the tip force, and the contact force it meets."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
NODES, WEIGHTS = (np.ascontiguousarray(a) for a in np.polynomial.legendre.leggauss(5))
SHORTEST_M = 1e-3
NO_LOAD = (0.0, 0.0, 0.0)


@njit(cache=True)
def _free_point(s: float, straight: float, kappa: float) -> tuple[float, float, float]:
    """(y, z, angle) of the unloaded arc at arc length s, roll 0: bends towards -y."""
    if s <= straight:
        return 0.0, s, 0.0
    a = s - straight
    theta = kappa * a
    if abs(theta) < 1e-5:
        return -0.5 * theta * a, straight + a, theta
    return -(1.0 - math.cos(theta)) / kappa, straight + math.sin(theta) / kappa, theta


@njit(cache=True)
def _moments_beyond(s: float, length: float, straight: float, kappa: float) -> tuple[float, float]:
    """Integrals of (y, z) along the unloaded arc from s to its tip, roll 0."""
    k = kappa if abs(kappa) > 1e-3 else (1e-3 if kappa >= 0.0 else -1e-3)
    a, b = max(s - straight, 0.0), length - straight
    sy = -((b - a) - (math.sin(k * b) - math.sin(k * a)) / k) / k
    sz = straight * (b - a) + (math.cos(k * a) - math.cos(k * b)) / (k * k)
    if s < straight:
        sz += 0.5 * (straight * straight - s * s)
    return sy, sz


@njit(cache=True)
def _deflection(
    s1: float,
    length: float,
    straight: float,
    kappa: float,
    fx: float,
    fy: float,
    fz: float,
    load: tuple[float, float, float],
    flex: float,
    twist: float,
    nodes: Array,
    weights: Array,
    out: Array,
) -> None:
    """Displacement out[0:3] and rotation out[3:6] at s1 by a tip force and a load per length, roll 0: integrals of
    curvature change over [0, s1].
    """
    out[:] = 0.0
    yt, zt, _ = _free_point(length, straight, kappa)
    y1, z1, _ = _free_point(s1, straight, kappa)
    loaded = load[0] != 0.0 or load[1] != 0.0 or load[2] != 0.0
    for part in range(2):
        a = 0.0 if part == 0 else min(straight, s1)
        b = min(straight, s1) if part == 0 else s1
        if b - a <= 0.0:
            continue
        for k in range(nodes.size):
            s = 0.5 * (a + b) + 0.5 * (b - a) * nodes[k]
            w = 0.5 * (b - a) * weights[k]
            y, z, theta = _free_point(s, straight, kappa)
            dy, dz = yt - y, zt - z
            mx, my, mz = dy * fz - dz * fy, dz * fx, -dy * fx
            if loaded:
                sy, sz = _moments_beyond(s, length, straight, kappa)
                sy, sz = sy - (length - s) * y, sz - (length - s) * z
                mx, my, mz = mx + sy * load[2] - sz * load[1], my + sz * load[0], mz - sy * load[0]
            c, sn = math.cos(theta), math.sin(theta)
            about_b = flex * (my * c + mz * sn)
            about_t = twist * (-my * sn + mz * c)
            kx, ky, kz = w * flex * mx, w * (about_b * c - about_t * sn), w * (about_b * sn + about_t * c)
            ey, ez = y1 - y, z1 - z
            out[0] += ky * ez - kz * ey
            out[1] += -kx * ez
            out[2] += kx * ey
            out[3] += kx
            out[4] += ky
            out[5] += kz


@njit(cache=True)
def _add_point(
    s1: float,
    at: float,
    straight: float,
    kappa: float,
    force: tuple[float, float, float],
    flex: float,
    twist: float,
    nodes: Array,
    weights: Array,
    work: Array,
    out: Array,
) -> None:
    """Adds to `out` (6,) the deflection at s1 by a force at arc length `at`, roll 0; beyond it the shaft only follows."""
    _deflection(min(s1, at), at, straight, kappa, *force, NO_LOAD, flex, twist, nodes, weights, work)
    y, z, _ = _free_point(at, straight, kappa)
    y1, z1, _ = _free_point(max(s1, at), straight, kappa)
    ey, ez = y1 - y, z1 - z
    out += work
    out[0] += work[4] * ez - work[5] * ey
    out[1] += -work[3] * ez
    out[2] += work[3] * ey


@njit(cache=True)
def _pose(s1: float, straight: float, kappa: float, roll: float, bend: Array, p: Array, R: Array) -> None:
    """Position p (3,) and rotation R (3, 3) at s1 in the base frame after deflection `bend`."""
    y, z, theta = _free_point(s1, straight, kappa)
    c, s = math.cos(roll), math.sin(roll)
    ct, st = math.cos(theta), math.sin(theta)
    x0, y0, z0 = bend[0], y + bend[1], z + bend[2]
    p[0], p[1], p[2] = c * x0 - s * y0, s * x0 + c * y0, z0
    rx, ry, rz = bend[3], bend[4], bend[5]
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-5 else 0.5
    free = np.zeros((3, 3))
    free[0, 0], free[1, 1], free[1, 2], free[2, 1], free[2, 2] = 1.0, ct, -st, st, ct
    for j in range(3):
        vx, vy, vz = free[0, j], free[1, j], free[2, j]
        ux, uy, uz = ry * vz - rz * vy, rz * vx - rx * vz, rx * vy - ry * vx
        wx, wy, wz = ry * uz - rz * uy, rz * ux - rx * uz, rx * uy - ry * ux
        gx, gy, gz = vx + a * ux + b * wx, vy + a * uy + b * wy, vz + a * uz + b * wz
        R[0, j], R[1, j], R[2, j] = c * gx - s * gy, s * gx + c * gy, gz


@njit(cache=True)
def _free_tip(
    length: float,
    straight: float,
    kappa: float,
    c: float,
    s: float,
    always: tuple[float, float, float],
    even: tuple[float, float, float],
    press: tuple[float, float, float],
    at: float,
    flex: float,
    twist: float,
    nodes: Array,
    weights: Array,
    work: Array,
    bend: Array,
    out: Array,
) -> None:
    """Where the tip (3,) would be without contact, base frame; c, s: cosine and sine of the roll; even, press: at roll 0."""
    y, z, _ = _free_point(length, straight, kappa)
    ex, ey, ez = always
    bend[:] = 0.0
    if ex != 0.0 or ey != 0.0 or ez != 0.0 or even[0] != 0.0 or even[1] != 0.0 or even[2] != 0.0:
        gx, gy = c * ex + s * ey, -s * ex + c * ey
        _deflection(length, length, straight, kappa, gx, gy, ez, even, flex, twist, nodes, weights, bend)
    if press[0] != 0.0 or press[1] != 0.0 or press[2] != 0.0:
        _add_point(length, at, straight, kappa, press, flex, twist, nodes, weights, work, bend)
    x0, y0 = bend[0], y + bend[1]
    out[0], out[1], out[2] = c * x0 - s * y0, s * x0 + c * y0, z + bend[2]


@njit(cache=True)
def _softness(
    length: float,
    straight: float,
    kappa: float,
    c: float,
    s: float,
    normal: Array,
    flex: float,
    twist: float,
    nodes: Array,
    weights: Array,
    bend: Array,
    out: Array,
) -> None:
    """Displacement (3,) of the tip by a unit force along `normal`, base frame."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    gx, gy = c * nx + s * ny, -s * nx + c * ny
    _deflection(length, length, straight, kappa, gx, gy, nz, NO_LOAD, flex, twist, nodes, weights, bend)
    out[0], out[1], out[2] = c * bend[0] - s * bend[1], s * bend[0] + c * bend[1], bend[2]


@njit(cache=True)
def shapes(
    insertion: Array,
    roll: Array,
    kappa: Array,
    force: Array,
    extra: Array,
    load: Array,
    point: Array,
    point_at: Array,
    flex: Array,
    twist_ratio: float,
    distal: float,
    offset: float,
    normal: Array,
    nodes: Array,
    weights: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Poses under tip force, and the free tip with its compliance.

    Arguments:
        insertion, roll, kappa: (n,). force: (3, n) on the tip, base frame; extra: (3, n) further tip force that is there
        without contact; load: (3, n) force per exposed length; point: (3, n) a force at arc length point_at (n,).
        flex: (n,) 1/EI. twist_ratio: EI/GJ. distal: length of the arc fully out. offset: of the second sensor behind the
        tip.
        normal: (3,) of the wall.
    Returns:
        tip position (3, n), tip rotation (3, 3, n), shaft position, shaft rotation, free tip (3, n), compliance by a
        unit normal force (3, n).
    """
    n = insertion.size
    tip, shaft, free, soft = np.empty((3, n)), np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    tip_R, shaft_R = np.empty((3, 3, n)), np.empty((3, 3, n))
    bend, unit, p, R = np.zeros(6), np.zeros(6), np.zeros(3), np.zeros((3, 3))
    for i in range(n):
        straight = max(insertion[i], 0.0)
        length = straight + max(distal + min(insertion[i], 0.0), SHORTEST_M)
        c, s = math.cos(roll[i]), math.sin(roll[i])
        twist = flex[i] * twist_ratio
        fx, fy, fz = force[0, i] + extra[0, i], force[1, i] + extra[1, i], force[2, i] + extra[2, i]
        gx, gy = c * fx + s * fy, -s * fx + c * fy
        even = (c * load[0, i] + s * load[1, i], -s * load[0, i] + c * load[1, i], load[2, i])
        _deflection(length, length, straight, kappa[i], gx, gy, fz, even, flex[i], twist, nodes, weights, bend)
        at = min(point_at[i], length)
        px, py, pz = point[0, i], point[1, i], point[2, i]
        pressed = px != 0.0 or py != 0.0 or pz != 0.0
        press = (c * px + s * py, -s * px + c * py, pz)
        if pressed:
            _add_point(length, at, straight, kappa[i], press, flex[i], twist, nodes, weights, unit, bend)
        _pose(length, straight, kappa[i], roll[i], bend, p, R)
        tip[:, i] = p
        tip_R[:, :, i] = R
        s1 = length - offset
        if s1 > 0.0:
            _deflection(s1, length, straight, kappa[i], gx, gy, fz, even, flex[i], twist, nodes, weights, bend)
            if pressed:
                _add_point(s1, at, straight, kappa[i], press, flex[i], twist, nodes, weights, unit, bend)
            _pose(s1, straight, kappa[i], roll[i], bend, p, R)
        else:
            bend[:] = 0.0
            _pose(0.0, straight, 0.0, roll[i], bend, p, R)
            p[2] = s1
        shaft[:, i] = p
        shaft_R[:, :, i] = R
        always = (extra[0, i], extra[1, i], extra[2, i])
        _free_tip(length, straight, kappa[i], c, s, always, even, press, at, flex[i], twist, nodes, weights, unit, bend, p)
        free[:, i] = p
        _softness(length, straight, kappa[i], c, s, normal, flex[i], twist, nodes, weights, unit, p)
        soft[:, i] = p
    return tip, tip_R, shaft, shaft_R, free, soft


@njit(cache=True)
def contact(
    gap: Array,
    soft: Array,
    stiffness: Array,
    exponent: float,
    reference: float,
    damping: float,
    crossley: float,
    relax: float,
    relax_time: float,
    dt_s: float,
) -> Array:
    """Normal force (n,) on the wall in equilibrium with the shaft.

    gap: (n,) how far the free tip would be inside; soft: (n,) normal compliance of the shaft; depth = gap - soft * force.
    Law: k r (depth/r)^exponent + damping depth' + crossley k depth depth' + a Maxwell branch (relax k, relax_time).
    exponent 1: linear.
    """
    out = np.zeros(gap.size)
    depth_old, slow = 0.0, 0.0
    decay = math.exp(-dt_s / relax_time) if relax_time > 0.0 else 0.0
    for i in range(gap.size):
        k, c = stiffness[i], max(soft[i], 0.0)
        if gap[i] <= 0.0:
            depth_old, slow = 0.0, slow * decay
            continue
        low, high = 0.0, gap[i] / max(c, 1e-9)
        high = min(high, 50.0)
        f = min(gap[i] / (1.0 / k + c), high)
        plain = exponent == 1.0 and damping == 0.0 and crossley == 0.0 and relax == 0.0
        for _ in range(0 if plain else 60):
            depth = gap[i] - c * f
            rate = (depth - depth_old) / dt_s
            branch = depth + (slow - depth) * decay
            law = (
                k * reference * (max(depth, 0.0) / reference) ** exponent
                + damping * rate
                + crossley * k * max(depth, 0.0) * rate
            )
            law += relax * k * (depth - branch)
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
    out = np.empty((3, n))
    for i in range(n):
        m = np.zeros((3, 3))
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
