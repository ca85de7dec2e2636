"""The control tick: (parameters, state, inputs) -> (state, outputs). Pure, no allocation, the same on every clock."""

from __future__ import annotations

import math

from numba import njit

from realtime.control import (
    backlash,
    constraint_frame,
    force_source,
    free_tip,
    hybrid,
    inverse_kinematics,
    predictive,
    predictor,
    safety,
    stage_limiter,
    target_predictor,
)
from realtime.control.codes import (
    ACTION_HOLD,
    ACTION_RETRACT,
    ACTION_STOP,
    BOARD_FAULT,
    COMMAND_CONTACT,
    COMMAND_HOLD,
    COMMAND_POSITION,
    COMMAND_RETRACT,
    COMMAND_STOP,
    LAW_PREDICTIVE,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_DISARMED,
    PHASE_HOLD,
    PHASE_POSITION,
    PHASE_RETRACT,
    PHASE_STOPPED,
    SOURCE_ESTIMATE,
    SOURCE_SENSOR,
)
from realtime.control.records import N_AXES

# Contact is believed after this long above the threshold, and lost after this long below half of it.
_CONTACT_NS = 3_000_000
_LOST_NS = 500_000_000
# Estimates are noisier than a sensor: their threshold is so much higher.
_NOISY_FACTOR = 2.0
# The wall's normal is learned over this time.
_NORMAL_S = 2.0
# How far beyond the given target the approach goes on looking for the wall.
_SEARCH_m = 0.010


@njit(cache=True)
def _take_force(params, state, inputs) -> None:  # type: ignore[no-untyped-def]
    touching = state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT
    force = state.force
    state.force_rejected += force_source.apply(
        params, force, inputs, state.predictor.quaternion_wxyz, state.predictive.normal, touching
    )
    state.force_seen = force.seen[force.source]
    if force.fresh == 0 or state.phase != PHASE_CONTACT or params.law != LAW_PREDICTIVE:
        return
    if force.source == SOURCE_SENSOR and force.value_N > params.hybrid.contact_force_N:
        constraint_frame.follow_force(
            state.predictive.normal, inputs.command.normal, force.force_N, params.period_s / _NORMAL_S
        )
    result = predictive.feel(params, state, force.source == SOURCE_ESTIMATE, force.stamp_ns, force.value_N, force.spread_N2)
    if result == target_predictor.REJECTED:
        state.force_rejected += 1


@njit(cache=True)
def _flags(params, state, inputs, pose_result: int, forces_rejected: int) -> int:  # type: ignore[no-untyped-def]
    """The bit set of all that is wrong at this tick."""
    limits, now_ns, armed = params.safety, inputs.now_ns, state.phase != PHASE_DISARMED
    flags = 0
    if pose_result == predictor.REJECTED:
        flags |= safety.POSE_REJECTED
    if forces_rejected != state.force_rejected:
        flags |= safety.FORCE_REJECTED
    if state.predictor.rejected_in_row >= 3:
        flags |= safety.POSES_WILD
    pose_age_ns = now_ns - state.predictor.accepted_ns
    force, force_age_ns = state.force.force_N, now_ns - state.force.age_from_ns
    force_timeout_ns = limits.force_timeout_ns
    if state.force.source == SOURCE_ESTIMATE:
        force_timeout_ns = limits.hold_after_ns
        if params.force_source == SOURCE_SENSOR:
            flags |= safety.FORCE_HANDOVER
    if armed and pose_age_ns > limits.hold_after_ns:
        flags |= safety.POSE_STALE
    if armed and pose_age_ns > limits.stop_after_ns:
        flags |= safety.POSE_LOST
    if (
        armed
        and force_age_ns <= force_timeout_ns
        and math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2) > limits.over_force_N
    ):
        flags |= safety.OVER_FORCE
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        if force_age_ns > force_timeout_ns:
            flags |= safety.FORCE_STALE
        if force_age_ns > limits.stop_after_ns:
            flags |= safety.FORCE_LOST
    if armed and inputs.command.kind == COMMAND_STOP:
        flags |= safety.OPERATOR_STOP
    if armed and inputs.board.state == BOARD_FAULT:
        flags |= safety.BOARD_FAULT
    if armed and now_ns - inputs.board.arrival_ns > limits.board_timeout_ns:
        flags |= safety.BOARD_SILENT
    if armed:
        flags |= inputs.command.watch
    return flags


