"""External hybrid position/force control (thesis Fig. 7.1): PI loops in joint space around the inverse kinematics.

The thesis can be read in two ways, and both are here:
- PI form (chapter 7): q = q_0 + K_p e + K_i sum(e). For the gains of the experiments, (7.6).
- Incremental form (chapter 6 moves the joints by K_I e, 6.4.1): each tick adds K_p e + K_i sum(e) to the joints. For the
  gains of the simulations, K_pp = 1.37.
In both, the force loop's displacement is added to the *desired* position, as in Fig. 7.1 (external hybrid control), or to
the present tip, where no desired position at the wall is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from realtime.control import inverse_kinematics
from realtime.control.declare import Floats, Point, ReadFloats
from realtime.control.records import N_AXES, HybridParams, HybridState, KinematicsParams

# Limits of the joint error (m, rad, rad) and of the force integral, both against windup.
_ERROR_LIMIT = (0.010, 0.5, 0.5)
_FORCE_INTEGRAL_LIMIT_N_s = 0.5


class Aim(NamedTuple):
    """Set-point of the tip: position (3,) m, and in contact a force (N) against the outward normal (3,)."""

    target_m: ReadFloats
    normal: ReadFloats
    wanted_N: float
    contact: bool


@njit(cache=True)
def move_goal(goal_m: Floats, target_m: ReadFloats, step_m: float) -> None:
    """Bring `goal_m` (3,) up to `step_m` nearer to `target_m` (3,), in place."""
    distance = 0.0
    for i in range(3):
        distance += (target_m[i] - goal_m[i]) ** 2
    distance = math.sqrt(distance)
    share = 1.0 if distance <= step_m else step_m / distance
    for i in range(3):
        goal_m[i] += share * (target_m[i] - goal_m[i])


@njit(cache=True)
def tip_error(
    config: HybridParams, state: HybridState, tip_m: ReadFloats, aim: Aim, force_N: float, period_s: float
) -> Point:
    """Return the requested displacement of the tip (m), from its position (3,) and the measured compression (N).

    delta = K_pf e + K_if integral(e) along the normal comes from the force loop. External hybrid control (`from_desired`):
    it is added to the desired position, whose distance from the tip along the normal remains. Otherwise it is added to the
    present tip: the selection matrix S = normal normal^T takes the normal direction from the position loop.
    """
    target_m, normal = aim.target_m, aim.normal
    error_m = (target_m[0] - tip_m[0], target_m[1] - tip_m[1], target_m[2] - tip_m[2])
    if not aim.contact:
        return error_m
    along = 0.0
    for i in range(3):
        along += error_m[i] * normal[i]
    error_N = aim.wanted_N - force_N
    integral = state.force_integral_N_s + error_N * period_s
    state.force_integral_N_s = min(max(integral, -_FORCE_INTEGRAL_LIMIT_N_s), _FORCE_INTEGRAL_LIMIT_N_s)
    delta_m = config.force_gain_m_per_N * error_N + config.force_integral_m_per_N_s * state.force_integral_N_s
    change_m = -delta_m if config.from_desired != 0 else -delta_m - along
    return (
        error_m[0] + change_m * normal[0],
        error_m[1] + change_m * normal[1],
        error_m[2] + change_m * normal[2],
    )


@njit(cache=True)
def apply(
    config: HybridParams,
    kinematics: KinematicsParams,
    state: HybridState,
    tip_m: ReadFloats,
    error_m: ReadFloats,
    period_s: float,
) -> None:
    """Advance the joint command (body insertion m, roll rad, knob rad) of `state` by one tick.

    The inverse kinematics is called twice (Fig. 6.12), on the branch nearest to the last command: for the predicted tip
    (3,) and for the requested one, `error_m` (3,) further; their difference is the joint error of the PI controller.
    """
    goal_m = (tip_m[0] + error_m[0], tip_m[1] + error_m[1], tip_m[2] + error_m[2])
    measured = inverse_kinematics.apply_nearest(kinematics, tip_m, state.joint)
    wanted = inverse_kinematics.apply_nearest(kinematics, goal_m, state.joint)
    for axis in range(N_AXES):
        limit = _ERROR_LIMIT[axis]
        error = min(max(wanted[axis] - measured[axis], -limit), limit)
        if config.pi_form != 0:
            # K_p e + K_i sum(e) by its change from tick to tick, so that nothing winds up and no phase begins with a jump.
            change = error - state.last_error[axis] if state.has_last != 0 else 0.0
            state.joint[axis] += config.joint_gain * change + config.joint_integral_per_s * error * period_s
            state.last_error[axis] = error
            continue
        stored = limit / max(config.position_gain_per_s, 1e-9)
        state.integral[axis] = min(max(state.integral[axis] + error * period_s, -stored), stored)
        rate = config.position_gain_per_s * error + config.position_integral_per_s2 * state.integral[axis]
        state.joint[axis] += rate * period_s
    state.has_last = 1


@njit(cache=True)
def forget(state: HybridState) -> None:
    """Empty the integrators: the joint command stays where it is, so the change of phase has no bump."""
    for axis in range(N_AXES):
        state.integral[axis] = 0.0
    state.has_last = 0
    state.force_integral_N_s = 0.0
