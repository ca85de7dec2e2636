"""The control tick: (parameters, state, inputs) -> (state, outputs). Pure, no allocation, the same on every clock."""

from __future__ import annotations

import math

from numba import njit

from realtime import backlash, hybrid, predictor, safety, stage_limiter
from realtime.records import (
    COMMAND_CONTACT,
    COMMAND_HOLD,
    COMMAND_POSITION,
    COMMAND_RETRACT,
    COMMAND_STOP,
    N_AXES,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_DISARMED,
    PHASE_HOLD,
    PHASE_POSITION,
    PHASE_RETRACT,
    PHASE_STOPPED,
)

# The board's states and readiness as they appear in the input record.
BOARD_FAULT_STATE = 4
FORCE_FROM_SENSOR, FORCE_FROM_ESTIMATE = 0, 1

# Contact is believed after this long above the threshold, and lost after this long below half of it.
_CONTACT_NS = 3_000_000
_LOST_NS = 500_000_000
# How far beyond the given target the approach goes on looking for the wall.
_SEARCH_m = 0.010
# A reading above this is no contact force, whatever the sensor says.
_FORCE_RANGE_N = 20.0


@njit(cache=True)
def _take_force(params, state, inputs) -> None:  # type: ignore[no-untyped-def]
    force = inputs.sensor if params.force_source == FORCE_FROM_SENSOR else inputs.estimate
    if force.count == state.force_seen:
        return
    state.force_seen = force.count
    square = force.force_N[0] ** 2 + force.force_N[1] ** 2 + force.force_N[2] ** 2
    if not (square < _FORCE_RANGE_N ** 2):
        state.force_rejected += 1
        return
    for i in range(3):
        state.force_N[i] = force.force_N[i]
    state.force_arrival_ns = force.arrival_ns


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
    force_age_ns = now_ns - state.force_arrival_ns
    if armed and pose_age_ns > limits.hold_after_ns:
        flags |= safety.POSE_STALE
    if armed and pose_age_ns > limits.stop_after_ns:
        flags |= safety.POSE_LOST
    if armed and force_age_ns <= limits.force_timeout_ns and math.sqrt(
            state.force_N[0] ** 2 + state.force_N[1] ** 2 + state.force_N[2] ** 2) > limits.over_force_N:
        flags |= safety.OVER_FORCE
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        if force_age_ns > limits.force_timeout_ns:
            flags |= safety.FORCE_STALE
        if force_age_ns > limits.stop_after_ns:
            flags |= safety.FORCE_LOST
    if armed and inputs.command.kind == COMMAND_STOP:
        flags |= safety.OPERATOR_STOP
    if armed and inputs.board.state == BOARD_FAULT_STATE:
        flags |= safety.BOARD_FAULT
    if armed and now_ns - inputs.board.arrival_ns > limits.board_timeout_ns:
        flags |= safety.BOARD_SILENT
    if armed:
        flags |= inputs.command.watch
    return flags


@njit(cache=True)
def _arm(params, state, inputs, tip_m) -> None:  # type: ignore[no-untyped-def]
    """Start from where the stages are, at rest."""
    for axis in range(N_AXES):
        state.stage.position[axis] = inputs.board.position_steps[axis] / params.stage.steps_per_unit[axis]
        state.stage.speed[axis] = 0.0
    config, joint = params.backlash, state.hybrid.joint
    forward_m = (state.stage.position[0] - 0.5 * config.width_m) * config.slope
    backlash.start(config, state.backlash, forward_m)
    joint[0] = forward_m + params.kinematics.insertion_at_home_m
    joint[1] = state.stage.position[1] * config.roll_slope
    joint[2] = state.stage.position[2]
    hybrid.forget(state.hybrid)
    for i in range(3):
        state.hybrid.goal_m[i] = tip_m[i]
    state.phase = PHASE_HOLD


