"""The predictive law: the unloaded tip is put where position asks and force wants, on the wall's motion foretold.

External hybrid control (thesis Fig. 7.1) written for the point where the tip would be with nothing touching it (the free
tip): across the wall's normal a slow integral on the measured position moves it (I - S); along the normal (S = n n^T)
it follows b = wall + compliance * wanted force. Wall and compliance come from `target_predictor`, which compares the
measured force with what the stages really did: its level is the integral of the force error, and since it sees the
motion that is believed, not the one commanded, it does not wind up while the gap is crossed or a limit holds.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control import backlash, free_tip, inverse_kinematics, target_predictor
from realtime.control.codes import PHASE_APPROACH, PHASE_HOLD, PHASE_POSITION, SOURCE_ESTIMATE
from realtime.control.constraint_frame import dot
from realtime.control.records import N_AXES, PREDICTIVE_PARAMS, PREDICTIVE_STATE

Config, State = PREDICTIVE_PARAMS, PREDICTIVE_STATE

# Speeds of the joints are taken over this time; a reversal is judged over this much more than a crossing.
_SLOPE_S = 0.005
_LATER_S = 0.060
# Nothing moves the free tip further than this from where it is believed to be, or from where it touched.
_REACH_m = 0.012
# Across the normal a loaded catheter may be moved this far from where it touched; more would not bring the tip back.
_AUTHORITY_m = 0.004
# Out of touch for this long in contact, the wall is looked for.
_AWAY_S = 0.050
# Least share of the wanted force to press with while the wall's motion is not known yet: enough to keep the touch.
_GENTLE_SHARE = 0.65
# By estimates alone the motion is known later, and a touch that is lost is found late.
_GENTLE_BLIND_SHARE = 0.9
_SURE_SIGMA = 2.0
# A reversal must be worth so many standard deviations of the forecasts.
_DEPTH_SIGMA = 1.0
# Stiffness is learned from motion about the mean of this long, so that a drift of the wall does not pass for it.
_MEAN_S = 1.0
_NUDGE_m = 1e-5
# At rest no reversal is worth a crossing of the play.
_NEVER_m = 1.0
# A difference of the play learned in contact is believed over this time.
_PLAY_S = 2.0
# How far the body is short of the insertion believed is learned over this time, in free space.
_SHORT_S = 0.8


@njit(cache=True)
def stay(state) -> None:  # type: ignore[no-untyped-def]
    """Stop where the distal end is believed to be."""
    own = state.predictive
    own.goal_speed, own.depth_m = 0.0, _NEVER_m
    for axis in range(N_AXES):
        state.hybrid.joint[axis] = own.soon[axis] = own.later[axis] = state.believed[axis]
        own.speed[axis] = 0.0


@njit(cache=True)
def face(state, normal) -> None:  # type: ignore[no-untyped-def]
    """Take `normal` (3,) for the wall's, if it is a unit vector at all."""
    if abs(dot(normal, normal) - 1.0) < 1e-3:
        for i in range(3):
            state.predictive.normal[i] = normal[i]


@njit(cache=True)
def start(state) -> None:  # type: ignore[no-untyped-def]
    """As at arming: nothing learned, standing still."""
    own = state.predictive
    state.history.count = 0
    own.offset_s = own.short_s = own.short_m = 0.0
    for i in range(3):
        own.offset_m[i] = 0.0
    state.wall.started = state.tip_wall.started = 0
    stay(state)


