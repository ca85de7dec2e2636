"""Where the tip would be without a load: forward kinematics of the predicted joints, now and in the past."""

from __future__ import annotations

import math

from numba import njit

from realtime.control import inverse_kinematics
from realtime.control.declare import Joint, Point, ReadFloats
from realtime.control.records import HISTORY_POINTS, N_AXES, History, KinematicsParams

# Joints are kept about this often; the ring then reaches further back than the latest pose.
SPACING_NS = 1_000_000


@njit(cache=True)
def apply(config: KinematicsParams, joint: ReadFloats) -> Point:
    """Return the tip (m) of an unloaded catheter at `joint` (insertion m, roll rad, knob rad); (7.1), (7.2).

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
    return lateral_m * math.sin(joint[1]), -lateral_m * math.cos(joint[1]), straight_m + along_m


@njit(cache=True)
def remember(state: History, time_ns: int, joint: ReadFloats, flank: float) -> None:
    """Store the joints (3,) at `time_ns`, now or in the future, with the side of the gap that pushes; times must rise."""
    if state.count > 0 and time_ns - state.time_ns[state.head] < SPACING_NS - 100_000:
        return
    state.head = (state.head + 1) % HISTORY_POINTS
    state.count = min(state.count + 1, HISTORY_POINTS)
    state.time_ns[state.head] = time_ns
    state.flank[state.head] = flank
    for axis in range(N_AXES):
        state.joint[state.head, axis] = joint[axis]
    state.joint[state.head, 1] -= state.windup_rad


@njit(cache=True)
def joint_at(state: History, time_ns: int) -> tuple[Joint, float]:
    """Return the joints at `time_ns`, interpolated, and the flank, +-1; a flank of 0.0: before the oldest entry."""
    if state.count == 0:
        return (0.0, 0.0, 0.0), 0.0
    k = state.head
    for _ in range(state.count - 1):
        if state.time_ns[k] <= time_ns:
            break
        k = (k - 1) % HISTORY_POINTS
    if state.time_ns[k] > time_ns:
        return (0.0, 0.0, 0.0), 0.0
    after = k if k == state.head else (k + 1) % HISTORY_POINTS
    span = state.time_ns[after] - state.time_ns[k]
    share = (time_ns - state.time_ns[k]) / span if span > 0 else 0.0
    insertion_m = state.joint[k, 0] + share * (state.joint[after, 0] - state.joint[k, 0])
    roll_rad = state.joint[k, 1] + share * (state.joint[after, 1] - state.joint[k, 1])
    knob_rad = state.joint[k, 2] + share * (state.joint[after, 2] - state.joint[k, 2])
    return (insertion_m, roll_rad + state.windup_rad, knob_rad), state.flank[k]
