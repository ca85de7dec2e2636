"""The control tick: (parameters, state, inputs) -> (state, outputs). Pure, no allocation, the same on every clock."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from realtime.control import (
    backlash,
    causes,
    constraint_frame,
    distal_joint,
    force_predictor,
    force_source,
    free_tip,
    hybrid,
    jog,
    phases,
    predictive,
    predictor,
    retraction,
    roll_windup,
    safety,
    stage_limiter,
    target_predictor,
    tip_offset,
    wall_observer,
    wire_friction,
    witnesses,
)
from realtime.control.codes import (
    ACTION_HOLD,
    JOG_TIP,
    LAW_PREDICTIVE,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_DISARMED,
    PHASE_HOLD,
    PHASE_JOG,
    PHASE_POSITION,
    PHASE_RETRACT,
    PHASE_STOPPED,
    SOURCE_ESTIMATE,
    SOURCE_SENSOR,
)
from realtime.control.constraint_frame import dot
from realtime.control.declare import Floats, Joint, Point, ReadFloats
from realtime.control.records import N_AXES, CommandRecord, Inputs, Outputs, Params, State

# Contact begins after this long above the threshold, and is lost after this long below half of it.
_CONTACT_NS = 3_000_000
_LOST_NS = 500_000_000
# Estimates are noisier than a sensor: their threshold is so much higher.
_NOISY_FACTOR = 2.0
# With estimates the force is corrected slowly. The windup is learned so many times more slowly than with a sensor: where
# the wall is tilted, turning the tip back presses it into the wall, and both corrections would swing against each other.
_SLOW_FACTOR = 4.0
# The wall's normal is learned over this time.
_NORMAL_S = 2.0
# How far beyond the given target the approach goes on looking for the wall.
_SEARCH_m = 0.010


@njit(cache=True)
def _depth_m(params: Params, state: State) -> float:
    """Return the depth (m) of the predicted free tip along the inward normal."""
    return -dot(free_tip.apply(params.kinematics, state.predicted_joint), state.normal)


@njit(cache=True)
def _learn_windup(params: Params, state: State, inputs: Inputs, joint: Joint, touching: bool, free: bool) -> Joint:
    """Learn the windup of the roll from an accepted pose. Return the joints with the roll that the pose shows.

    What is learned changes where the free tip is thought to be, not the force: the wall, which is known by its distance
    from the free tip, moves with it.
    """
    memory_s, before_m = params.tip_offset.contact_memory_s, _depth_m(params, state)
    if state.force.source == SOURCE_ESTIMATE:
        memory_s *= _SLOW_FACTOR
    dt_s = min(max((inputs.tip.stamp_ns - state.windup.stamp_ns) * 1e-9, 0.0), 0.1)
    roll_rad = roll_windup.apply(
        params.kinematics, state.windup, joint[1], inputs.tip, state.tip_offset.touch_offset_m, touching, free, memory_s
    )
    state.predicted_joint[1] += state.windup.windup_rad - state.history.windup_rad
    state.history.windup_rad = state.windup.windup_rad
    if touching and state.wall.force.started != 0:
        further_m = _depth_m(params, state) - before_m
        target_predictor.shift(state.wall.force, further_m)
        state.wall.mean_depth_m += further_m
        state.predictive.touch_depth_m += further_m
    # With a sensor the compliance is learned from the force (`stiffer`); estimates are too coarse for it.
    if touching and state.force.source == SOURCE_ESTIMATE:
        roll_windup.take_force(state.windup, inputs.tip.position_m, state.force.force_N, dt_s, memory_s)
        softer = roll_windup.softer_m_per_N(state.windup, inputs.tip.position_m, state.normal)
        wall_observer.soften(state.wall, params.wall.compliance_m_per_N + softer, state.force.smooth_N)
    return joint[0], roll_rad, joint[2]


@njit(cache=True)
def _take_pose(params: Params, state: State, inputs: Inputs, touching: bool) -> None:
    """Learn the tip's offset, and in contact the wall, from an accepted pose."""
    joint, flank = free_tip.joint_at(state.history, inputs.tip.stamp_ns)
    if flank == 0.0:
        return
    felt = state.force.smooth_N > params.hybrid.contact_force_N
    witnesses.take_pose(params, state.witness, inputs, joint, state.normal, state.phase, felt)
    moving = state.phase == PHASE_POSITION or state.phase == PHASE_APPROACH or state.phase == PHASE_JOG
    free = (moving or state.phase == PHASE_HOLD) and state.force.smooth_N < params.hybrid.contact_force_N
    if params.law == LAW_PREDICTIVE:
        joint = _learn_windup(params, state, inputs, joint, touching, free)
    tip_offset.apply(params.tip_offset, params.kinematics, state.tip_offset, joint, inputs.tip, state.normal, touching, free)
    if touching:
        wall_observer.take_pose(params.wall, state.wall, inputs.tip.stamp_ns, inputs.tip.position_m, state.normal)


