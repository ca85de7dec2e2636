"""Jog: a short slow motion of the tip along a direction, or of one axis, that ends where something is touched.

A jog moves a bounded way. It therefore ends by itself when its commander is gone: a page that repeats a short jog while a
button is held needs no other watchdog. An axis is jogged at the distal end: the backlash is compensated as in all motion.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control.codes import JOG_INSERTION, JOG_TIP
from realtime.control.declare import Floats, ReadFloats
from realtime.control.records import N_AXES, CommandRecord, JogState, PredictorParams, StageParams, StageState

# Before the first force of a jog was seen.
_NO_FORCE_YET_N = 1e9
# A way shorter than this (m, rad) is done; stages slower than this share of their greatest speed are at rest.
_DONE, _AT_REST = 1e-7, 0.01


@njit(cache=True)
def is_sensible(config: PredictorParams, command: CommandRecord, from_m: ReadFloats) -> bool:
    """Whether the jog in `command` can be done: finite, along a unit vector, and for the tip ending in the workspace."""
    if not (0 <= command.jog_axis <= JOG_TIP and math.isfinite(command.jog_travel) and math.isfinite(command.jog_speed)):
        return False
    if command.jog_speed <= 0.0:
        return False
    if command.jog_axis < N_AXES:
        return True
    square = 0.0
    for i in range(3):
        along, end_m = command.jog_direction[i], from_m[i] + command.jog_travel * command.jog_direction[i]
        square += along * along
        if not (config.workspace_min_m[i] <= end_m <= config.workspace_max_m[i]):
            return False
    return abs(square - 1.0) < 1e-3


@njit(cache=True)
def start(state: JogState, command: CommandRecord, from_m: ReadFloats, continued: bool) -> None:
    """Begin the jog in `command` at the tip's goal `from_m` (3,). A jog that is `continued` keeps the least force."""
    state.left = command.jog_travel
    for i in range(3):
        state.target_m[i] = from_m[i] + command.jog_travel * command.jog_direction[i]
    if not continued:
        state.least_force_N = _NO_FORCE_YET_N


@njit(cache=True)
def touches(state: JogState, command: CommandRecord, force_N: ReadFloats, threshold_N: float) -> bool:
    """Whether the jog presses: the force (3,) N has risen above its least value since the jog began by the threshold.

    A jog that leads away from the tissue goes on although a beating wall follows it.
    """
    size_N = math.sqrt(force_N[0] ** 2 + force_N[1] ** 2 + force_N[2] ** 2)
    state.least_force_N = min(state.least_force_N, size_N)
    pressing = size_N > state.least_force_N + threshold_N
    if command.jog_axis == JOG_TIP:
        along, towards = command.jog_direction, command.jog_travel
        return pressing and towards * (along[0] * force_N[0] + along[1] * force_N[1] + along[2] * force_N[2]) >= 0.0
    return pressing and not (command.jog_axis == JOG_INSERTION and command.jog_travel < 0.0)


@njit(cache=True)
def is_done(state: JogState, stages: StageState, config: StageParams, axis: int, goal_m: ReadFloats) -> bool:
    """Whether the way is done and the stages are at rest."""
    left = abs(state.left)
    if axis == JOG_TIP:
        left = abs(state.target_m[0] - goal_m[0]) + abs(state.target_m[1] - goal_m[1]) + abs(state.target_m[2] - goal_m[2])
    if left > _DONE:
        return False
    for i in range(N_AXES):
        if abs(stages.speed[i]) > _AT_REST * config.max_speed[i]:
            return False
    return True


@njit(cache=True)
def advance(state: JogState, joint: Floats, axis: int, speed: float, period_s: float) -> float:
    """Move the joint command of `axis` by one tick; return its speed (m/s or rad/s), 0.0 at the end of the way."""
    step = min(max(state.left, -speed * period_s), speed * period_s)
    joint[axis] += step
    state.left -= step
    return step / period_s
