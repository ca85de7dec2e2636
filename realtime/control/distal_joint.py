"""The joints of the distal end: insertion, roll and knob, as they follow from the stages."""

from __future__ import annotations

from numba import njit

from realtime.control import backlash, inverse_kinematics, roll_windup, wire_friction
from realtime.control.declare import ReadFloats
from realtime.control.records import N_AXES, Inputs, Params, State


@njit(cache=True)
def predict(params: Params, state: State) -> None:
    """Predict where the distal end will be when the stages are where they were sent: backlash, slopes, knob."""
    insertion_m = backlash.follow(params.backlash, state.backlash, state.stage.position[0])
    state.predicted_joint[0] = insertion_m + state.home_m
    state.predicted_joint[1] = backlash.distal_roll(params.backlash, state.stage.position[1]) + state.windup.windup_rad
    state.predicted_joint[2] = wire_friction.follow(params.wire, params.kinematics, state.wire, state.stage.position[2])


@njit(cache=True)
def locate(params: Params, state: State, inputs: Inputs, tip_m: ReadFloats) -> None:
    """Set the joints of a rig at rest: stages as the board says, the insertion such that the free tip is at `tip_m`."""
    for axis in range(N_AXES):
        state.stage.position[axis] = inputs.board.position_steps[axis] / params.stage.steps_per_unit[axis]
        state.stage.speed[axis] = 0.0
    config, joint = params.backlash, state.hybrid.joint
    roll_windup.forget(state.windup)
    state.history.windup_rad = 0.0
    forward_m = (state.stage.position[0] - 0.5 * backlash.first_width(config)) * config.slope
    backlash.start(config, state.backlash, forward_m)
    joint[1] = backlash.distal_roll(config, state.stage.position[1])
    joint[2] = wire_friction.start(params.kinematics, state.wire, state.stage.position[2])
    joint[0] = forward_m + params.kinematics.insertion_at_home_m
    joint[0] = inverse_kinematics.apply_nearest(params.kinematics, tip_m, joint)[0]
    state.home_m = joint[0] - forward_m
    predict(params, state)