@njit(cache=True)
def _take_force(params: Params, state: State, inputs: Inputs) -> None:
    """Choose the force source, and in contact learn the wall's normal, its motion and the backlash from a new reading."""
    touching = state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT
    force = state.force
    state.force_rejected += force_source.apply(
        params, force, inputs, state.predictor.quaternion_wxyz, state.normal, touching
    )
    state.force_seen = force.seen[force.source]
    if params.law != LAW_PREDICTIVE:
        if force.changed != 0:
            force_predictor.forget(state.force_predictor)
        if force.fresh != 0:
            force_predictor.apply(params.force_predictor, state.force_predictor, force)
    witnesses.take_forces(state.witness, force, params.period_s)
    if force.fresh == 0 or state.phase != PHASE_CONTACT or params.law != LAW_PREDICTIVE:
        return
    if force.source == SOURCE_SENSOR and force.value_N > params.hybrid.contact_force_N:
        constraint_frame.follow_force(state.normal, inputs.command.normal, force.force_N, params.period_s / _NORMAL_S)
    result, dt_s = wall_observer.take_force(
        params.wall, params.kinematics, state.wall, state.history, force, state.normal, params.hybrid.contact_force_N
    )
    if result == target_predictor.ACCEPTED:
        wall_observer.correct_backlash(params.backlash, state.backlash, state.wall, dt_s)


@njit(cache=True)
def _watch_contact(params: Params, state: State, now_ns: int, force_N: float, tip_m: ReadFloats) -> None:
    """Turn approach into contact and back, each after its debouncing time."""
    config, hy = params.hybrid, state.hybrid
    approaching = state.phase == PHASE_APPROACH
    threshold_N = config.contact_force_N
    if state.force.source == SOURCE_ESTIMATE:
        threshold_N *= _NOISY_FACTOR
    turned = force_N > threshold_N if approaching else force_N < 0.5 * threshold_N
    if not turned:
        hy.above_ns = 0
        return
    if hy.above_ns == 0:
        hy.above_ns = now_ns
    if now_ns - hy.above_ns >= (_CONTACT_NS if approaching else _LOST_NS):
        phases.enter(params, state, PHASE_CONTACT if approaching else PHASE_APPROACH, tip_m)
        if approaching:
            wall_observer.forget(params.wall, state.wall)
            tip_offset.touch(state.tip_offset)
            predictive.touch(state.predictive, force_N, _depth_m(params, state))


@njit(cache=True)
def _approach_target(command: CommandRecord) -> Point:
    target_m, normal = command.target_m, command.normal
    return (
        target_m[0] - _SEARCH_m * normal[0],
        target_m[1] - _SEARCH_m * normal[1],
        target_m[2] - _SEARCH_m * normal[2],
    )


@njit(cache=True)
def _control_thesis(params: Params, state: State, command: CommandRecord, tip_m: ReadFloats, force_N: float) -> None:
    """Run the thesis' law (Figs. 6.12, 7.1): PI loops around the inverse kinematics, force PI outside."""
    hy, period_s, goal_m = state.hybrid, params.period_s, state.hybrid.goal_m
    step_m = params.hybrid.approach_speed_m_per_s * period_s
    if state.phase == PHASE_POSITION:
        hybrid.move_goal(goal_m, command.target_m, step_m)
    elif state.phase == PHASE_APPROACH:
        hybrid.move_goal(goal_m, _approach_target(command), step_m)
    elif state.phase == PHASE_JOG and command.jog_axis == JOG_TIP:
        hybrid.move_goal(goal_m, state.jog.target_m, command.jog_speed * period_s)
    elif state.phase == PHASE_JOG:
        jog.advance(state.jog, hy.joint, command.jog_axis, command.jog_speed, period_s)
        return
    elif state.phase == PHASE_CONTACT:
        for i in range(3):
            goal_m[i] = command.target_m[i]
    else:
        return
    aim = hybrid.Aim(goal_m, command.normal, command.force_N, state.phase == PHASE_CONTACT)
    error_m = hybrid.tip_error(params.hybrid, hy, tip_m, aim, force_N, period_s)
    hybrid.apply(params.hybrid, params.kinematics, hy, tip_m, error_m, period_s)


