"""The nominal model of the catheter rig in the proof's generator: the one that a rig engineer would calibrate.

Written from the published description of kind `rig` (docs/nominal-models.md), apart from host's twin, so that sizes of
planted effects can be stated relative to it and a crudely calibrated nominal file can be written next to the recordings.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.optimize import least_squares

Array = np.ndarray
PARAMETERS = (
    "insertion_gain",
    "insertion_offset_m",
    "roll_slope",
    "roll_offset_rad",
    "knob_gain_per_m_rad",
    "knob_offset_per_m",
    "bending_stiffness_N_m2",
    "wall_distance_m",
    "wall_stiffness_N_per_m",
)
DISTAL_M, SHAFT_OFFSET_M, TORSION_TO_BENDING = 0.110, 0.030, 0.77
_SCALE = np.array([0.02, 1e-3, 0.02, 0.02, 0.5, 0.5, 5e-5, 1e-3, 200.0])
_LEAST = np.array([0.2, -0.106, 0.05, -3.0, 1.0, -50.0, 2e-5, 1e-4, 20.0])
_MOST = np.array([3.0, 0.0, 3.0, 3.0, 200.0, 50.0, 5e-3, 0.2, 1e5])
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(5)
_NODE, _WEIGHT = 0.5 * (_NODE + 1.0), 0.5 * _WEIGHT


@njit(cache=True)
def _arc(kappa: float, s: float, out: Array) -> None:
    """out (3,) = point at arc length s of an arc that leaves the origin along e3 and bends towards -e2."""
    angle = kappa * s
    out[0] = 0.0
    if abs(angle) < 1e-4:
        out[1], out[2] = -0.5 * angle * s, s * (1.0 - angle * angle / 6.0)
    else:
        out[1], out[2] = -(1.0 - math.cos(angle)) / kappa, math.sin(angle) / kappa


@njit(cache=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _deflect(
    kappa: float,
    length: float,
    until: float,
    force: Array,
    soft: tuple[float, float],
    node: Array,
    weight: Array,
    shift: Array,
    turn: Array,
) -> None:
    """shift (3,) m and turn (3,) rad at arc length `until` by a small tip force (3,) N; soft: 1/EI, 1/GJ."""
    tip, end, here, arm, moment, strain = np.empty((6, 3))
    _arc(kappa, length, tip)
    _arc(kappa, until, end)
    shift[:] = 0.0
    turn[:] = 0.0
    for i in range(node.size):
        s = node[i] * until
        _arc(kappa, s, here)
        for k in range(3):
            arm[k] = tip[k] - here[k]
        _cross(arm, force, moment)
        c, n = math.cos(kappa * s), math.sin(kappa * s)
        along1, along2 = c * moment[1] + n * moment[2], -n * moment[1] + c * moment[2]
        bend, twist = soft[0] * along1, soft[1] * along2
        strain[0], strain[1], strain[2] = soft[0] * moment[0], c * bend - n * twist, n * bend + c * twist
        for k in range(3):
            arm[k] = end[k] - here[k]
        _cross(strain, arm, moment)
        for k in range(3):
            shift[k] += weight[i] * until * moment[k]
            turn[k] += weight[i] * until * strain[k]


@njit(cache=True)
def _quaternion_product(a: Array, b: Array, out: Array) -> None:
    w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    out[0], out[1], out[2] = w, x, y


@njit(cache=True)
def outputs_of(p: Array, handle: Array, force: Array, node: Array, weight: Array, shaft_m: float, out: Array) -> None:
    """out (n, 17) = tip x, y, z, quaternion, the same of the shaft's sensor, force on the wall.

    p (9,) as PARAMETERS; handle (n, 3) m, rad, rad; force (n, 3) recorded (N). Wall normal e3.
    """
    soft = (1.0 / p[6], 1.0 / (TORSION_TO_BENDING * p[6]))
    shift, turn, load, point, q, half = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    roll_q = np.zeros(4)
    for i in range(handle.shape[0]):
        length = max(DISTAL_M + p[0] * handle[i, 0] + p[1], 1e-3)
        roll = p[2] * handle[i, 1] + p[3]
        kappa = p[4] * handle[i, 2] + p[5]
        c, s = math.cos(roll), math.sin(roll)
        roll_q[0], roll_q[3] = math.cos(0.5 * roll), math.sin(0.5 * roll)
        load[0] = -(c * force[i, 0] + s * force[i, 1])
        load[1] = -(-s * force[i, 0] + c * force[i, 1])
        load[2] = -force[i, 2]
        for tool in range(2):
            at = length - shaft_m * tool
            row = out[i, 7 * tool : 7 * tool + 7]
            if at <= 0.0:
                row[:] = 0.0
                row[2], row[3], row[6] = at, roll_q[0], roll_q[3]
                continue
            _arc(kappa, at, point)
            _deflect(kappa, length, at, load, soft, node, weight, shift, turn)
            for k in range(3):
                point[k] += shift[k]
            row[0], row[1], row[2] = c * point[0] - s * point[1], s * point[0] + c * point[1], point[2]
            size = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
            share = math.sin(0.5 * size) / size if size > 1e-12 else 0.5
            half[0] = math.cos(0.5 * size)
            half[1], half[2], half[3] = share * turn[0], share * turn[1], share * turn[2]
            q[0], q[1], q[2], q[3] = math.cos(0.5 * kappa * at), math.sin(0.5 * kappa * at), 0.0, 0.0
            _quaternion_product(half, q, q)
            _quaternion_product(roll_q, q, row[3:])
        _arc(kappa, length, point)
        over = point[2] - p[7]
        out[i, 14:] = 0.0
        if over > 0.0:
            load[0], load[1], load[2] = 0.0, 0.0, 1.0
            _deflect(kappa, length, length, load, soft, node, weight, shift, turn)
            out[i, 16] = over / (1.0 / p[8] + shift[2])


def predict(p: Array, handle: Array, force: Array) -> Array:
    """Nominal outputs (n, 17) as `outputs_of`, for handle (n, 3) and recorded force (n, 3; NaN counts as none)."""
    out = np.empty((len(handle), 17))
    outputs_of(np.asarray(p, float), np.ascontiguousarray(handle), np.nan_to_num(force), _NODE, _WEIGHT, SHAFT_OFFSET_M, out)
    return out


def _turned(of: Array, to: Array) -> Array:
    """Rotation vectors (n, 3) that turn orientation `of` (n, 4) into `to` (n, 4), in the frame of `of`."""
    w, v = of[:, :1], -of[:, 1:]
    scalar = w[:, 0] * to[:, 0] - np.sum(v * to[:, 1:], axis=1)
    vector = w * to[:, 1:] + to[:, :1] * v + np.cross(v, to[:, 1:])
    vector *= np.where(scalar < 0.0, -1.0, 1.0)[:, None]
    size = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(size, np.abs(scalar))
    return vector * np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0)[:, None]


def residual(p: Array, handle: Array, outputs: Array) -> Array:
    """Recorded minus nominal, (n, 15): tip shift (m), tip turn (rad), the same of the shaft, force (N). NaN stays NaN.

    outputs (n, 17) as recorded; its force columns are also the load that bends the nominal shaft.
    """
    return apart(predict(p, handle, outputs[:, 14:]), outputs)


def apart(model: Array, outputs: Array) -> Array:
    """Outputs minus model, both (n, 17), as `residual`."""
    parts = [
        outputs[:, 0:3] - model[:, 0:3],
        _turned(model[:, 3:7], outputs[:, 3:7]),
        outputs[:, 7:10] - model[:, 7:10],
        _turned(model[:, 10:14], outputs[:, 10:14]),
        outputs[:, 14:] - model[:, 14:],
    ]
    return np.hstack(parts)


def fit(start: Array, handle: Array, outputs: Array, sigma: Array, evaluations: int = 12, robust: bool = False) -> Array:
    """Parameters (9,) that bring the nominal model nearest to outputs (n, 17), channels weighed by sigma (15,)."""

    def errors(z: Array) -> Array:
        return np.nan_to_num(residual(start + z * _SCALE, handle, outputs) / sigma).ravel()

    low, high = (_LEAST - start) / _SCALE, (_MOST - start) / _SCALE
    found = least_squares(
        errors,
        np.clip(np.zeros(9), low + 1e-9, high - 1e-9),
        bounds=(low, high),
        max_nfev=evaluations,
        loss="soft_l1" if robust else "linear",
    )
    return np.asarray(start + found.x * _SCALE)
