"""Windup of the roll in contact: a force across the bend turns the tip about the sheath's axis, learned from poses.

The shaft between handle and sheath is long and soft in torsion: on the simulated rig 0.1 N across a tip 11 mm from the axis
turns it by 0.9 rad. A displacement of the free tip then moves the tip in a direction that is turned by as much, so that the
windup cannot be corrected as an offset of the position (`tip_offset`): the correction would go the wrong way. Here it is an
error of the joint. The predicted roll is that of the handle plus the windup, and the handle is commanded by so much
further. What the force bends the catheter aside counts as windup too.

The windup follows the force at once, what is learned of it does not. Between the two the contact is softer along the normal
than without windup: by rad per N m, times the square of the normal's lever about the axis.
"""

from __future__ import annotations

from numba import njit

from realtime.control import inverse_kinematics
from realtime.control.declare import ReadFloats
from realtime.control.records import KinematicsParams, PoseRecord, RollWindupState

# The handle is turned at most this much further (rad): a force of 0.2 N straight across a tip at 11 mm needs 1.8 rad.
_AUTHORITY_rad = 2.0
# Unlearned over this time when nothing touches.
_FREE_S = 0.5
# Below this mean torque the ratio of windup and torque is noise. No shaft is softer than the second.
_LEAST_Nm, _SOFTEST_rad_per_Nm = 5e-5, 2000.0


@njit(cache=True)
def forget(state: RollWindupState) -> None:
    """Reset the windup; for arming, and while the rig is not armed."""
    state.windup_rad = state.torque_Nm = 0.0


@njit(cache=True)
def take_force(state: RollWindupState, tip_m: ReadFloats, force_N: ReadFloats, dt_s: float, memory_s: float) -> None:
    """Average the torque on the tip (3,) about the axis over the same time as the windup. force_N (3,): on the tissue."""
    torque_Nm = tip_m[1] * force_N[0] - tip_m[0] * force_N[1]
    state.torque_Nm += dt_s / (dt_s + memory_s) * (torque_Nm - state.torque_Nm)


@njit(cache=True)
def softer_m_per_N(state: RollWindupState, tip_m: ReadFloats, normal: ReadFloats) -> float:
    """Return what the windup adds to the compliance (m/N) along `normal` (3,) at the tip (3,)."""
    if abs(state.torque_Nm) < _LEAST_Nm:
        return 0.0
    softness = min(max(state.windup_rad / state.torque_Nm, 0.0), _SOFTEST_rad_per_Nm)
    lever_m = tip_m[0] * normal[1] - tip_m[1] * normal[0]
    return softness * lever_m * lever_m


@njit(cache=True)
def apply(
    kinematics: KinematicsParams,
    state: RollWindupState,
    roll_rad: float,
    pose: PoseRecord,
    offset_m: ReadFloats,
    touching: bool,
    free: bool,
    memory_s: float,
) -> float:
    """Learn from an accepted pose.

    Args:
        kinematics: the unloaded catheter.
        state: what is learned.
        roll_rad: predicted roll at the pose's stamp, the windup then included.
        pose: the pose.
        offset_m: (3,), offset of the tip before contact.
        touching: whether the loop is in contact.
        free: whether nothing touches the tip for certain: the windup goes back to zero.
        memory_s: time constant in contact.

    Returns:
        The roll (rad) that the pose shows; without contact the predicted one.
    """
    dt_s = min(max((pose.stamp_ns - state.stamp_ns) * 1e-9, 0.0), 0.1)
    state.stamp_ns = pose.stamp_ns
    if not touching:
        if free:
            state.windup_rad -= dt_s / (dt_s + _FREE_S) * state.windup_rad
            state.torque_Nm -= dt_s / (dt_s + _FREE_S) * state.torque_Nm
        return roll_rad
    tip_m = pose.position_m
    unloaded_m = (tip_m[0] - offset_m[0], tip_m[1] - offset_m[1], tip_m[2] - offset_m[2])
    shown_rad = inverse_kinematics.roll_of(kinematics, unloaded_m, roll_rad)
    windup_rad = state.windup_rad + dt_s / (dt_s + memory_s) * (shown_rad - roll_rad)
    state.windup_rad = min(max(windup_rad, -_AUTHORITY_rad), _AUTHORITY_rad)
    return shown_rad