@njit(cache=True)
def _control_predictive(params: Params, state: State, inputs: Inputs, force_N: float) -> None:
    """Advance the joint command by the predictive law (`predictive`)."""
    command, law, own, hy = inputs.command, params.predictive, state.predictive, state.hybrid
    offset_m, period_s, depth_m = state.tip_offset.offset_m, params.period_s, params.backlash.threshold_m
    if state.phase == PHASE_POSITION:
        move = predictive.Move(command.target_m, law.move_speed_m_per_s, period_s)
        predictive.go(law, own, hy, params.kinematics, offset_m, move, depth_m)
    elif state.phase == PHASE_APPROACH:
        share = law.slow_approach_share if state.force.source == SOURCE_ESTIMATE else 1.0
        speed = share * params.hybrid.approach_speed_m_per_s
        approach = predictive.Move(_approach_target(command), speed, period_s)
        predictive.go(law, own, hy, params.kinematics, offset_m, approach, depth_m)
    elif state.phase == PHASE_JOG and command.jog_axis == JOG_TIP:
        along = predictive.Move(state.jog.target_m, command.jog_speed, period_s)
        predictive.go(law, own, hy, params.kinematics, offset_m, along, depth_m)
    elif state.phase == PHASE_JOG:
        speed = jog.advance(state.jog, hy.joint, command.jog_axis, command.jog_speed, period_s)
        predictive.follow(own, hy, command.jog_axis, speed, depth_m)
    elif state.phase == PHASE_CONTACT:
        slide = predictive.Move(command.target_m, law.slide_speed_m_per_s, period_s)
        contact = predictive.Contact(
            state.normal,
            offset_m,
            _depth_m(params, state),
            command.force_N,
            force_N < 0.5 * params.hybrid.contact_force_N,
            params.force_source == SOURCE_ESTIMATE,
            inputs.now_ns + params.setpoint_lead_ns,
        )
        predictive.press(law, own, hy, params.kinematics, state.wall, slide, contact)
    else:
        predictive.stay(own, hy, state.predicted_joint)


@njit(cache=True)
def _end_jog(params: Params, state: State, inputs: Inputs, tip_m: ReadFloats) -> None:
    """Hold if a jog is done or touches something. Without a recent force a touch is not detected, as in free space."""
    threshold_N = params.hybrid.contact_force_N
    if state.force.source == SOURCE_ESTIMATE:
        threshold_N *= _NOISY_FACTOR
    fresh = inputs.now_ns - state.force.age_from_ns <= params.safety.force_timeout_ns
    touches = fresh and jog.touches(state.jog, inputs.command, state.force.force_N, threshold_N)
    if touches or jog.is_done(state.jog, state.stage, params.stage, inputs.command.jog_axis, state.hybrid.goal_m):
        phases.enter(params, state, PHASE_HOLD, tip_m)


@njit(cache=True)
def _control(params: Params, state: State, inputs: Inputs, tip_m: ReadFloats, force_N: float) -> None:
    """Advance the joint command by one tick according to the phase."""
    if state.phase == PHASE_RETRACT:
        if retraction.apply(params, state, inputs):
            phases.enter(params, state, PHASE_STOPPED, tip_m)
        return
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        _watch_contact(params, state, inputs.now_ns, force_N, tip_m)
    if state.phase == PHASE_JOG:
        _end_jog(params, state, inputs, tip_m)
    if params.law == LAW_PREDICTIVE:
        _control_predictive(params, state, inputs, force_N)
    else:
        _control_thesis(params, state, inputs.command, tip_m, force_N)