@njit(cache=True)
def _enter(state, phase: int, tip_m, now_ns: int) -> None:  # type: ignore[no-untyped-def]
    """Change of phase without a bump: the goal starts at the tip, the integrators empty, the joint command stays."""
    if state.phase == phase:
        return
    state.phase = phase
    hybrid.forget(state.hybrid)
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
    if action == safety.STOP:
        if state.phase != PHASE_DISARMED:
            _enter(state, PHASE_STOPPED, tip_m, inputs.now_ns)
        return
    if action == safety.RETRACT:
        if state.phase != PHASE_DISARMED and state.phase != PHASE_STOPPED:
            _enter(state, PHASE_RETRACT, tip_m, inputs.now_ns)
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
        _enter(state, PHASE_HOLD, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_RETRACT:
        _enter(state, PHASE_RETRACT, tip_m, inputs.now_ns)
    elif not _sensible(params, command):
        _enter(state, PHASE_HOLD, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_POSITION:
        _enter(state, PHASE_POSITION, tip_m, inputs.now_ns)
    elif command.kind == COMMAND_CONTACT:
        if state.phase != PHASE_CONTACT:
            _enter(state, PHASE_APPROACH, tip_m, inputs.now_ns)


@njit(cache=True)
def _watch_contact(params, state, inputs, force_N: float, tip_m) -> None:  # type: ignore[no-untyped-def]
    """Approach turns into contact and back, each after its debouncing time."""
    config, hy, now_ns = params.hybrid, state.hybrid, inputs.now_ns
    approaching = state.phase == PHASE_APPROACH
    turned = force_N > config.contact_force_N if approaching else force_N < 0.5 * config.contact_force_N
    if not turned:
        hy.above_ns = 0
        return
    if hy.above_ns == 0:
        hy.above_ns = now_ns
    if now_ns - hy.above_ns >= (_CONTACT_NS if approaching else _LOST_NS):
        _enter(state, PHASE_CONTACT if approaching else PHASE_APPROACH, tip_m, now_ns)


@njit(cache=True)
def _control(params, state, inputs, tip_m, force_N: float) -> None:  # type: ignore[no-untyped-def]
    """Advance the joint command by one tick according to the phase."""
    command, hy, period_s = inputs.command, state.hybrid, params.period_s
    error_m, goal_m = state.work[3], state.hybrid.goal_m
    if state.phase == PHASE_RETRACT:
        if state.retract_from_m - hy.joint[0] < params.safety.retract_distance_m:
            hy.joint[0] -= params.safety.retract_speed_m_per_s * period_s
        else:
            _enter(state, PHASE_STOPPED, tip_m, inputs.now_ns)
        return
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        _watch_contact(params, state, inputs, force_N, tip_m)
    if state.phase == PHASE_POSITION:
        hybrid.move_goal(goal_m, command.target_m, params.hybrid.approach_speed_m_per_s * period_s)
    elif state.phase == PHASE_APPROACH:
        for i in range(3):
            error_m[i] = command.target_m[i] - _SEARCH_m * command.normal[i]
        hybrid.move_goal(goal_m, error_m, params.hybrid.approach_speed_m_per_s * period_s)
    elif state.phase == PHASE_CONTACT:
        for i in range(3):
            goal_m[i] = command.target_m[i]
    else:
        return
    hybrid.tip_error(params.hybrid, hy, state.phase == PHASE_CONTACT, tip_m, goal_m, command.normal,
                     command.force_N, force_N, period_s, error_m)
    hybrid.apply(params.hybrid, params.kinematics, hy, tip_m, error_m, period_s, state.work)


@njit(cache=True)
def _move_stages(params, state) -> None:  # type: ignore[no-untyped-def]
    """Joint command -> handle (backlash and slope inverses) -> limited stage motion."""
    period_s, hy = params.period_s, state.hybrid
    if state.phase == PHASE_STOPPED or state.phase == PHASE_DISARMED:
        for axis in range(N_AXES):
            stage_limiter.brake(params.stage, state.stage, axis, period_s)
        return
    handle_m = backlash.apply(params.backlash, state.backlash, hy.joint[0] - params.kinematics.insertion_at_home_m)
    stage_limiter.apply(params.stage, state.stage, 0, handle_m, period_s)
    stage_limiter.apply(params.stage, state.stage, 1, backlash.roll(params.backlash, hy.joint[1]), period_s)
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
        outputs.joint[axis] = state.hybrid.joint[axis]
    for i in range(3):
        outputs.tip_velocity_m_per_s[i] = state.predictor.velocity_m_per_s[i]
        outputs.goal_m[i] = state.hybrid.goal_m[i]
        outputs.force_N[i] = state.force_N[i]
    outputs.normal_force_N = force_N
    outputs.wanted_force_N = inputs.command.force_N
    outputs.phase, outputs.action, outputs.cause = state.phase, state.action, flags | state.latched
    outputs.poses_rejected, outputs.forces_rejected = state.predictor.rejected, state.force_rejected
    outputs.pose_age_ns = inputs.now_ns - state.predictor.accepted_ns


@njit(cache=True)
def tick(params, state, inputs, outputs) -> None:  # type: ignore[no-untyped-def]
    """One period of the loop.

    Arguments are record arrays of length 1 of PARAMS, STATE, INPUTS and OUTPUTS (`realtime.records`); state and
    outputs are changed in place. Finite outputs for any inputs: what is not finite is rejected where it enters.
    """
    p, s, u, y = params[0], state[0], inputs[0], outputs[0]
    pose_result = predictor.apply(p.predictor, s.predictor, u.tip)
    rejected = s.force_rejected
    _take_force(p, s, u)
    tip_m = y.tip_m
    predictor.predict(s.predictor, u.now_ns, tip_m)
    force_N = hybrid.normal_force(s.force_N, u.command.normal)
    if not math.isfinite(force_N):
        force_N = 0.0
    flags = _flags(p, s, u, pose_result, rejected)
    clear = u.command.clear != s.cleared
    s.cleared = u.command.clear
    action, latched = safety.decide(flags, s.latched, clear)
    s.action, s.latched = action, latched
    _obey(p, s, u, action, tip_m)
    if action < safety.HOLD or s.phase == PHASE_RETRACT:
        _control(p, s, u, tip_m, force_N)
    _move_stages(p, s)
    s.ticks += 1
    _report(p, s, u, y, force_N, flags)
