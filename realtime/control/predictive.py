"""The predictive law: set-points that press the free tip into the predicted wall with the requested force.

External hybrid control (thesis Fig. 7.1), written for the point where the tip would be without contact (the free tip).
Across the wall's normal (I - S, S = n n^T) a slow integral on the measured position moves it (`tip_offset`). Along the
normal it follows b = wall + compliance * requested force. Wall and compliance come from `wall_observer`, which compares the
measured force with the executed motion of the stages: its level is the integral of the force error, and because it uses the
predicted motion, not the commanded one, it does not wind up while the gap is crossed or a limit is active.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from realtime.control import inverse_kinematics, target_predictor
from realtime.control.declare import Floats, Joint, ReadFloats
from realtime.control.records import (
    N_AXES,
    HybridState,
    KinematicsParams,
    PredictiveParams,
    PredictiveState,
    TargetState,
    WallState,
)

# Speeds of the joints are differences over this time. A reversal is planned over a crossing and this time after it.
_SLOPE_S = 0.005
_AFTER_CROSSING_S = 0.060
# The free tip is never moved further than this from where it is predicted to be, or from where it touched.
_REACH_m = 0.012
# After this long without force in contact, the wall is searched for.
_AWAY_S = 0.050
# Least share of the requested force while the wall's motion is unknown: enough to keep contact. Without a force sensor
# the motion is learned more slowly, and a loss of contact is detected late.
_LEAST_SHARE, _LEAST_SHARE_BLIND = 0.65, 0.9
_SURE_SIGMA = 2.0
# A reversal is planned if the motion back exceeds this many standard deviations of the predictions.
_DEPTH_SIGMA = 1.0
# At rest no reversal is planned: this depth is never reached.
_NEVER_m = 1.0


class Move(NamedTuple):
    """Target (3,) m of the moving goal, greatest speed (m/s), and period (s)."""

    target_m: ReadFloats
    speed_m_per_s: float
    period_s: float


class Contact(NamedTuple):
    """The contact in this tick.

    normal: (3,), outward; offset_m: (3,), of the tip; depth_m: of the predicted free tip along the inward normal;
    wanted_N: requested force; loose: the force is below the threshold; blind: there is no force sensor; execute_ns: when
    the set-point is reached.
    """

    normal: ReadFloats
    offset_m: ReadFloats
    depth_m: float
    wanted_N: float
    loose: bool
    blind: bool
    execute_ns: int


@njit(cache=True)
def stay(state: PredictiveState, hybrid: HybridState, predicted_joint: ReadFloats) -> None:
    """Stop where the distal end is predicted to be (3,)."""
    state.goal_speed_m_per_s, state.reversal_depth_m = 0.0, _NEVER_m
    for axis in range(N_AXES):
        joint = predicted_joint[axis]
        hybrid.joint[axis] = state.joint_at_crossing[axis] = state.joint_after_crossing[axis] = joint
        state.speed[axis] = 0.0


@njit(cache=True)
def _distance_m(a_m: ReadFloats, b_m: ReadFloats) -> float:
    return math.sqrt((a_m[0] - b_m[0]) ** 2 + (a_m[1] - b_m[1]) ** 2 + (a_m[2] - b_m[2]) ** 2)


@njit(cache=True)
def _advance_goal(config: PredictiveParams, state: PredictiveState, goal_m: Floats, move: Move) -> None:
    """Bring `goal_m` (3,) nearer to the target, from rest to rest, under speed and acceleration limits."""
    distance_m = _distance_m(move.target_m, goal_m)
    accel, period_s = config.move_accel_m_per_s2, move.period_s
    fastest = math.sqrt(2.0 * accel * distance_m)
    state.goal_speed_m_per_s = min(state.goal_speed_m_per_s + accel * period_s, move.speed_m_per_s, fastest)
    step_m = state.goal_speed_m_per_s * period_s
    share = 1.0 if distance_m <= step_m else step_m / distance_m
    for i in range(3):
        goal_m[i] += share * (move.target_m[i] - goal_m[i])


@njit(cache=True)
def _joint_ahead(
    state: PredictiveState,
    hybrid: HybridState,
    kinematics: KinematicsParams,
    offset_m: ReadFloats,
    target_m: ReadFloats,
    ahead_s: float,
) -> Joint:
    """Return the joints that put the free tip where the moving goal will be `ahead_s` (s) from now."""
    goal_m = hybrid.goal_m
    share = min(state.goal_speed_m_per_s * ahead_s / max(_distance_m(target_m, goal_m), 1e-9), 1.0)
    point_m = (
        goal_m[0] + share * (target_m[0] - goal_m[0]) - offset_m[0],
        goal_m[1] + share * (target_m[1] - goal_m[1]) - offset_m[1],
        goal_m[2] + share * (target_m[2] - goal_m[2]) - offset_m[2],
    )
    return inverse_kinematics.apply_nearest(kinematics, point_m, hybrid.joint)


@njit(cache=True)
def go(
    config: PredictiveParams,
    state: PredictiveState,
    hybrid: HybridState,
    kinematics: KinematicsParams,
    offset_m: ReadFloats,
    move: Move,
    reversal_depth_m: float,
) -> None:
    """Control the position in free space: joints for the moving goal less the learned offset (3,), and their speeds."""
    _advance_goal(config, state, hybrid.goal_m, move)
    now = _joint_ahead(state, hybrid, kinematics, offset_m, move.target_m, 0.0)
    for axis in range(N_AXES):
        hybrid.joint[axis] = now[axis]
    ahead = _joint_ahead(state, hybrid, kinematics, offset_m, move.target_m, _SLOPE_S)
    state.reversal_depth_m = reversal_depth_m
    for axis in range(N_AXES):
        state.speed[axis] = (ahead[axis] - hybrid.joint[axis]) / _SLOPE_S
        state.joint_at_crossing[axis] = state.joint_after_crossing[axis] = hybrid.joint[axis]


@njit(cache=True)
def follow(state: PredictiveState, hybrid: HybridState, axis: int, speed: float, reversal_depth_m: float) -> None:
    """Follow a joint command of which only `axis` moves, at `speed` (m/s or rad/s)."""
    state.goal_speed_m_per_s, state.reversal_depth_m = 0.0, reversal_depth_m
    for i in range(N_AXES):
        state.speed[i] = speed if i == axis else 0.0
        state.joint_at_crossing[i] = state.joint_after_crossing[i] = hybrid.joint[i]


@njit(cache=True)
def touch(state: PredictiveState, force_N: float, depth_m: float) -> None:
    """Begin contact: the force set-point starts from the present force (N), with the free tip at `depth_m` (m)."""
    state.force_setpoint_N, state.away_s, state.goal_speed_m_per_s = max(force_N, 0.0), 0.0, 0.0
    state.short_s = 0.0
    state.touch_depth_m = depth_m


@njit(cache=True)
def _prediction_sd_m(wall: TargetState) -> float:
    """Return the standard deviation (m) of the wall's prediction, without the noise of the samples."""
    return math.sqrt(max(target_predictor.variance_ahead(wall) - wall.noise_m2, 0.0))