@njit(cache=True)
def _move_stages(params: Params, state: State, plan_reversals: bool) -> None:
    """Move the stages: joint command -> handle (inverses of backlash, slope and wire friction) -> limited motion."""
    period_s, hy, gap, own = params.period_s, state.hybrid, params.backlash, state.predictive
    if state.phase == PHASE_STOPPED or state.phase == PHASE_DISARMED:
        for axis in range(N_AXES):
            stage_limiter.brake(params.stage, state.stage, axis, period_s)
        return
    body_m = hy.joint[0] - state.home_m
    roll_rad = backlash.roll(gap, hy.joint[1] - state.windup.windup_rad)
    knob_rad = wire_friction.apply(params.wire, params.kinematics, state.wire, hy.joint[2])
    if plan_reversals:
        crossing_m, after_m = own.joint_at_crossing[0] - state.home_m, own.joint_after_crossing[0] - state.home_m
        handle_m = backlash.apply_ahead(gap, state.backlash, body_m, crossing_m, after_m, own.reversal_depth_m)
        stage_limiter.follow(params.stage, state.stage, 0, handle_m, own.speed[0] / gap.slope, period_s)
        stage_limiter.follow(params.stage, state.stage, 1, roll_rad, backlash.roll(gap, own.speed[1]), period_s)
        stage_limiter.follow(params.stage, state.stage, 2, knob_rad, own.speed[2], period_s)
        return
    stage_limiter.apply(params.stage, state.stage, 0, backlash.apply(gap, state.backlash, body_m), period_s)
    stage_limiter.apply(params.stage, state.stage, 1, roll_rad, period_s)
    stage_limiter.apply(params.stage, state.stage, 2, knob_rad, period_s)