@njit(cache=True)
def _believe(params, state) -> None:  # type: ignore[no-untyped-def]
    """Where the distal end will be when the stages are where they were sent: through play, slope and knob."""
    state.believed[0] = backlash.follow(params.backlash, state.backlash, state.stage.position[0]) + state.home_m
    state.believed[1] = backlash.distal_roll(params.backlash, state.stage.position[1])
    state.believed[2] = state.stage.position[2]


@njit(cache=True)
def _locate(params, state, inputs, tip_m) -> None:  # type: ignore[no-untyped-def]
    """Joints of a rig at rest: stages as the board says, the insertion such that the free tip is where it is measured."""
    for axis in range(N_AXES):
        state.stage.position[axis] = inputs.board.position_steps[axis] / params.stage.steps_per_unit[axis]
        state.stage.speed[axis] = 0.0
    config, joint = params.backlash, state.hybrid.joint
    forward_m = (state.stage.position[0] - 0.5 * backlash.first_width(config)) * config.slope
    backlash.start(config, state.backlash, forward_m)
    joint[1] = backlash.distal_roll(config, state.stage.position[1])
    joint[2] = state.stage.position[2]
    joint[0] = forward_m + params.kinematics.insertion_at_home_m
    inverse_kinematics.apply_nearest(params.kinematics, tip_m, joint, state.work[0])
    joint[0] = state.work[0, 0]
    state.home_m = joint[0] - forward_m
    _believe(params, state)


@njit(cache=True)
def _arm(params, state, inputs, tip_m) -> None:  # type: ignore[no-untyped-def]
    """Start from where the stages are, at rest."""
    _locate(params, state, inputs, tip_m)
    force_source.start(params, state.force)
    hybrid.forget(state.hybrid)
    predictive.start(state)
    for i in range(3):
        state.hybrid.goal_m[i] = tip_m[i]
    state.phase = PHASE_HOLD


@njit(cache=True)
def _enter(params, state, phase: int, tip_m, now_ns: int) -> None:  # type: ignore[no-untyped-def]
    """Change of phase without a bump: the goal starts at the tip, the integrators empty, the joint command stays."""
    if state.phase == phase:
        return
    state.phase = phase
    hybrid.forget(state.hybrid)
    if params.law == LAW_PREDICTIVE:
        predictive.stay(state)
    state.hybrid.above_ns = 0
    state.contact_since_ns = now_ns
    state.retract_from_m = state.hybrid.joint[0]
    for i in range(3):
        state.hybrid.goal_m[i] = tip_m[i]


@njit(cache=True)
def _sensible(params, command) -> bool:  # type: ignore[no-untyped-def]
    """Whether a command may be acted on: finite target in the workspace, unit normal, force below the limit."""
    config, square = params.predictor, 0.0
    for i in range(3):
        if not (config.workspace_min_m[i] <= command.target_m[i] <= config.workspace_max_m[i]):
            return False
        square += command.normal[i] ** 2
    return abs(square - 1.0) < 1e-3 and 0.0 <= command.force_N < params.safety.over_force_N