@njit(cache=True)
def _force_setpoint(
    config: PredictiveParams, state: PredictiveState, contact: Contact, prediction_sd_N: float, period_s: float
) -> float:
    """Return the force set-point (N): below the requested force while predictions are poor, limited in rate."""
    least = _LEAST_SHARE_BLIND if contact.blind else _LEAST_SHARE
    wanted_N = contact.wanted_N
    sure_N = wanted_N + config.force_margin_N - _SURE_SIGMA * prediction_sd_N
    goal_N = min(wanted_N, max(least * wanted_N, sure_N))
    step_N = config.force_slew_N_per_s * period_s
    state.force_setpoint_N += min(max(goal_N - state.force_setpoint_N, -step_N), step_N)
    return state.force_setpoint_N


@njit(cache=True)
def _contact_joint(hybrid: HybridState, kinematics: KinematicsParams, contact: Contact, depth_m: float) -> Joint:
    """Return the joints for the free tip at the goal across the normal, and at `depth_m` along the inward normal."""
    goal_m, offset_m, normal = hybrid.goal_m, contact.offset_m, contact.normal
    point_m = (goal_m[0] - offset_m[0], goal_m[1] - offset_m[1], goal_m[2] - offset_m[2])
    short_m = depth_m
    for i in range(3):
        short_m += point_m[i] * normal[i]
    deep_m = (
        point_m[0] - short_m * normal[0],
        point_m[1] - short_m * normal[1],
        point_m[2] - short_m * normal[2],
    )
    return inverse_kinematics.apply_nearest(kinematics, deep_m, hybrid.joint)


@njit(cache=True)
def press(
    config: PredictiveParams,
    state: PredictiveState,
    hybrid: HybridState,
    kinematics: KinematicsParams,
    wall_state: WallState,
    move: Move,
    contact: Contact,
) -> None:
    """Control the force in contact: joints for now + lead, their speeds, and the joints a crossing of the gap later.

    Args:
        config: parameters of the law.
        state: the law's state.
        hybrid: joint command and goal.
        kinematics: the unloaded catheter.
        wall_state: the wall's motion and the compliance; a lost wall is searched for by moving it.
        move: where the goal moves across the normal.
        contact: the contact in this tick.
    """
    wall = wall_state.force
    if wall.started == 0:
        return
    _advance_goal(config, state, hybrid.goal_m, move)
    state.away_s = state.away_s + move.period_s if contact.loose else 0.0
    if state.away_s > _AWAY_S:
        target_predictor.shift(wall, config.slide_speed_m_per_s * move.period_s)
    compliance, sd_m = wall_state.compliance_m_per_N, _prediction_sd_m(wall)
    spring_m = compliance * _force_setpoint(config, state, contact, sd_m / compliance, move.period_s)
    stiffer = target_predictor.stiffer(wall)
    least_m = max(contact.depth_m, state.touch_depth_m) - _REACH_m
    most_m = min(contact.depth_m, state.touch_depth_m) + _REACH_m
    press_m = spring_m + stiffer * wall_state.mean_depth_m
    depth_m = min(max((target_predictor.at(wall, contact.execute_ns) + press_m) / (1.0 + stiffer), least_m), most_m)
    state.short_s = max(state.short_s + (move.period_s if depth_m == most_m else -move.period_s), 0.0)
    state.reversal_depth_m = max(config.reversal_depth_m, _DEPTH_SIGMA * sd_m)
    joint = _contact_joint(hybrid, kinematics, contact, depth_m)
    for axis in range(N_AXES):
        hybrid.joint[axis] = joint[axis]
    crossing_s = config.reversal_share * config.crossing_s
    for k in range(3):
        ahead_s = _SLOPE_S if k == 0 else (crossing_s if k == 1 else crossing_s + _AFTER_CROSSING_S)
        out = state.speed if k == 0 else (state.joint_at_crossing if k == 1 else state.joint_after_crossing)
        wall_m = target_predictor.at(wall, contact.execute_ns + round(ahead_s * 1e9))
        depth_m = min(max((wall_m + press_m) / (1.0 + stiffer), least_m), most_m)
        joint = _contact_joint(hybrid, kinematics, contact, depth_m)
        for axis in range(N_AXES):
            out[axis] = joint[axis]
    for axis in range(N_AXES):
        state.speed[axis] = (state.speed[axis] - hybrid.joint[axis]) / _SLOPE_S
