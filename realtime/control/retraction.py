"""The retraction: when a catheter is taken off the tissue, how, and when that is over."""

from __future__ import annotations

import math

from numba import njit

from realtime.control import free_tip, safety, witnesses
from realtime.control.codes import PHASE_CONTACT, PHASE_RETRACT, PHASE_STOPPED
from realtime.control.constraint_frame import dot
from realtime.control.records import Inputs, Params, State

# A retraction ends when nothing has pressed for this long; if something still does, it goes on for this much further.
_FREE_S, _RETRACT_MORE_m = 0.1, 0.030
# An urgent retraction turns the knob by at most this, if that takes the tip away by more than this per radian.
_BEND_rad, _BENDS_AWAY_m, _NUDGE_rad = 0.5, 0.003, 1e-3


@njit(cache=True)
def is_wanted(params: Params, state: State, inputs: Inputs, causes: int) -> bool:
    """Whether a stop takes the catheter off the tissue first, or a stopped catheter is retracted again.

    A catheter that is stopped in contact stays pressed, and a wall that comes nearer presses harder. So a stop in contact
    is followed by a retraction, and a stopped catheter retracts when any witness says that something presses on it. The
    rig file can forbid it (`safety.retract_stopped`); a board that does not move the stages makes it impossible.
    """
    if params.safety.retract_stopped == 0 or causes & safety.BOARD_BITS or inputs.board.ready == 0:
        return False
    if state.phase == PHASE_STOPPED:
        return witnesses.standing(params, state.witness, inputs, params.period_s)
    if state.phase == PHASE_RETRACT:
        return not _is_over(params, state)
    return state.phase == PHASE_CONTACT or witnesses.pressed(state.witness, inputs)


@njit(cache=True)
def _is_over(params: Params, state: State) -> bool:
    """Whether a retraction is over: far enough with no witness that presses, or as far as it may go."""
    least_m = params.safety.retract_distance_m
    far_m, asked_m = state.retract_from_m - state.predicted_joint[0], state.retract_from_m - state.hybrid.joint[0]
    return (far_m >= least_m and state.free_s > _FREE_S) or asked_m >= least_m + _RETRACT_MORE_m


@njit(cache=True)
def apply(params: Params, state: State, inputs: Inputs) -> bool:
    """Pull back until nothing presses; after an urgent cause at full speed, with the knob bending away from the wall.

    Return whether the retraction is over; the joint command then stays.
    """
    hy, period_s = state.hybrid, params.period_s
    state.free_s = 0.0 if witnesses.pressed(state.witness, inputs) else state.free_s + period_s
    if _is_over(params, state):
        return True
    # A stopped catheter that is pressed (`pressed_s`) is pressed by a wall that comes nearer.
    if state.latched & safety.URGENT_BITS == 0 and state.witness.pressed_s == 0.0:
        hy.joint[0] -= params.safety.retract_speed_m_per_s * period_s
        return False
    hy.joint[0] -= params.stage.max_speed[0] * params.backlash.slope * period_s
    # The insertion has to cross its backlash first; the knob has none to speak of.
    here_m = dot(free_tip.apply(params.kinematics, hy.joint), state.normal)
    nudged = (hy.joint[0], hy.joint[1], hy.joint[2] + _NUDGE_rad)
    outward_m = (dot(free_tip.apply(params.kinematics, nudged), state.normal) - here_m) / _NUDGE_rad
    bent_rad = hy.joint[2] + math.copysign(params.stage.max_speed[2] * period_s, outward_m)
    if abs(outward_m) > _BENDS_AWAY_m and abs(bent_rad - state.retract_knob_rad) < _BEND_rad:
        hy.joint[2] = min(max(bent_rad, params.stage.min_unit[2]), params.stage.max_unit[2])
    return False
