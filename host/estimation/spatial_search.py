"""Search among several forces: scattered starts, the curve of a position, and one sample from poses to force."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.estimation.position_curve import MOST_ROOTS, every_force, force_next_to, has_chord
from host.estimation.spatial_kernels import (
    BAD_INPUT,
    CAREFUL,
    COVARIANCE,
    RESIDUAL,
    SAME,
    UNIT_TOLERANCE,
    Scratch,
    Search,
    Sensors,
    covariance_of,
    estimate,
    estimate_on_branch,
    new_scratch,
    sample_of,
    unweighted,
)
from host.estimation.spatial_residuals import MeasuredPose
from host.mechanics.equilibrium import roll_quaternion, roll_vector
from host.mechanics.tip_shooting import length3

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def search(p: MeasuredPose, largest_N: float, starts: Array, acceptable: float, found: Array, s: Scratch) -> tuple[int, int]:
    """Forces that explain the sample, from the starts (n, 3) and on the unloaded branch: found (k, 3). (count, sweeps).

    A force counts where its cost is below `acceptable` and it differs from those before by more than noise; k are kept.
    """
    count = sweeps = 0
    x, apart = np.empty(3), np.empty(3)
    for i in range(-1, starts.shape[0]):
        if i < 0:
            settled, cost, used = estimate_on_branch(p, largest_N, x, s)
        else:
            x[:] = starts[i]
            settled, cost, used = estimate(p, largest_N, x, s)
        sweeps += used
        if not settled or not cost <= acceptable or count == found.shape[0]:
            continue
        new = True
        for j in range(count):
            for k in range(3):
                apart[k] = x[k] - found[j, k]
            distance = 1e-4 * (apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
            for k in range(3):
                for n in range(3):
                    distance += apart[k] * s.information[k, n] * apart[n]
            new = new and distance > SAME
        if new:
            found[count] = x
            count += 1
    return count, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def start_position(p: MeasuredPose, largest_N: float, fair: float, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """Cases 1 and 3: the force next to x (3,), or where x is zero the least that grows from no force. In place."""
    if length3(x) > 0.0:
        return force_next_to(p, largest_N, fair, x, s)
    forces = np.empty((MOST_ROOTS, 3))
    count, sweeps = every_force(p, largest_N, fair, forces, s)
    if count > 0:
        x[:] = forces[0]
    settled, cost, used = estimate(p, largest_N, x, s)
    return settled, cost, sweeps + used


@njit(cache=True, error_model="numpy", nogil=True)
def best_of(p: MeasuredPose, largest_N: float, starts: Array, fair: float, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """From x (3,) and, while the cost stays above `fair`, from the starts (n, 3) and on the unloaded branch.

    The branch is tried after the first 26 starts: it is the surer way, but as dear as all of them. Returns (settled,
    cost, sweeps) of the cheapest force, left in x; s holds what belongs to it.
    """
    settled, cost, sweeps = start_position(p, largest_N, fair, x, s) if has_chord(p) else estimate(p, largest_N, x, s)
    if cost <= fair and (settled or length3(x) > 0.9 * largest_N):
        return settled, cost, sweeps
    trial = np.empty(3)
    turn = min(26, starts.shape[0])
    for i in range(starts.shape[0] + 1):
        if i == turn:
            ok, new, used = estimate_on_branch(p, largest_N, trial, s)
        else:
            trial[:] = starts[i - 1 if i > turn else i]
            ok, new, used = estimate(p, largest_N, trial, s)
        sweeps += used
        if ok and (not settled or new < cost):
            settled, cost, x[:] = True, new, trial
            if cost <= fair:
                return True, cost, sweeps
    _, cost, used = estimate(p, largest_N, x, s)
    return settled, cost, sweeps + used


@njit(cache=True, error_model="numpy", nogil=True)
def poses_are_bad(offsets: Array, poses: Array) -> bool:
    """Whether an offset or a pose (k, 7) is not finite, out of order or not of unit length; quaternions are normalized."""
    for i in range(poses.shape[0]):
        bad = not offsets[i] >= 0.0 or (i > 0 and not offsets[i] > offsets[i - 1])
        for j in range(7):
            bad = bad or not math.isfinite(poses[i, j])
        norm = math.sqrt(poses[i, 3] ** 2 + poses[i, 4] ** 2 + poses[i, 5] ** 2 + poses[i, 6] ** 2)
        if bad or not math.isfinite(offsets[i]) or not abs(norm - 1.0) <= UNIT_TOLERANCE:
            return True
        for j in range(3, 7):
            poses[i, j] /= norm
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_sample(
    rod: Array, sensors: Sensors, poses: Array, roll_rad: float, limits: Search, found: Array
) -> tuple[int, float, int]:
    """One sample from unchecked poses (k, 7) to force, covariance, residual. Returns (settled or BAD_INPUT, cost, sweeps).

    Arguments: found (13,), layout above; its first three numbers are the guess to start from. Poses are changed: their
    quaternions are normalized.
    """
    offsets = sensors.offsets
    if poses_are_bad(offsets, poses):
        return BAD_INPUT, 0.0, 0
    k = offsets.shape[0]
    positions, quaternions = np.empty((k, 3)), np.empty((k, 4))
    for i in range(k):
        roll_vector(-roll_rad, poses[i, :3], positions[i])
        roll_quaternion(-roll_rad, poses[i, 3:], quaternions[i])
    p = sample_of(rod, offsets, sensors.case, positions, quaternions, sensors.whitening, CAREFUL, np.zeros((0, 3)))
    s, x = new_scratch(k), found[:COVARIANCE]
    settled, cost, sweeps = best_of(p, limits.largest_N, limits.starts, limits.fair, x, s)
    covariance_of(s, found[COVARIANCE:RESIDUAL].reshape((3, 3)))
    found[RESIDUAL] = unweighted(sensors.case, sensors.length_m, s)
    return 1 if settled else 0, cost, sweeps