@njit(cache=True)
def _learn_short(params, state, position_m, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """How far the body is short of the insertion believed, from a free tip at `position_m` (3,) and the joints then.

    At arming nobody knows where in its play the body stands. The offset above makes up for it, but a force told from
    the shape needs the insertion itself: 1 mm of it passes for 0.1 N at most, and while nothing is touched it shows.
    """
    own, tip_m, more_m = state.predictive, state.work[0], state.work[1]
    believed_m = own.joint[0]
    own.joint[0] = believed_m - own.short_m
    free_tip.apply(params.kinematics, own.joint, tip_m)
    own.joint[0] += _NUDGE_m
    free_tip.apply(params.kinematics, own.joint, more_m)
    own.joint[0] = believed_m
    further_m = square = 0.0
    for i in range(3):
        slope = (more_m[i] - tip_m[i]) / _NUDGE_m
        further_m += slope * (position_m[i] - tip_m[i])
        square += slope * slope
    own.short_s = min(own.short_s + dt_s, _SHORT_S)
    own.short_m -= dt_s / max(own.short_s, dt_s + 1e-9) * further_m / max(square, 0.1)


@njit(cache=True)
def observe(params, state, pose, touching: bool) -> None:  # type: ignore[no-untyped-def]
    """Learn from an accepted `pose`, at the time it was taken: how far the tip is off the model's free tip.

    In free space the whole offset; in contact only across the normal (there the load bends the tip aside), while the
    normal part of the pose feeds the wall's predictor.
    """
    law, own = params.predictive, state.predictive
    if free_tip.joint_at(state.history, pose.stamp_ns, own.joint) == 0.0:
        return
    free_tip.apply(params.kinematics, own.joint, own.point_m)
    dt_s = min(max((pose.stamp_ns - own.offset_ns) * 1e-9, 0.0), 0.1)
    own.offset_ns = pose.stamp_ns
    free = state.phase == PHASE_HOLD or state.phase == PHASE_POSITION or state.phase == PHASE_APPROACH
    if free and state.force.smooth_N < params.hybrid.contact_force_N:
        _learn_short(params, state, pose.position_m, dt_s)
    memory_s = law.contact_memory_s if touching else law.offset_memory_s
    own.offset_s = min(own.offset_s + dt_s, memory_s)
    share = dt_s / max(own.offset_s, dt_s + 1e-9)
    along_m = 0.0
    for i in range(3):
        own.point_m[i] = pose.position_m[i] - own.point_m[i] - own.offset_m[i]
        along_m += own.point_m[i] * own.normal[i]
    for i in range(3):
        own.offset_m[i] += share * (own.point_m[i] - (along_m * own.normal[i] if touching else 0.0))
        if touching:
            off_m = own.offset_m[i] - own.touch_offset_m[i]
            own.offset_m[i] = own.touch_offset_m[i] + min(max(off_m, -_AUTHORITY_m), _AUTHORITY_m)
    if touching:
        into_m = -dot(pose.position_m, own.normal)
        target_predictor.apply(params.tip_wall, state.tip_wall, pose.stamp_ns, into_m, 0.0, 0.0, law.position_noise_m**2)


@njit(cache=True)
def tip_now(params, state, now_ns: int, touching: bool, out_m) -> None:  # type: ignore[no-untyped-def]
    """The tip (3,) m at `now_ns` into `out_m`: model and learned offset, in contact with the wall along the normal."""
    own = state.predictive
    if free_tip.joint_at(state.history, now_ns, own.joint) == 0.0:
        return
    free_tip.apply(params.kinematics, own.joint, out_m)
    for i in range(3):
        out_m[i] += own.offset_m[i]
    if touching and state.tip_wall.started != 0:
        short_m = target_predictor.at(state.tip_wall, now_ns) + dot(out_m, own.normal)
        for i in range(3):
            out_m[i] -= short_m * own.normal[i]


@njit(cache=True)
def feel(params, state, estimated: bool, stamp_ns: int, force_N: float, noise_N2: float) -> int:  # type: ignore[no-untyped-def]
    """A force along the normal, as of `stamp_ns`, for the wall's predictor. Returns as `target_predictor.apply`.

    With no force the wall may be anywhere beyond the tip: then only a forecast that has it nearer is corrected. Of an
    estimate's variance no more is believed than forecasts have shown.
    """
    law, own = params.predictive, state.predictive
    flank = free_tip.joint_at(state.history, stamp_ns, own.joint)
    if flank == 0.0:
        return target_predictor.NOTHING_NEW
    free_tip.apply(params.kinematics, own.joint, own.point_m)
    b_m = -dot(own.point_m, own.normal)
    own.joint[0] += _NUDGE_m
    free_tip.apply(params.kinematics, own.joint, own.point_m)
    flank *= (-dot(own.point_m, own.normal) - b_m) / _NUDGE_m
    loose = force_N < 0.5 * params.hybrid.contact_force_N
    if loose and state.wall.started != 0 and target_predictor.at(state.wall, stamp_ns) > b_m:
        return target_predictor.NOTHING_NEW
    noise_m2 = law.compliance_m_per_N**2 * noise_N2 + law.play_noise_m**2
    if state.wall.started == 0:
        own.mean_m, own.felt_ns = b_m, stamp_ns
    value_m, travel_m = b_m - law.compliance_m_per_N * force_N, b_m - own.mean_m
    if estimated and state.wall.started != 0:
        noise_m2 = min(noise_m2, target_predictor.least_score(state.wall))
    config = params.estimate_wall if estimated else params.wall
    result = target_predictor.apply(config, state.wall, stamp_ns, value_m, travel_m, flank, noise_m2)
    if result == target_predictor.ACCEPTED:
        dt_s = min(max((stamp_ns - own.felt_ns) * 1e-9, 0.0), 0.1)
        own.felt_ns = stamp_ns
        own.mean_m += dt_s / _MEAN_S * travel_m
        part_m = dt_s / _PLAY_S * target_predictor.play(state.wall)
        target_predictor.credit_play(state.wall, 0.5 * backlash.narrow(params.backlash, state.backlash, 2.0 * part_m))
    return result


@njit(cache=True)
def force_now(params, state, now_ns: int) -> float:  # type: ignore[no-untyped-def]
    """The compression (N) that wall and believed joints make now: late estimates brought up to date."""
    law, own = params.predictive, state.predictive
    if state.wall.started == 0 or free_tip.joint_at(state.history, now_ns, own.joint) == 0.0:
        return state.force.smooth_N
    free_tip.apply(params.kinematics, own.joint, own.point_m)
    stiffer = target_predictor.stiffer(state.wall)
    depth_m = -dot(own.point_m, own.normal) * (1.0 + stiffer) - stiffer * own.mean_m
    return max((depth_m - target_predictor.at(state.wall, now_ns)) / law.compliance_m_per_N, 0.0)


@njit(cache=True)
def report(params, state, now_ns: int, outputs) -> None:  # type: ignore[no-untyped-def]
    """What has been learned of the wall, for whoever looks on; zeros where nothing is touched."""
    wall = state.wall
    if wall.started == 0:
        outputs.wall_m = outputs.wall_sd_m = outputs.heart_Hz = outputs.breath_Hz = outputs.stiffness_N_per_m = 0.0
        return
    outputs.wall_m = target_predictor.at(wall, now_ns + params.setpoint_lead_ns)
    outputs.wall_sd_m = math.sqrt(max(target_predictor.variance_ahead(wall) - wall.noise_m2, 0.0))
    outputs.heart_Hz, outputs.breath_Hz = target_predictor.rates_Hz(wall)
    outputs.stiffness_N_per_m = (1.0 + target_predictor.stiffer(wall)) / params.predictive.compliance_m_per_N


@njit(cache=True)
def _advance_goal(law, own, goal_m, target_m, top_speed: float, period_s: float) -> None:  # type: ignore[no-untyped-def]
    """Bring `goal_m` (3,) nearer to `target_m` (3,), from rest to rest, under speed and acceleration limits."""
    distance = math.sqrt((target_m[0] - goal_m[0]) ** 2 + (target_m[1] - goal_m[1]) ** 2 + (target_m[2] - goal_m[2]) ** 2)
    accel = law.move_accel_m_per_s2
    own.goal_speed = min(own.goal_speed + accel * period_s, top_speed, math.sqrt(2.0 * accel * distance))
    step_m = own.goal_speed * period_s
    share = 1.0 if distance <= step_m else step_m / distance
    for i in range(3):
        goal_m[i] += share * (target_m[i] - goal_m[i])


@njit(cache=True)
def _joints_ahead(params, state, target_m, ahead_s: float, out) -> None:  # type: ignore[no-untyped-def]
    """Joints (3,) that put the free tip where the moving goal will be `ahead_s` from now."""
    own, goal_m = state.predictive, state.hybrid.goal_m
    distance = math.sqrt((target_m[0] - goal_m[0]) ** 2 + (target_m[1] - goal_m[1]) ** 2 + (target_m[2] - goal_m[2]) ** 2)
    share = min(own.goal_speed * ahead_s / max(distance, 1e-9), 1.0)
    for i in range(3):
        own.point_m[i] = goal_m[i] + share * (target_m[i] - goal_m[i]) - own.offset_m[i]
    inverse_kinematics.apply_nearest(params.kinematics, own.point_m, state.hybrid.joint, out)


@njit(cache=True)
def go(params, state, target_m, top_speed: float) -> None:  # type: ignore[no-untyped-def]
    """Position control in free space: joints for the moving goal less the learned offset, and their speeds."""
    own = state.predictive
    _advance_goal(params.predictive, own, state.hybrid.goal_m, target_m, top_speed, params.period_s)
    _joints_ahead(params, state, target_m, 0.0, state.hybrid.joint)
    _joints_ahead(params, state, target_m, _SLOPE_S, own.soon)
    own.depth_m = params.backlash.threshold_m
    for axis in range(N_AXES):
        own.speed[axis] = (own.soon[axis] - state.hybrid.joint[axis]) / _SLOPE_S
        own.soon[axis] = own.later[axis] = state.hybrid.joint[axis]


@njit(cache=True)
def touch(params, state, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """Contact begins: nothing is known of this wall yet, and the force wanted is the one that is there."""
    own = state.predictive
    state.wall.started = state.tip_wall.started = 0
    own.wanted_N, own.away_s, own.goal_speed = max(force_N, 0.0), 0.0, 0.0
    for i in range(3):
        own.touch_offset_m[i] = own.offset_m[i]
    free_tip.apply(params.kinematics, state.believed, own.point_m)
    own.touch_m = -dot(own.point_m, own.normal)


@njit(cache=True)
def _wanted(params, state, wanted_N: float) -> float:  # type: ignore[no-untyped-def]
    """The force to press with now: less than `wanted_N` while forecasts are poor, reached by a slew."""
    law, own, wall = params.predictive, state.predictive, state.wall
    sure_m2 = max(target_predictor.variance_ahead(wall) - wall.noise_m2, 0.0)
    sure_N = math.sqrt(sure_m2) / law.compliance_m_per_N
    gentle = _GENTLE_BLIND_SHARE if params.force_source == SOURCE_ESTIMATE else _GENTLE_SHARE
    goal_N = min(wanted_N, max(gentle * wanted_N, wanted_N + law.force_margin_N - _SURE_SIGMA * sure_N))
    step_N = law.force_slew_N_per_s * params.period_s
    own.wanted_N += min(max(goal_N - own.wanted_N, -step_N), step_N)
    return own.wanted_N


@njit(cache=True)
def _contact_joints(params, state, along_m: float, out) -> None:  # type: ignore[no-untyped-def]
    """Joints (3,) for the free tip at the goal across the normal, and `along_m` along the inward normal."""
    own, goal_m = state.predictive, state.hybrid.goal_m
    short_m = along_m
    for i in range(3):
        own.point_m[i] = goal_m[i] - own.offset_m[i]
        short_m += own.point_m[i] * own.normal[i]
    for i in range(3):
        own.point_m[i] -= short_m * own.normal[i]
    inverse_kinematics.apply_nearest(params.kinematics, own.point_m, state.hybrid.joint, out)


@njit(cache=True)
def press(params, state, now_ns: int, target_m, wanted_N: float, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """Hybrid control in contact: joints for now + lead, their speeds, and where they will be wanted a crossing later."""
    law, own, wall = params.predictive, state.predictive, state.wall
    if wall.started == 0:
        return
    _advance_goal(law, own, state.hybrid.goal_m, target_m, law.slide_speed_m_per_s, params.period_s)
    loose = force_N < 0.5 * params.hybrid.contact_force_N
    own.away_s = own.away_s + params.period_s if loose else 0.0
    if own.away_s > _AWAY_S:
        target_predictor.shift(wall, law.slide_speed_m_per_s * params.period_s)
    spring_m = law.compliance_m_per_N * _wanted(params, state, wanted_N)
    stiffer = target_predictor.stiffer(wall)
    lead_ns = now_ns + params.setpoint_lead_ns
    free_tip.apply(params.kinematics, state.believed, own.point_m)
    believed_m = -dot(own.point_m, own.normal)
    least_m = max(believed_m, own.touch_m) - _REACH_m
    most_m = min(believed_m, own.touch_m) + _REACH_m
    press_m = spring_m + stiffer * own.mean_m
    own.along_m = min(max((target_predictor.at(wall, lead_ns) + press_m) / (1.0 + stiffer), least_m), most_m)
    sure_m2 = max(target_predictor.variance_ahead(wall) - wall.noise_m2, 0.0)
    own.depth_m = max(law.reversal_depth_m, _DEPTH_SIGMA * math.sqrt(sure_m2))
    _contact_joints(params, state, own.along_m, state.hybrid.joint)
    soon_s = law.reversal_share * law.crossing_s
    for k in range(3):
        ahead_s = _SLOPE_S if k == 0 else (soon_s if k == 1 else soon_s + _LATER_S)
        out = own.speed if k == 0 else (own.soon if k == 1 else own.later)
        wall_m = target_predictor.at(wall, lead_ns + round(ahead_s * 1e9))
        _contact_joints(params, state, min(max((wall_m + press_m) / (1.0 + stiffer), least_m), most_m), out)
    for axis in range(N_AXES):
        own.speed[axis] = (own.speed[axis] - state.hybrid.joint[axis]) / _SLOPE_S