@njit(cache=True)
def _set_setpoint(params: Params, state: State, inputs: Inputs, outputs: Outputs) -> None:
    """Fill the set-point for the board."""
    armed = state.phase != PHASE_DISARMED and inputs.board.ready != 0
    outputs.valid = 1 if armed else 0
    if armed:
        state.setpoint_number = (state.setpoint_number + 1) & 0xFFFF
    outputs.number = state.setpoint_number
    execute_ns = inputs.now_ns + params.setpoint_lead_ns - inputs.board.mcu_offset_ns
    outputs.execute_us = (execute_ns // 1000) & 0xFFFFFFFF
    outputs.expiry_us = params.setpoint_expiry_us
    for axis in range(N_AXES):
        outputs.stage_unit[axis] = state.stage.position[axis]
        outputs.position_steps[axis] = round(state.stage.position[axis] * params.stage.steps_per_unit[axis])


@njit(cache=True)
def _report(params: Params, state: State, inputs: Inputs, outputs: Outputs, force_N: float, flags: int) -> None:
    """Fill the outputs that only telemetry uses."""
    outputs.now_ns = inputs.now_ns
    for axis in range(N_AXES):
        outputs.joint[axis] = state.predicted_joint[axis]
    # For the estimator, which reads the force from the shape; the law has its own offset.
    outputs.joint[0] -= state.tip_offset.insertion_error_m
    for i in range(3):
        outputs.tip_velocity_m_per_s[i] = state.predictor.velocity_m_per_s[i]
        outputs.goal_m[i] = state.hybrid.goal_m[i]
        outputs.force_N[i] = state.force.force_N[i]
    outputs.normal_force_N = force_N
    outputs.force_source, outputs.play_m = state.force.source, state.backlash.width_m
    outputs.wanted_force_N = inputs.command.force_N
    witness = state.witness
    outputs.witness_N[0], outputs.witness_N[1], outputs.witness_N[2] = (
        witness.sensor_N,
        witness.estimate_N,
        witness.geometry_N,
    )
    outputs.phase, outputs.action, outputs.cause = state.phase, state.action, flags | state.latched
    outputs.poses_rejected, outputs.forces_rejected = state.predictor.rejected, state.force_rejected
    outputs.pose_age_ns = inputs.now_ns - state.predictor.accepted_ns
    wall = state.wall.force
    if wall.started == 0:
        outputs.wall_m = outputs.wall_sd_m = outputs.heart_Hz = outputs.breath_Hz = outputs.stiffness_N_per_m = 0.0
        return
    outputs.wall_m = target_predictor.at(wall, inputs.now_ns + params.setpoint_lead_ns)
    outputs.wall_sd_m = math.sqrt(max(target_predictor.variance_ahead(wall) - wall.noise_m2, 0.0))
    outputs.heart_Hz, outputs.breath_Hz = target_predictor.rates_Hz(wall)
    outputs.stiffness_N_per_m = (1.0 + target_predictor.stiffer(wall)) / state.wall.compliance_m_per_N


@njit(cache=True)
def _predict_tip(params: Params, state: State, now_ns: int, touching: bool, tip_m: Floats) -> None:
    """Replace the predictor's tip (3,) by the model's with its learned offset, in contact on the wall."""
    joint, flank = free_tip.joint_at(state.history, now_ns)
    if flank == 0.0:
        return
    tip = tip_offset.tip(params.kinematics, state.tip_offset, joint)
    if touching and state.wall.pose.started != 0:
        tip = wall_observer.on_wall(state.wall, tip, state.normal, now_ns)
    for i in range(3):
        tip_m[i] = tip[i]


@njit(cache=True)
def _compression_N(params: Params, state: State, now_ns: int, touching: bool) -> float:
    """Return the compression (N) now.

    Thesis' law: predicted by its own filter. Predictive law: the sensor's reading, or the estimate, in contact brought up
    to date by the wall's predicted motion.
    """
    if params.law != LAW_PREDICTIVE:
        return force_predictor.predict(state.force_predictor, now_ns)
    if state.force.source != SOURCE_ESTIMATE:
        return state.force.value_N
    if touching and state.wall.force.started != 0:
        joint, flank = free_tip.joint_at(state.history, now_ns)
        if flank != 0.0:
            depth_m = -dot(free_tip.apply(params.kinematics, joint), state.normal)
            return wall_observer.force_at(state.wall, depth_m, now_ns)
    return state.force.smooth_N


@njit(cache=True)
def tick(params: Any, state: Any, inputs: Any, outputs: Any) -> None:
    """Run one period of the loop.

    Args:
        params: PARAMS record array of length 1 (`realtime.control.records`).
        state: STATE, changed in place.
        inputs: INPUTS. What is not finite is rejected where it enters: outputs are finite for any inputs.
        outputs: OUTPUTS, filled.
    """
    p: Params = params[0]
    s: State = state[0]
    u: Inputs = inputs[0]
    y: Outputs = outputs[0]
    is_predictive = p.law == LAW_PREDICTIVE
    touching = s.phase == PHASE_CONTACT
    # 1. What arrived: the commanded normal, the pose, the force.
    if not touching or u.command.count != s.command_seen:
        constraint_frame.take(s.normal, u.command.normal)
    pose_result = predictor.apply(p.predictor, s.predictor, u.tip)
    if pose_result == predictor.ACCEPTED and s.phase != PHASE_DISARMED:
        _take_pose(p, s, u, touching)
    rejected = s.force_rejected
    _take_force(p, s, u)
    # 2. Where the tip is now, and how hard it presses.
    tip_m = y.tip_m
    predictor.predict(s.predictor, u.now_ns, tip_m)
    if is_predictive and s.phase != PHASE_DISARMED and s.tip_offset.learned_s > 0.0:
        _predict_tip(p, s, u.now_ns, touching, tip_m)
    force_N = _compression_N(p, s, u.now_ns, is_predictive and touching)
    if not math.isfinite(force_N):
        force_N = 0.0
    # 3. What is wrong, and what is done about it.
    flags = causes.apply(p, s, u, pose_result, rejected)
    clear = u.command.clear != s.cleared
    s.cleared = u.command.clear
    if u.command.armed == 0:  # disarming ends a stop of the operator; other causes wait to be cleared
        s.latched &= ~safety.OPERATOR_STOP
    action, latched = safety.decide(flags, s.latched, clear)
    s.action, s.latched = action, latched
    # 4. Phase, joint command, stages.
    phases.apply(p, s, u, action, flags | latched, tip_m)
    if s.phase == PHASE_DISARMED and s.predictor.started != 0:
        distal_joint.locate(p, s, u, tip_m)
    if action < ACTION_HOLD or s.phase == PHASE_RETRACT:
        _control(p, s, u, tip_m, force_N)
    elif is_predictive:
        predictive.stay(s.predictive, s.hybrid, s.predicted_joint)
    _move_stages(p, s, is_predictive and s.phase != PHASE_RETRACT)
    distal_joint.predict(p, s)
    free_tip.remember(s.history, u.now_ns + p.setpoint_lead_ns, s.predicted_joint, s.backlash.flank)
    # 5. The set-point, and what telemetry shows.
    s.ticks += 1
    _set_setpoint(p, s, u, y)
    _report(p, s, u, y, force_N, flags)
