"""Compression now, from force readings that are late and few: a Kalman filter of level and rate, for the thesis' law.

The thesis feeds its control loop with a force and a pose that are predicted and brought up to the loop's rate by the same
kind of filter. The predictive law does not use this one: it predicts the wall instead (`wall_observer`).
"""

from __future__ import annotations

from numba import njit

from realtime.control.records import ForcePredictorParams, ForcePredictorState, ForceSourceState

# A gap longer than this starts the filter again. No prediction goes further ahead than the second.
_GAP_S, _AHEAD_S = 0.5, 0.060


@njit(cache=True)
def forget(state: ForcePredictorState) -> None:
    """Start again at the next reading: after a gap, or when the reading comes from another source."""
    state.started = 0


@njit(cache=True)
def apply(config: ForcePredictorParams, state: ForcePredictorState, force: ForceSourceState) -> None:
    """Process the reading that `force_source` chose, at its time of measurement, with its own variance.

    White second derivative of the force, `acceleration_noise_N_per_s2` per square root of Hz: the motion that the pose
    filter expects of the tip, over the compliance.
    """
    dt = (force.stamp_ns - state.stamp_ns) * 1e-9
    if state.started == 0 or not (0.0 <= dt <= _GAP_S):
        state.started = 1
        state.force_N, state.rate_N_per_s = force.value_N, 0.0
        state.p00, state.p01, state.p11 = force.spread_N2, 0.0, config.rate_sd_N_per_s**2
        state.stamp_ns = force.stamp_ns
        return
    q = config.acceleration_noise_N_per_s2**2
    p00 = state.p00 + dt * (2.0 * state.p01 + dt * state.p11) + q * dt**3 / 3.0
    p01 = state.p01 + dt * state.p11 + q * dt**2 / 2.0
    p11 = state.p11 + q * dt
    s = p00 + max(force.spread_N2, 1e-12)
    k0, k1 = p00 / s, p01 / s
    predicted = state.force_N + dt * state.rate_N_per_s
    innovation = force.value_N - predicted
    state.force_N = predicted + k0 * innovation
    state.rate_N_per_s += k1 * innovation
    state.p00, state.p01, state.p11 = (1.0 - k0) * p00, (1.0 - k0) * p01, p11 - k1 * p01
    state.stamp_ns = force.stamp_ns


@njit(cache=True)
def predict(state: ForcePredictorState, now_ns: int) -> float:
    """Return the compression (N) at `now_ns`; 0 before the first reading."""
    if state.started == 0:
        return 0.0
    ahead_s = min(max((now_ns - state.stamp_ns) * 1e-9, 0.0), _AHEAD_S)
    return state.force_N + ahead_s * state.rate_N_per_s
