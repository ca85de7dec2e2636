"""Offset of the tip from the model's free tip, and error of the insertion, both learned from poses."""

from __future__ import annotations

from numba import njit

from realtime.control import free_tip
from realtime.control.declare import Point, ReadFloats
from realtime.control.records import KinematicsParams, PoseRecord, TipOffsetParams, TipOffsetState

# Across the normal a loaded catheter may be moved this far from where it touched; more would not bring the tip back.
_AUTHORITY_m = 0.004
# The error of the insertion is learned over this time, in free space.
_INSERTION_S = 0.8
# Step of the numerical derivative by the insertion.
NUDGE_m = 1e-5


@njit(cache=True)
def start(state: TipOffsetState) -> None:
    """Reset the learned values; for arming."""
    state.learned_s = state.insertion_learned_s = state.insertion_error_m = 0.0
    for i in range(3):
        state.offset_m[i] = 0.0


@njit(cache=True)
def touch(state: TipOffsetState) -> None:
    """Keep the present offset as the one with which contact began."""
    for i in range(3):
        state.touch_offset_m[i] = state.offset_m[i]


@njit(cache=True)
def _learn_insertion(
    kinematics: KinematicsParams, state: TipOffsetState, joint: ReadFloats, position_m: ReadFloats, dt_s: float
) -> None:
    """Learn the error of the insertion from a free tip at `position_m` (3,) and the predicted joints then.

    At arming the position of the body within the backlash is unknown. In position control the offset compensates for it,
    but a force that is estimated from the shape needs the insertion itself: 1 mm of error is up to 0.1 N. The error is
    observable only in free space.
    """
    insertion_m = joint[0] - state.insertion_error_m
    tip_m = free_tip.apply(kinematics, (insertion_m, joint[1], joint[2]))
    more_m = free_tip.apply(kinematics, (insertion_m + NUDGE_m, joint[1], joint[2]))
    further_m = square = 0.0
    for i in range(3):
        slope = (more_m[i] - tip_m[i]) / NUDGE_m
        further_m += slope * (position_m[i] - tip_m[i])
        square += slope * slope
    state.insertion_learned_s = min(state.insertion_learned_s + dt_s, _INSERTION_S)
    share = dt_s / max(state.insertion_learned_s, dt_s + 1e-9)
    state.insertion_error_m -= share * further_m / max(square, 0.1)


@njit(cache=True)
def apply(
    config: TipOffsetParams,
    kinematics: KinematicsParams,
    state: TipOffsetState,
    joint: ReadFloats,
    pose: PoseRecord,
    normal: ReadFloats,
    touching: bool,
    free: bool,
) -> None:
    """Learn from an accepted pose and the predicted joints when it was taken.

    Args:
        config: time constants.
        kinematics: the unloaded catheter.
        state: what is learned.
        joint: (3,), predicted joints at the pose's stamp.
        pose: the pose.
        normal: (3,), outward normal of the wall. In contact only the offset across it is learned, because along it
            the load bends the tip aside.
        touching: whether the loop is in contact.
        free: whether nothing touches the tip for certain; then the insertion is learned as well.
    """
    point_m = free_tip.apply(kinematics, joint)
    dt_s = min(max((pose.stamp_ns - state.stamp_ns) * 1e-9, 0.0), 0.1)
    state.stamp_ns = pose.stamp_ns
    if free:
        _learn_insertion(kinematics, state, joint, pose.position_m, dt_s)
    memory_s = config.contact_memory_s if touching else config.free_memory_s
    state.learned_s = min(state.learned_s + dt_s, memory_s)
    share = dt_s / max(state.learned_s, dt_s + 1e-9)
    error_m = (
        pose.position_m[0] - point_m[0] - state.offset_m[0],
        pose.position_m[1] - point_m[1] - state.offset_m[1],
        pose.position_m[2] - point_m[2] - state.offset_m[2],
    )
    along_m = 0.0
    for i in range(3):
        along_m += error_m[i] * normal[i]
    for i in range(3):
        state.offset_m[i] += share * (error_m[i] - (along_m * normal[i] if touching else 0.0))
        if touching:
            moved_m = state.offset_m[i] - state.touch_offset_m[i]
            state.offset_m[i] = state.touch_offset_m[i] + min(max(moved_m, -_AUTHORITY_m), _AUTHORITY_m)


@njit(cache=True)
def tip(kinematics: KinematicsParams, state: TipOffsetState, joint: ReadFloats) -> Point:
    """Return the tip (m) at predicted joints (3,): the model's free tip and the learned offset."""
    point_m = free_tip.apply(kinematics, joint)
    return point_m[0] + state.offset_m[0], point_m[1] + state.offset_m[1], point_m[2] + state.offset_m[2]
