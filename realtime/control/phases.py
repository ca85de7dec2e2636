"""The phase of the loop: what it does until the operator, the failsafe or the wall changes it.

Disarmed -> hold -> position, approach, jog, retract, as commanded; approach -> contact and back, as the force says; any of
them -> retract and stopped, as the failsafe decides. Only disarming leads out of stopped.
"""

from __future__ import annotations

from numba import njit

from realtime.control import (
    distal_joint,
    force_source,
    hybrid,
    jog,
    predictive,
    retraction,
    tip_offset,
    wall_observer,
    witnesses,
)
from realtime.control.codes import (
    ACTION_RETRACT,
    COMMAND_CONTACT,
    COMMAND_HOLD,
    COMMAND_JOG,
    COMMAND_POSITION,
    COMMAND_RETRACT,
    LAW_PREDICTIVE,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_DISARMED,
    PHASE_HOLD,
    PHASE_JOG,
    PHASE_POSITION,
    PHASE_RETRACT,
    PHASE_STOPPED,
)
from realtime.control.declare import ReadFloats
from realtime.control.records import CommandRecord, Inputs, Params, State


@njit(cache=True)
def enter(params: Params, state: State, phase: int, tip_m: ReadFloats) -> None:
    """Change the phase without a bump: the goal starts at the tip, the integrators empty, the joint command stays."""
    if state.phase == phase:
        return
    state.phase = phase
    hybrid.forget(state.hybrid)
    if params.law == LAW_PREDICTIVE:
        predictive.stay(state.predictive, state.hybrid, state.predicted_joint)
    state.hybrid.above_ns = 0
    state.retract_from_m, state.retract_knob_rad = state.predicted_joint[0], state.hybrid.joint[2]
    state.free_s = 0.0
    for i in range(3):
        state.hybrid.goal_m[i] = tip_m[i]


@njit(cache=True)
def apply(params: Params, state: State, inputs: Inputs, action: int, causes: int, tip_m: ReadFloats) -> None:
    """Set the phase that the command and the failsafe action lead to. Only disarming leads out of a stop."""
    command = inputs.command
    ready = inputs.board.ready != 0 and state.predictor.started != 0
    if command.armed == 0:
        state.phase = PHASE_DISARMED
        return
    if action >= ACTION_RETRACT or state.phase == PHASE_STOPPED:
        if state.phase != PHASE_DISARMED:
            _follow_failsafe(params, state, inputs, action, causes, tip_m)
        return
    if state.phase == PHASE_DISARMED:
        if ready and command.count != state.command_seen:
            _arm(params, state, inputs, tip_m)
            state.command_seen = command.count
        return
    if command.count == state.command_seen:
        return
    state.command_seen = command.count
    _follow_command(params, state, command, tip_m)


@njit(cache=True)
def _follow_failsafe(params: Params, state: State, inputs: Inputs, action: int, causes: int, tip_m: ReadFloats) -> None:
    """Set the phase of an armed loop that retracts, stops or is stopped."""
    away = action == ACTION_RETRACT and state.phase != PHASE_STOPPED
    if away or retraction.is_wanted(params, state, inputs, causes):
        enter(params, state, PHASE_RETRACT, tip_m)
    else:
        enter(params, state, PHASE_STOPPED, tip_m)


@njit(cache=True)
def _arm(params: Params, state: State, inputs: Inputs, tip_m: ReadFloats) -> None:
    """Start from where the stages are, at rest, with nothing learned."""
    distal_joint.locate(params, state, inputs, tip_m)
    force_source.start(params, state.force)
    witnesses.start(state.witness)
    hybrid.forget(state.hybrid)
    state.history.count = 0
    tip_offset.start(state.tip_offset)
    wall_observer.forget(params.wall, state.wall)
    predictive.stay(state.predictive, state.hybrid, state.predicted_joint)
    for i in range(3):
        state.hybrid.goal_m[i] = tip_m[i]
    state.phase = PHASE_HOLD


@njit(cache=True)
def _follow_command(params: Params, state: State, command: CommandRecord, tip_m: ReadFloats) -> None:
    """Set the phase that a new command requests of the armed loop."""
    if command.kind == COMMAND_HOLD:
        enter(params, state, PHASE_HOLD, tip_m)
    elif command.kind == COMMAND_RETRACT:
        enter(params, state, PHASE_RETRACT, tip_m)
    elif command.kind == COMMAND_JOG:
        _start_jog(params, state, command, tip_m)
    elif not _sensible(params, command):
        enter(params, state, PHASE_HOLD, tip_m)
    elif command.kind == COMMAND_POSITION:
        enter(params, state, PHASE_POSITION, tip_m)
    elif command.kind == COMMAND_CONTACT and state.phase != PHASE_CONTACT:
        enter(params, state, PHASE_APPROACH, tip_m)


@njit(cache=True)
def _start_jog(params: Params, state: State, command: CommandRecord, tip_m: ReadFloats) -> None:
    """Begin the commanded jog, or hold if it cannot be done. A jog that goes on is extended without a bump."""
    continued = state.phase == PHASE_JOG
    if jog.is_sensible(params.predictor, command, state.hybrid.goal_m if continued else tip_m):
        enter(params, state, PHASE_JOG, tip_m)
        jog.start(state.jog, command, state.hybrid.goal_m, continued)
    else:
        enter(params, state, PHASE_HOLD, tip_m)


@njit(cache=True)
def _sensible(params: Params, command: CommandRecord) -> bool:
    """Whether a command may be acted on: finite target in the workspace, unit normal, force below the limit."""
    config, square = params.predictor, 0.0
    for i in range(3):
        if not (config.workspace_min_m[i] <= command.target_m[i] <= config.workspace_max_m[i]):
            return False
        square += command.normal[i] ** 2
    return abs(square - 1.0) < 1e-3 and 0.0 <= command.force_N < params.safety.over_force_N
