"""Stage motion under speed, acceleration and travel limits, so that no command ever makes a stage jump."""

from __future__ import annotations

import math

from numba import njit

from realtime.records import STAGE_PARAMS, STAGE_STATE

Config, State = STAGE_PARAMS, STAGE_STATE

# Share of the acceleration limit that braking is planned with, and the pull towards the target (1/s) close to it.
_BRAKING_SHARE = 0.7
_PULL_PER_S = 150.0


@njit(cache=True)
def apply(config, state, axis: int, target: float, period_s: float) -> None:  # type: ignore[no-untyped-def]
    """Move `axis` one tick towards `target` (m or rad). A target that is not finite stops the stage."""
    position, speed = state.position[axis], state.speed[axis]
    accel = config.max_accel[axis]
    wanted = 0.0
    if math.isfinite(target):
        target = min(max(target, config.min_unit[axis]), config.max_unit[axis])
        gap = target - position
        wanted = min(_PULL_PER_S * abs(gap), math.sqrt(2.0 * _BRAKING_SHARE * accel * abs(gap)), config.max_speed[axis])
        wanted = math.copysign(wanted, gap)
    change = min(max(wanted - speed, -accel * period_s), accel * period_s)
    speed += change
    state.speed[axis] = speed
    state.position[axis] = min(max(position + speed * period_s, config.min_unit[axis]), config.max_unit[axis])


@njit(cache=True)
def brake(config, state, axis: int, period_s: float) -> None:  # type: ignore[no-untyped-def]
    """Bring `axis` to rest at its acceleration limit."""
    apply(config, state, axis, math.nan, period_s)
