"""Position of the wall and stiffness of the contact, estimated from the contact force and from the tip's poses.

The force says how far the free tip is beyond the wall: b = wall + compliance * force, with b the depth of the free tip
along the inward normal. `target_predictor` turns such samples into the wall's motion, for the force and for the poses.
"""

from __future__ import annotations

from numba import njit

from realtime.control import backlash, free_tip, target_predictor
from realtime.control.codes import SOURCE_ESTIMATE
from realtime.control.constraint_frame import dot
from realtime.control.declare import Point, ReadFloats
from realtime.control.records import (
    BacklashParams,
    BacklashState,
    ForceSourceState,
    History,
    KinematicsParams,
    WallParams,
    WallState,
)
from realtime.control.tip_offset import NUDGE_m

# Stiffness is learned from motion about the mean over this time, so that a drift of the wall does not bias it.
_MEAN_S = 1.0
# An error of the backlash that was learned in contact is handed to `backlash` over this time.
_BACKLASH_S = 2.0


@njit(cache=True)
def forget(config: WallParams, state: WallState) -> None:
    """Reset the estimate of the wall: contact begins, or the loop is armed."""
    state.force.started = state.pose.started = 0
    state.compliance_m_per_N = config.compliance_m_per_N


@njit(cache=True)
def soften(state: WallState, compliance_m_per_N: float, force_N: float) -> None:
    """Use `compliance_m_per_N` from now on. The wall moves with it, because the force (N) does not."""
    if state.force.started != 0:
        target_predictor.shift(state.force, (state.compliance_m_per_N - compliance_m_per_N) * force_N)
    state.compliance_m_per_N = compliance_m_per_N


@njit(cache=True)
def take_pose(config: WallParams, state: WallState, stamp_ns: int, position_m: ReadFloats, normal: ReadFloats) -> None:
    """Process the tip's position (3,) in contact, as of `stamp_ns`; it is then on the wall."""
    depth_m = -dot(position_m, normal)
    target_predictor.apply(config.by_pose, state.pose, stamp_ns, depth_m, 0.0, 0.0, config.position_noise_m**2)


@njit(cache=True)
def take_force(
    config: WallParams,
    kinematics: KinematicsParams,
    state: WallState,
    history: History,
    force: ForceSourceState,
    normal: ReadFloats,
    contact_force_N: float,
) -> tuple[int, float]:
    """Process the newest reading of the force source.

    Without force the wall may be anywhere beyond the tip: then only a prediction of a nearer wall is corrected. The
    variance of an estimate is limited to the recent prediction error.

    Args:
        config: noise, parameters of the predictors.
        kinematics: the unloaded catheter.
        state: what is learned.
        history: predicted joints of the last 0.2 s.
        force: the force source, with a fresh reading.
        normal: (3,), outward normal of the wall.
        contact_force_N: force that counts as contact (N).

    Returns:
        The result of `target_predictor.apply`, and, if accepted, the time (s) since the last accepted reading.
    """
    wall, estimated = state.force, force.source == SOURCE_ESTIMATE
    joint, flank = free_tip.joint_at(history, force.stamp_ns)
    if flank == 0.0:
        return target_predictor.NOTHING_NEW, 0.0
    depth_m = -dot(free_tip.apply(kinematics, joint), normal)
    nudged_m = free_tip.apply(kinematics, (joint[0] + NUDGE_m, joint[1], joint[2]))
    flank *= (-dot(nudged_m, normal) - depth_m) / NUDGE_m
    loose = force.value_N < 0.5 * contact_force_N
    if loose and wall.started != 0 and target_predictor.at(wall, force.stamp_ns) > depth_m:
        return target_predictor.NOTHING_NEW, 0.0
    noise_m2 = state.compliance_m_per_N**2 * force.spread_N2 + config.play_noise_m**2
    if wall.started == 0:
        state.mean_depth_m, state.stamp_ns = depth_m, force.stamp_ns
    value_m, travel_m = depth_m - state.compliance_m_per_N * force.value_N, depth_m - state.mean_depth_m
    if estimated and wall.started != 0:
        noise_m2 = min(noise_m2, target_predictor.least_score(wall))
    predictor = config.by_estimate if estimated else config.by_force
    result = target_predictor.apply(predictor, wall, force.stamp_ns, value_m, travel_m, flank, noise_m2)
    if result != target_predictor.ACCEPTED:
        return result, 0.0
    dt_s = min(max((force.stamp_ns - state.stamp_ns) * 1e-9, 0.0), 0.1)
    state.stamp_ns = force.stamp_ns
    state.mean_depth_m += dt_s / _MEAN_S * travel_m
    return result, dt_s


@njit(cache=True)
def correct_backlash(config: BacklashParams, gap: BacklashState, state: WallState, dt_s: float) -> None:
    """Correct the width of the backlash by a part of the error that was learned, over `dt_s` (s)."""
    part_m = dt_s / _BACKLASH_S * target_predictor.play(state.force)
    target_predictor.subtract_play(state.force, 0.5 * backlash.narrow(config, gap, 2.0 * part_m))


@njit(cache=True)
def force_at(state: WallState, depth_m: float, now_ns: int) -> float:
    """Return the compression (N) that the wall makes at `now_ns` on a free tip `depth_m` (m) along the inward normal."""
    stiffer = target_predictor.stiffer(state.force)
    pressed_m = depth_m * (1.0 + stiffer) - stiffer * state.mean_depth_m
    return max((pressed_m - target_predictor.at(state.force, now_ns)) / state.compliance_m_per_N, 0.0)


@njit(cache=True)
def on_wall(state: WallState, tip_m: ReadFloats, normal: ReadFloats, now_ns: int) -> Point:
    """Return the tip (m) moved along the normal (3,) to where the poses have the wall at `now_ns`."""
    short_m = target_predictor.at(state.pose, now_ns) + dot(tip_m, normal)
    return tip_m[0] - short_m * normal[0], tip_m[1] - short_m * normal[1], tip_m[2] - short_m * normal[2]
