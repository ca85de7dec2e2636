"""External hybrid position/force control (thesis Fig. 7.1): PI loops in joint space around the inverse kinematics."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from realtime.control import inverse_kinematics
from realtime.control.records import HYBRID_PARAMS, HYBRID_STATE, N_AXES

Config, State = HYBRID_PARAMS, HYBRID_STATE

# Greatest joint error acted on (m, rad, rad), and greatest stored integral, both against windup.
_ERROR_LIMIT = (0.010, 0.5, 0.5)
_FORCE_INTEGRAL_LIMIT_N_s = 0.5


@njit(cache=True)
def move_goal(goal_m, target_m, step_m: float) -> None:  # type: ignore[no-untyped-def]
    """Bring `goal_m` (3,) up to `step_m` nearer to `target_m` (3,), in place."""
    distance = 0.0
    for i in range(3):
        distance += (target_m[i] - goal_m[i]) ** 2
    distance = math.sqrt(distance)
    share = 1.0 if distance <= step_m else step_m / distance
    for i in range(3):
        goal_m[i] += share * (target_m[i] - goal_m[i])


@njit(cache=True)
def tip_error(  # type: ignore[no-untyped-def]
    config,
    state,
    contact: bool,
    tip_m,
    target_m,
    normal,
    wanted_N: float,
    force_N: float,
    period_s: float,
    out_m,
) -> None:
    """Wanted tip displacement (3,) m into `out_m`.

    The selection matrix S = normal normal^T takes the normal direction from the force loop,
    delta = K_pf e + K_if integral(e), and leaves the others to the position loop.
    """
    along = 0.0
    for i in range(3):
        out_m[i] = target_m[i] - tip_m[i]
        along += out_m[i] * normal[i]
    if not contact:
        return
    error_N = wanted_N - force_N
    integral = state.force_integral_N_s + error_N * period_s
    state.force_integral_N_s = min(max(integral, -_FORCE_INTEGRAL_LIMIT_N_s), _FORCE_INTEGRAL_LIMIT_N_s)
    delta_m = config.force_gain_m_per_N * error_N + config.force_integral_m_per_N_s * state.force_integral_N_s
    for i in range(3):
        out_m[i] += (-delta_m - along) * normal[i]


@njit(cache=True)
def apply(config, kinematics, state, tip_m, error_m, period_s: float, work) -> None:  # type: ignore[no-untyped-def]
    """Advance the joint command (body insertion m, roll rad, knob rad) of `state` by one tick.

    The inverse kinematics is called twice (Fig. 6.12), on the branch nearest to the last command: for the predicted tip
    and for the wanted one; their difference is the joint error of the PI controller. `work` (3, 3) is scratch space.
    """
    measured, wanted, goal_m = work[0], work[1], work[2]
    for i in range(3):
        goal_m[i] = tip_m[i] + error_m[i]
    inverse_kinematics.apply_nearest(kinematics, tip_m, state.joint, measured)
    inverse_kinematics.apply_nearest(kinematics, goal_m, state.joint, wanted)
    for axis in range(N_AXES):
        limit = _ERROR_LIMIT[axis]
        error = min(max(wanted[axis] - measured[axis], -limit), limit)
        stored = limit / max(config.position_gain_per_s, 1e-9)
        state.integral[axis] = min(max(state.integral[axis] + error * period_s, -stored), stored)
        rate = config.position_gain_per_s * error + config.position_integral_per_s2 * state.integral[axis]
        state.joint[axis] += rate * period_s


@njit(cache=True)
def forget(state) -> None:  # type: ignore[no-untyped-def]
    """Empty the integrators: the joint command stays where it is, so the change of phase has no bump."""
    for axis in range(N_AXES):
        state.integral[axis] = 0.0
    state.force_integral_N_s = 0.0


WORK_SHAPE = (3, 3)


def new_work() -> np.ndarray:
    """Scratch space for `apply`."""
    return np.zeros(WORK_SHAPE)
