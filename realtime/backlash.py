"""Backlash inverse for insertion and slope inverse for roll (thesis 6.4.1; Tao and Kokotovic)."""

from __future__ import annotations

from numba import njit

from realtime.records import BACKLASH_PARAMS, BACKLASH_STATE

Config, State = BACKLASH_PARAMS, BACKLASH_STATE


@njit(cache=True)
def start(config, state, body_m: float) -> None:  # type: ignore[no-untyped-def]
    """Take the gap as taken up forward at body insertion `body_m` (m, relative to home)."""
    state.direction = 1.0
    state.extreme_m = body_m


@njit(cache=True)
def apply(config, state, body_m: float) -> float:  # type: ignore[no-untyped-def]
    """The handle insertion (m) that brings the body to `body_m` (m), both relative to home.

    Half the width is added in the direction of motion. The direction turns only after the body has come back
    from its extreme by `threshold_m`, so that noise does not send the stage through the gap. The jump at a
    reversal is spread under the stage's speed and acceleration limits by `stage_limiter`.
    """
    if state.direction * (body_m - state.extreme_m) >= 0.0:
        state.extreme_m = body_m
    elif abs(body_m - state.extreme_m) > config.threshold_m:
        state.direction = -state.direction
        state.extreme_m = body_m
    return body_m / config.slope + 0.5 * state.direction * config.width_m


@njit(cache=True)
def roll(config, body_rad: float) -> float:  # type: ignore[no-untyped-def]
    """The handle roll (rad) that turns the distal end to `body_rad` (rad): the slope's inverse."""
    return body_rad / config.roll_slope
