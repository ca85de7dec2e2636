"""Stage motion under speed, acceleration and travel limits, so that no command ever makes a stage jump."""

from __future__ import annotations

import math

from numba import njit

from realtime.control.records import StageParams, StageState

# Share of the acceleration limit that braking is planned with, and the pull towards the target (1/s) close to it.
_BRAKING_SHARE = 0.8
_PULL_PER_S = 150.0


@njit(cache=True)
def crossing_time_s(distance: float, max_speed: float, max_accel: float) -> float:
    """Shortest time (s) from rest to rest over `distance`, as this limiter moves; units of the axis."""
    accel = 2.0 * max_accel * _BRAKING_SHARE / (1.0 + _BRAKING_SHARE)
    if distance * accel < max_speed**2:
        return 2.0 * math.sqrt(distance / accel)
    return distance / max_speed + max_speed / accel


@njit(cache=True)
def follow(config: StageParams, state: StageState, axis: int, target: float, target_speed: float, period_s: float) -> None:
    """Move `axis` one tick towards `target` (m or rad), which itself moves at `target_speed` (per s).

    A target or speed that is not finite stops the stage. The nearest way under the limits is taken: full speed, then
    braking to the target's speed just where it is met.
    """
    position, speed = state.position[axis], state.speed[axis]
    accel = config.max_accel[axis]
    wanted = 0.0
    if math.isfinite(target) and math.isfinite(target_speed):
        inside = config.min_unit[axis] < target < config.max_unit[axis]
        target = min(max(target, config.min_unit[axis]), config.max_unit[axis])
        gap = target - position
        closing = min(_PULL_PER_S * abs(gap), math.sqrt(2.0 * _BRAKING_SHARE * accel * abs(gap)))
        wanted = math.copysign(closing, gap) + (target_speed if inside else 0.0)
        wanted = min(max(wanted, -config.max_speed[axis]), config.max_speed[axis])
    change = min(max(wanted - speed, -accel * period_s), accel * period_s)
    speed += change
    state.speed[axis] = speed
    state.position[axis] = min(max(position + speed * period_s, config.min_unit[axis]), config.max_unit[axis])


@njit(cache=True)
def apply(config: StageParams, state: StageState, axis: int, target: float, period_s: float) -> None:
    """Move `axis` one tick towards `target` (m or rad), which stands still."""
    follow(config, state, axis, target, 0.0, period_s)


@njit(cache=True)
def brake(config: StageParams, state: StageState, axis: int, period_s: float) -> None:
    """Bring `axis` to rest at its acceleration limit."""
    follow(config, state, axis, math.nan, 0.0, period_s)
