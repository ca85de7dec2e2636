"""Measured minus modelled poses for the six sensor cases of chapter 5, with the model's sensitivity to the force."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.rotations import matrix_into, product_into

Array = NDArray[np.float64]

ROWS_OF_CASE = np.array([0, 3, 6, 3, 9, 3, 6])  # indexed by the case
SENSORS_OF_CASE = np.array([0, 1, 1, 2, 2, 2, 3])
MOST_ROWS = 11  # nine of case 4 and two of a surface prior
SCRATCH = 45  # see `_views`


class MeasuredPose(NamedTuple):
    """One sample: the measured poses, where the sensors are, and the noise."""

    rod: Array  # (9,) record of the rod, cut off behind the last sensor in cases 5 and 6 without a prior
    whole_rod: Array  # (9,) the same, never cut off
    stations: Array  # (k,) arc lengths of the sensors back from the tip, ascending, exposed
    inside: Array  # (k,) how far each is inside the straight sheath, m
    case: int
    positions: Array  # (k, 3) base frame, m
    quaternions: Array  # (k, 4)
    whitening: Array  # (m, m) lower triangular: inverse root of the residuals' covariance
    bend: float  # of the fine sweeps: QUICK or CAREFUL
    prior: Array  # (2, 3) directions across the surface's normal over their standard deviation (1/N), or (0, 3)


@njit(cache=True, error_model="numpy", nogil=True)
def quaternion_error(q_measured: Array, q_model: Array, error: Array) -> float:
    """Set error (3,) = twice the vector part of conj(model) measured; returns its scalar part. (5.5), corrected.

    In the model's own frame; for small angles the rotation vector. The sign is chosen so that the turn is the short one.
    """
    w = q_model[0] * q_measured[0] + q_model[1] * q_measured[1] + q_model[2] * q_measured[2] + q_model[3] * q_measured[3]
    sign = -2.0 if w < 0.0 else 2.0
    a0, a1, a2, a3 = q_model[0], -q_model[1], -q_model[2], -q_model[3]
    b0, b1, b2, b3 = q_measured[0], q_measured[1], q_measured[2], q_measured[3]
    error[0] = sign * (a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2)
    error[1] = sign * (a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1)
    error[2] = sign * (a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0)
    return abs(w)


@njit(cache=True, error_model="numpy", nogil=True)
def section(base: Array, row: Array, inside_m: float, r: Array, q: Array, R: Array) -> None:
    """Position r (3,), quaternion q (4,), matrix R (3, 3) of a section in the base frame, from rows (48,) of a sweep."""
    a0, a1, a2, a3 = base[6], -base[7], -base[8], -base[9]
    b0, b1, b2, b3 = row[6], row[7], row[8], row[9]
    q[0] = a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3
    q[1] = a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2
    q[2] = a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1
    q[3] = a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0
    matrix_into(q, R)
    for i in range(3):
        r[i] = -base[i] + R[i, 0] * row[0] + R[i, 1] * row[1] + R[i, 2] * row[2]
    r[2] -= inside_m


@njit(cache=True, error_model="numpy", nogil=True)
def section_tangents(base: Array, row: Array, R: Array, turn: Array, move: Array) -> None:
    """Set turn (3, 3), move (3, 3): the section's turn (its own frame) and motion (base frame) by the force's components."""
    for c in range(3):
        for i in range(3):
            turn[i, c] = row[36 + 4 * i + c] - R[0, i] * base[36 + c] - R[1, i] * base[40 + c] - R[2, i] * base[44 + c]
        t0, t1, t2 = turn[0, c], turn[1, c], turn[2, c]
        v0 = row[12 + c] + t1 * row[2] - t2 * row[1]
        v1 = row[16 + c] + t2 * row[0] - t0 * row[2]
        v2 = row[20 + c] + t0 * row[1] - t1 * row[0]
        for i in range(3):
            move[i, c] = R[i, 0] * v0 + R[i, 1] * v1 + R[i, 2] * v2 - base[12 + 4 * i + c]


@njit(cache=True, error_model="numpy", nogil=True)
def error_sensitivity(w: float, error: Array, turn: Array, at: int, A: Array) -> None:
    """A[at:at+3] = minus d error / d force, for an error of scalar part w and a model that turns by `turn` (3, 3)."""
    v0, v1, v2 = 0.5 * error[0], 0.5 * error[1], 0.5 * error[2]
    for c in range(3):
        t0, t1, t2 = turn[0, c], turn[1, c], turn[2, c]
        A[at, c] = w * t0 - (v1 * t2 - v2 * t1)
        A[at + 1, c] = w * t1 - (v2 * t0 - v0 * t2)
        A[at + 2, c] = w * t2 - (v0 * t1 - v1 * t0)


@njit(cache=True, error_model="numpy", nogil=True)
def _views(scratch: Array) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    return (
        scratch[0:3],
        scratch[3:6],
        scratch[6:10],
        scratch[10:19].reshape((3, 3)),
        scratch[19:28].reshape((3, 3)),
        scratch[28:37].reshape((3, 3)),
        scratch[37:41],
    )


@njit(cache=True, error_model="numpy", nogil=True)
def residuals(p: MeasuredPose, rows: Array, tangents: bool, z: Array, A: Array, scratch: Array) -> None:
    """Set z (m,) = measured minus modelled, A (m, 3) = the model's sensitivity to the tip-frame force (if `tangents`).

    Arguments: rows (k + 1, 48) of a sweep, sensors then base; scratch (45,). Rows of z, per case:
    1 position of sensor 0; 2 and its orientation; 3 position of 1 relative to 0; 4 and both orientations;
    5 orientation of 1 relative to 0; 6 and of 2 relative to 0. Orientation errors in the sensor's frame, those of
    cases 5 and 6 in the frame of sensor 0, so that the noise of sensor 0 is the same in both.
    """
    case, positions, quaternions = p.case, p.positions, p.quaternions
    if case >= 5:
        for j in range(1, 3 if case == 6 else 2):
            _relative_turn(p, rows, j, tangents, z, A, scratch)
        return
    r, error, q, R, turn, move, _ = _views(scratch)
    base = rows[rows.shape[0] - 1]
    for i in range(3):
        z[i] = positions[0, i] if case <= 2 else positions[1, i] - positions[0, i]
    for j in range(2 if case >= 3 else 1):
        section(base, rows[j], p.inside[j], r, q, R)
        sign = -1.0 if case >= 3 and j == 0 else 1.0
        for i in range(3):
            z[i] -= sign * r[i]
        if tangents:
            section_tangents(base, rows[j], R, turn, move)
            for i in range(3):
                for c in range(3):
                    A[i, c] = sign * move[i, c] + (A[i, c] if j == 1 else 0.0)
        if case == 2 or case == 4:
            at = 3 + 3 * j
            w = quaternion_error(quaternions[j], q, error)
            for i in range(3):
                z[at + i] = error[i]
            if tangents:
                error_sensitivity(w, error, turn, at, A)


@njit(cache=True, error_model="numpy", nogil=True)
def _relative_turn(p: MeasuredPose, rows: Array, j: int, tangents: bool, z: Array, A: Array, scratch: Array) -> None:
    """Set three rows of z = error of the orientation of sensor j relative to sensor 0, in its frame; A its sensitivity."""
    row0, row, q0, q, at = rows[0], rows[j], p.quaternions[0], p.quaternions[j], 3 * (j - 1)
    _, error, conj, R, turn, _, model = _views(scratch)
    measured = scratch[41:45]
    conj[0], conj[1], conj[2], conj[3] = row0[6], -row0[7], -row0[8], -row0[9]
    product_into(conj, row[6:10], model)
    matrix_into(model, R)
    conj[0], conj[1], conj[2], conj[3] = q0[0], -q0[1], -q0[2], -q0[3]
    product_into(conj, q, measured)
    for i in range(1, 4):  # the error in the frame of sensor 0 is that of the inverse turns, with the sign changed
        model[i], measured[i] = -model[i], -measured[i]
    w = quaternion_error(measured, model, error)
    for i in range(3):
        z[at + i] = -error[i]
    if tangents:
        for c in range(3):
            for i in range(3):
                turn[i, c] = R[i, 0] * row[36 + c] + R[i, 1] * row[40 + c] + R[i, 2] * row[44 + c] - row0[36 + 4 * i + c]
        error_sensitivity(w, error, turn, at, A)
