"""The causes of the failsafe that stand at a tick: what is wrong with poses, forces, board, operator and model process.

`safety.decide` turns them into the safety action. Which causes there are, and what each is called, is declared there.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control import predictor, safety, witnesses
from realtime.control.codes import (
    BOARD_FAULT,
    COMMAND_STOP,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_DISARMED,
    PHASE_STOPPED,
    SOURCE_ESTIMATE,
    SOURCE_SENSOR,
)
from realtime.control.records import Inputs, Params, State

# The requested force counts as not reached after the free tip has been as deep as it may be for this long.
_SHORT_S = 1.0
# This many poses rejected in a row make the loop hold.
_WILD_POSES = 3


@njit(cache=True)
def apply(params: Params, state: State, inputs: Inputs, pose_result: int, forces_rejected: int) -> int:
    """Return the bit set of all causes at this tick."""
    armed = state.phase != PHASE_DISARMED
    flags = 0
    if pose_result == predictor.REJECTED:
        flags |= safety.POSE_REJECTED
    if forces_rejected != state.force_rejected:
        flags |= safety.FORCE_REJECTED
    if state.predictor.rejected_in_row >= _WILD_POSES:
        flags |= safety.POSES_WILD
    if armed:
        flags |= _of_armed_rig(params, state, inputs) | _of_witnesses(params, state, inputs)
    return flags | _of_force(params, state, inputs.now_ns, armed)


@njit(cache=True)
def _of_force(params: Params, state: State, now_ns: int, armed: bool) -> int:
    """Return the causes that concern the force that closes the loop."""
    flags, limits = 0, params.safety
    force_age_ns = now_ns - state.force.age_from_ns
    force_timeout_ns = limits.force_timeout_ns
    if state.force.source == SOURCE_ESTIMATE:
        force_timeout_ns = limits.hold_after_ns
        if params.force_source == SOURCE_SENSOR:
            flags |= safety.FORCE_HANDOVER
    if armed and force_age_ns <= force_timeout_ns:
        force = state.force.force_N
        if math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2) > limits.over_force_N:
            flags |= safety.OVER_FORCE
    if state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT:
        if force_age_ns > force_timeout_ns:
            flags |= safety.FORCE_STALE
        if force_age_ns > limits.stop_after_ns:
            flags |= safety.FORCE_LOST
    return flags


@njit(cache=True)
def _of_witnesses(params: Params, state: State, inputs: Inputs) -> int:
    """Return the causes from sensor, estimate and geometry of an armed loop, whichever of them closes the loop."""
    flags, witness = 0, state.witness
    if witnesses.over(params, witness, state.force, inputs):
        flags |= safety.OVER_FORCE
    differ = witnesses.disagree(params, witness, inputs, state.phase)
    if differ == 2:
        flags |= safety.FORCE_DISAGREES
    elif differ == 1:
        flags |= safety.FORCE_UNDECIDED
    if state.phase == PHASE_CONTACT and state.predictive.short_s > _SHORT_S:
        flags |= safety.FORCE_UNREACHED
    if state.phase == PHASE_STOPPED and witnesses.pressed(witness, inputs):
        flags |= safety.STILL_PRESSED
    return flags


@njit(cache=True)
def _of_armed_rig(params: Params, state: State, inputs: Inputs) -> int:
    """Return the causes that concern poses, board and operator of an armed loop; and those that the supervision found."""
    limits, now_ns = params.safety, inputs.now_ns
    flags = inputs.command.watch
    in_contact = state.phase == PHASE_APPROACH or state.phase == PHASE_CONTACT
    if not (in_contact or witnesses.pressed(state.witness, inputs)):
        flags &= ~safety.HOST_LOST
    pose_age_ns = now_ns - state.predictor.accepted_ns
    if pose_age_ns > limits.hold_after_ns:
        flags |= safety.POSE_STALE
    if pose_age_ns > limits.stop_after_ns:
        flags |= safety.POSE_LOST
    if inputs.command.kind == COMMAND_STOP:
        flags |= safety.OPERATOR_STOP
    if inputs.board.state == BOARD_FAULT:
        flags |= safety.BOARD_FAULT
    if now_ns - inputs.board.arrival_ns > limits.board_timeout_ns:
        flags |= safety.BOARD_SILENT
    return flags
