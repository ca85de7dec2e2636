"""Where the tip would be with nothing touching it: forward kinematics of the believed joints, now and in the past."""

from __future__ import annotations

import math

from numba import njit

from realtime.control import inverse_kinematics
from realtime.control.records import HISTORY, HISTORY_POINTS, N_AXES

State = HISTORY

# Joints are kept about this often; the ring then reaches further back than the latest pose.
SPACING_NS = 1_000_000


@njit(cache=True)
def apply(config, joint, out_m) -> None:  # type: ignore[no-untyped-def]
    """Tip (3,) m of an unloaded catheter at `joint` (insertion m, roll rad, knob rad), into `out_m`; (7.1), (7.2).

    The exposed part of the distal shaft is an arc, the body behind it straight; undoes `inverse_kinematics.apply`.
    """
    curvature = inverse_kinematics.curvature_of_knob(config, joint[2])
    straight_m = max(joint[0], 0.0)
    arc_m = max(config.distal_length_m + min(joint[0], 0.0), 0.0)
    bend = curvature * arc_m
    if abs(bend) < 1e-5:
        lateral_m, along_m = 0.5 * bend * arc_m, arc_m
    else:
        lateral_m, along_m = (1.0 - math.cos(bend)) / curvature, math.sin(bend) / curvature
    out_m[0] = lateral_m * math.sin(joint[1])
    out_m[1] = -lateral_m * math.cos(joint[1])
    out_m[2] = straight_m + along_m


@njit(cache=True)
def remember(state, time_ns: int, joint, flank: float) -> None:  # type: ignore[no-untyped-def]
    """Note that the joints (3,) are, or will be, `joint` at `time_ns`, the play pushed at `flank`; times must rise."""
    if state.count > 0 and time_ns - state.time_ns[state.head] < SPACING_NS - 100_000:
        return
    state.head = (state.head + 1) % HISTORY_POINTS
    state.count = min(state.count + 1, HISTORY_POINTS)
    state.time_ns[state.head] = time_ns
    state.flank[state.head] = flank
    for axis in range(N_AXES):
        state.joint[state.head, axis] = joint[axis]


@njit(cache=True)
def joint_at(state, time_ns: int, out) -> float:  # type: ignore[no-untyped-def]
    """The joints (3,) at `time_ns` into `out`, linear between notes; returns the flank, +-1.

    0.0 where that is further back than the ring: `out` is then left alone.
    """
    if state.count == 0:
        return 0.0
    k = state.head
    for _ in range(state.count - 1):
        if state.time_ns[k] <= time_ns:
            break
        k = (k - 1) % HISTORY_POINTS
    if state.time_ns[k] > time_ns:
        return 0.0
    after = k if k == state.head else (k + 1) % HISTORY_POINTS
    span = state.time_ns[after] - state.time_ns[k]
    share = (time_ns - state.time_ns[k]) / span if span > 0 else 0.0
    for axis in range(N_AXES):
        out[axis] = state.joint[k, axis] + share * (state.joint[after, axis] - state.joint[k, axis])
    return state.flank[k]
