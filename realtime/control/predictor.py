"""Tip predictor: position and velocity now, from poses at 40 Hz that are 25 ms late; a constant-velocity Kalman filter."""

from __future__ import annotations

import math

from numba import njit

from realtime.control.declare import Floats
from realtime.control.records import PoseRecord, PredictorParams, PredictorState

ACCEPTED, REJECTED, NOTHING_NEW = 1, -1, 0


@njit(cache=True)
def plausible(config: PredictorParams, state: PredictorState, pose: PoseRecord) -> bool:
    """Return whether a pose may be used: finite, inside the workspace, unit quaternion, not faster than the limit."""
    norm = 0.0
    for i in range(4):
        norm += pose.quaternion_wxyz[i] ** 2
    if not (abs(norm - 1.0) < 1e-2):
        return False
    for i in range(3):
        x = pose.position_m[i]
        if not (config.workspace_min_m[i] <= x <= config.workspace_max_m[i]):
            return False
    if state.started == 0:
        return True
    dt = (pose.stamp_ns - state.stamp_ns) * 1e-9
    if not (dt > 0.0):
        return False
    distance = 0.0
    for i in range(3):
        distance += (pose.position_m[i] - state.position_m[i]) ** 2
    reach = config.max_speed_m_per_s * dt + config.gate_sigma * config.position_noise_m * 1.7
    return math.sqrt(distance) <= reach


@njit(cache=True)
def _restart(config: PredictorParams, state: PredictorState, pose: PoseRecord) -> None:
    state.started = 1
    for i in range(3):
        state.position_m[i] = pose.position_m[i]
        state.velocity_m_per_s[i] = 0.0
    state.p00 = config.position_noise_m**2
    state.p01 = 0.0
    state.p11 = config.max_speed_m_per_s**2


@njit(cache=True)
def apply(config: PredictorParams, state: PredictorState, pose: PoseRecord) -> int:
    """Take in `pose` (record POSE) at the time it was measured. Returns ACCEPTED, REJECTED or NOTHING_NEW.

    One scalar filter per axis, all three with the same covariance (p00, p01, p11 in m2, m2/s, m2/s2): white
    acceleration of `acceleration_noise_m_per_s2` (per square root of Hz), position noise `position_noise_m`.
    """
    if pose.count == state.seen:
        return NOTHING_NEW
    state.seen = pose.count
    if not plausible(config, state, pose):
        state.rejected += 1
        state.rejected_in_row += 1
        return REJECTED
    state.rejected_in_row = 0
    dt = (pose.stamp_ns - state.stamp_ns) * 1e-9
    if state.started == 0 or dt > 0.5:
        _restart(config, state, pose)
    else:
        q = config.acceleration_noise_m_per_s2**2
        p00 = state.p00 + dt * (2.0 * state.p01 + dt * state.p11) + q * dt**3 / 3.0
        p01 = state.p01 + dt * state.p11 + q * dt**2 / 2.0
        p11 = state.p11 + q * dt
        s = p00 + config.position_noise_m**2
        k0, k1 = p00 / s, p01 / s
        for i in range(3):
            predicted = state.position_m[i] + dt * state.velocity_m_per_s[i]
            innovation = pose.position_m[i] - predicted
            state.position_m[i] = predicted + k0 * innovation
            state.velocity_m_per_s[i] += k1 * innovation
        state.p00, state.p01, state.p11 = (1.0 - k0) * p00, (1.0 - k0) * p01, p11 - k1 * p01
    state.stamp_ns = pose.stamp_ns
    state.accepted_ns = pose.arrival_ns
    for i in range(4):
        state.quaternion_wxyz[i] = pose.quaternion_wxyz[i]
    return ACCEPTED


@njit(cache=True)
def predict(state: PredictorState, now_ns: int, out_m: Floats) -> None:
    """Write the tip position (3,) m at `now_ns` into `out_m`; it is extrapolated by 60 ms at most."""
    ahead_s = min(max((now_ns - state.stamp_ns) * 1e-9, 0.0), 0.060)
    for i in range(3):
        out_m[i] = state.position_m[i] + ahead_s * state.velocity_m_per_s[i]