@njit(cache=True)
def _obey(params, state, inputs, action: int, tip_m) -> None:  # type: ignore[no-untyped-def]
    """The phase that the operator's command and the failsafe action lead to. Only disarming leads out of a stop."""
    command = inputs.command
    ready = inputs.board.ready != 0 and state.predictor.started != 0
    if command.armed == 0:
        state.phase = PHASE_DISARMED
        return
    if action == ACTION_STOP:
        if state.phase != PHASE_DISARMED:
            _enter(params, state, PHASE_STOPPED, tip_m, inputs.now_ns)
        return
    if action == ACTION_RETRACT:
        if state.phase != PHASE_DISARMED and state.phase != PHASE_STOPPED:
            _enter(params, state, PHASE_RETRACT, tip_m, inputs.now_ns)
        return
    if state.phase == PHASE_STOPPED:
        return
    if state.phase == PHASE_DISARMED:
        if ready and command.count != state.command_seen:
            _arm(params, state, inputs, tip_m)
            state.command_seen = command.count
        return
    if command.count == state.command_seen:
        return
    state.command_seen = command.count
    if command.kind == COMMAND_HOLD:
        _enter(params, state, PHASE_HOLD, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_RETRACT:
        _enter(params, state, PHASE_RETRACT, tip_m, inputs.now_ns)
    elif not _sensible(params, command):
        _enter(params, state, PHASE_HOLD, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_POSITION:
        _enter(params, state, PHASE_POSITION, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_CONTACT:
        if state.phase != PHASE_CONTACT:
            _enter(params, state, PHASE_APPROACH, tip_m, inputs.now_ns)


@njit(cache=True)
def _watch_contact(params, state, inputs, force_N: float, tip_m) -> None:  # type: ignore[no-untyped-def]
    """Approach turns into contact and back, each after its debouncing time."""
    config, hy, now_ns = params.hybrid, state.hybrid, inputs.now_ns
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
        _enter(params, state, PHASE_CONTACT if approaching else PHASE_APPROACH, tip_m, now_ns)
        if approaching:
            predictive.touch(params, state, force_N)


@njit(cache=True)
def _retract(params, state, inputs, tip_m) -> None:  # type: ignore[no-untyped-def]
    hy = state.hybrid
    if state.retract_from_m - hy.joint[0] < params.safety.retract_distance_m:
        hy.joint[0] -= params.safety.retract_speed_m_per_s * params.period_s
    else:
        _enter(params, state, PHASE_STOPPED, tip_m, inputs.now_ns)


@njit(cache=True)
def _approach_target(command, out_m) -> None:  # type: ignore[no-untyped-def]
    for i in range(3):
        out_m[i] = command.target_m[i] - _SEARCH_m * command.normal[i]


@njit(cache=True)
def _control_thesis(params, state, inputs, tip_m, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """The thesis' law (Figs. 6.12, 7.1): PI loops around the inverse kinematics, force PI outside."""
    command, hy, period_s = inputs.command, state.hybrid, params.period_s
    error_m, goal_m = state.work[3], state.hybrid.goal_m
    if state.phase == PHASE_POSITION:
        hybrid.move_goal(goal_m, command.target_m, params.hybrid.approach_speed_m_per_s * period_s)
    elif state.phase == PHASE_APPROACH:
        _approach_target(command, error_m)
        hybrid.move_goal(goal_m, error_m, params.hybrid.approach_speed_m_per_s * period_s)
    elif state.phase == PHASE_CONTACT:
        for i in range(3):
            goal_m[i] = command.target_m[i]
    else:
        return
    hybrid.tip_error(
        params.hybrid,
        hy,
        state.phase == PHASE_CONTACT,
        tip_m,
        goal_m,
        command.normal,
        command.force_N,
        force_N,
        period_s,
        error_m,
    )
    hybrid.apply(params.hybrid, params.kinematics, hy, tip_m, error_m, period_s, state.work)


@njit(cache=True)
def _control_predictive(params, state, inputs, force_N: float) -> None:  # type: ignore[no-untyped-def]
    command, law = inputs.command, params.predictive
    if state.phase == PHASE_POSITION:
        predictive.go(params, state, command.target_m, law.move_speed_m_per_s)
    elif state.phase == PHASE_APPROACH:
        _approach_target(command, state.work[3])
        slow = law.blind_share if state.force.source == SOURCE_ESTIMATE else 1.0
        predictive.go(params, state, state.work[3], slow * params.hybrid.approach_speed_m_per_s)
    elif state.phase == PHASE_CONTACT:
        predictive.press(params, state, inputs.now_ns, command.target_m, command.force_N, force_N)
    else:
        predictive.stay(state)


@njit(cache=True)
def _control(params, state, inputs, tip_m, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """Advance the joint command by one tick according to the phase."""
    if state.phase == PHASE_RETRACT:
        _retract(params, state, inputs, tip_m)
        return
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        _watch_contact(params, state, inputs, force_N, tip_m)
    if params.law == LAW_PREDICTIVE:
        _control_predictive(params, state, inputs, force_N)
    else:
        _control_thesis(params, state, inputs, tip_m, force_N)


@njit(cache=True)
def _move_stages(params, state, foreseeing: bool) -> None:  # type: ignore[no-untyped-def]
    """Joint command -> handle (backlash and slope inverses) -> limited stage motion."""
    period_s, hy, play, own = params.period_s, state.hybrid, params.backlash, state.predictive
    if state.phase == PHASE_STOPPED or state.phase == PHASE_DISARMED:
        for axis in range(N_AXES):
            stage_limiter.brake(params.stage, state.stage, axis, period_s)
        return
    body_m = hy.joint[0] - state.home_m
    if foreseeing:
        handle_m = backlash.apply_ahead(
            play, state.backlash, body_m, own.soon[0] - state.home_m, own.later[0] - state.home_m, own.depth_m
        )
        stage_limiter.follow(params.stage, state.stage, 0, handle_m, own.speed[0] / play.slope, period_s)
        stage_limiter.follow(
            params.stage, state.stage, 1, backlash.roll(play, hy.joint[1]), backlash.roll(play, own.speed[1]), period_s
        )
        stage_limiter.follow(params.stage, state.stage, 2, hy.joint[2], own.speed[2], period_s)
        return
    stage_limiter.apply(params.stage, state.stage, 0, backlash.apply(play, state.backlash, body_m), period_s)
    stage_limiter.apply(params.stage, state.stage, 1, backlash.roll(play, hy.joint[1]), period_s)
    stage_limiter.apply(params.stage, state.stage, 2, hy.joint[2], period_s)


@njit(cache=True)
def _report(params, state, inputs, outputs, force_N: float, flags: int) -> None:  # type: ignore[no-untyped-def]
    outputs.now_ns = inputs.now_ns
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
        outputs.joint[axis] = state.believed[axis]
    outputs.joint[0] -= state.predictive.short_m  # for whoever reads forces from the shape; the law has its offset
    for i in range(3):
        outputs.tip_velocity_m_per_s[i] = state.predictor.velocity_m_per_s[i]
        outputs.goal_m[i] = state.hybrid.goal_m[i]
        outputs.force_N[i] = state.force.force_N[i]
    outputs.normal_force_N = force_N
    outputs.force_source, outputs.play_m = state.force.source, state.backlash.width_m
    predictive.report(params, state, inputs.now_ns, outputs)
    outputs.wanted_force_N = inputs.command.force_N
    outputs.phase, outputs.action, outputs.cause = state.phase, state.action, flags | state.latched
    outputs.poses_rejected, outputs.forces_rejected = state.predictor.rejected, state.force_rejected
    outputs.pose_age_ns = inputs.now_ns - state.predictor.accepted_ns


@njit(cache=True)
def tick(params, state, inputs, outputs) -> None:  # type: ignore[no-untyped-def]
    """One period of the loop.

    Arguments are record arrays of length 1 of PARAMS, STATE, INPUTS and OUTPUTS (`realtime.control.records`); state and
    outputs are changed in place. Finite outputs for any inputs: what is not finite is rejected where it enters.
    """
    p, s, u, y = params[0], state[0], inputs[0], outputs[0]
    ours = p.law == LAW_PREDICTIVE
    touching = s.phase == PHASE_CONTACT
    if not touching or u.command.count != s.command_seen:
        predictive.face(s, u.command.normal)
    pose_result = predictor.apply(p.predictor, s.predictor, u.tip)
    if pose_result == predictor.ACCEPTED and s.phase != PHASE_DISARMED:
        predictive.observe(p, s, u.tip, touching)
    rejected = s.force_rejected
    _take_force(p, s, u)
    tip_m = y.tip_m
    predictor.predict(s.predictor, u.now_ns, tip_m)
    if ours and s.phase != PHASE_DISARMED and s.predictive.offset_s > 0.0:
        predictive.tip_now(p, s, u.now_ns, touching, tip_m)
    force_N = s.force.value_N
    if s.force.source == SOURCE_ESTIMATE:
        force_N = predictive.force_now(p, s, u.now_ns) if ours and touching else s.force.smooth_N
    if not math.isfinite(force_N):
        force_N = 0.0
    flags = _flags(p, s, u, pose_result, rejected)
    clear = u.command.clear != s.cleared
    s.cleared = u.command.clear
    action, latched = safety.decide(flags, s.latched, clear)
    s.action, s.latched = action, latched
    _obey(p, s, u, action, tip_m)
    if s.phase == PHASE_DISARMED and s.predictor.started != 0:
        _locate(p, s, u, tip_m)
    if action < ACTION_HOLD or s.phase == PHASE_RETRACT:
        _control(p, s, u, tip_m, force_N)
    elif ours:
        predictive.stay(s)
    _move_stages(p, s, ours and s.phase != PHASE_RETRACT)
    _believe(p, s)
    free_tip.remember(s.history, u.now_ns + p.setpoint_lead_ns, s.believed, s.backlash.flank)
    s.ticks += 1
    _report(p, s, u, y, force_N, flags)
