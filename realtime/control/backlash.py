"""Backlash of the insertion: its inverse (thesis 6.4.1; Tao and Kokotovic) and the estimated position of the body."""

from __future__ import annotations

from numba import njit

from realtime.control.records import BacklashParams, BacklashState

# A width learned in contact may differ from the rig file's by this much.
_FREEDOM_m = 0.001


@njit(cache=True)
def first_width(config: BacklashParams) -> float:
    """Return the width (m) that is assumed at first, below that of the rig file.

    A width that is assumed too large makes the body jump at each reversal; one that is too small does not.
    """
    return max(config.width_m - config.caution_m, 0.0)


@njit(cache=True)
def start(config: BacklashParams, state: BacklashState, body_m: float) -> None:
    """Start at body insertion `body_m` (m, relative to home), with the gap taken up forward."""
    state.direction = 1.0
    state.extreme_m = body_m
    state.body_m = body_m
    state.flank = 1.0
    state.width_m = first_width(config)


@njit(cache=True)
def follow(config: BacklashParams, state: BacklashState, handle_m: float) -> float:
    """Return the position of the body (m, relative to home) after the handle moved to `handle_m`: the play operator."""
    half_m = 0.5 * state.width_m
    before_m = state.body_m
    state.body_m = min(max(before_m, (handle_m - half_m) * config.slope), (handle_m + half_m) * config.slope)
    if state.body_m != before_m:
        state.flank = 1.0 if state.body_m > before_m else -1.0
    return state.body_m


@njit(cache=True)
def narrow(config: BacklashParams, state: BacklashState, by_m: float) -> float:
    """Reduce the assumed width by `by_m`, to within _FREEDOM_m of the rig file's width. Return the change (m)."""
    least = max(config.width_m - _FREEDOM_m, 0.0)
    width_m = min(max(state.width_m - by_m, least), config.width_m + _FREEDOM_m)
    changed_m = state.width_m - width_m
    state.width_m = width_m
    return changed_m


@njit(cache=True)
def handle_for(config: BacklashParams, state: BacklashState, body_m: float) -> float:
    """Return the handle insertion (m) that puts the body at `body_m` in the present direction; both relative to home."""
    return body_m / config.slope + 0.5 * state.direction * state.width_m


@njit(cache=True)
def apply(config: BacklashParams, state: BacklashState, body_m: float) -> float:
    """Return the handle insertion (m) that brings the body to `body_m` (m), both relative to home.

    Half the width is added in the direction of motion. The direction changes only when the requested position has
    returned from its extreme by `threshold_m`, so that noise does not send the stage through the gap. `stage_limiter`
    spreads the jump at a reversal under the stage's speed and acceleration limits.
    """
    if state.direction * (body_m - state.extreme_m) >= 0.0:
        state.extreme_m = body_m
    elif abs(body_m - state.extreme_m) > config.threshold_m:
        state.direction = -state.direction
        state.extreme_m = body_m
    return handle_for(config, state, body_m)


@njit(cache=True)
def apply_ahead(
    config: BacklashParams,
    state: BacklashState,
    body_m: float,
    at_crossing_m: float,
    after_crossing_m: float,
    depth_m: float,
) -> float:
    """Return the handle insertion (m) as `apply` does, but start the crossing of the gap before a predicted reversal.

    The handle starts to cross when two conditions hold: one crossing time from now the requested body position is
    behind the present one (`state.body_m`), and the predicted motion back is longer than `depth_m`. The body does not
    move during the crossing. The crossing lies near the turning point of the motion, where this error is smallest.

    Args:
        config: width and slope of the backlash.
        state: direction and estimated body position.
        body_m: requested body position now (m), like the next two relative to home.
        at_crossing_m: requested body position about one crossing of the gap from now (m).
        after_crossing_m: requested body position a fixed time after that (m).
        depth_m: shortest motion back for which the gap is crossed (m).
    """
    back_at_crossing = state.direction * (state.body_m - at_crossing_m)
    back_most = max(back_at_crossing, state.direction * (state.body_m - after_crossing_m))
    back_now = state.direction * (state.body_m - body_m)
    if (back_at_crossing > 0.0 and back_most > depth_m) or back_now > max(depth_m, config.threshold_m):
        state.direction = -state.direction
    state.extreme_m = body_m
    return handle_for(config, state, body_m)


@njit(cache=True)
def roll(config: BacklashParams, body_rad: float) -> float:
    """Return the handle roll (rad) that turns the distal end to `body_rad` (rad): the inverse of the slope."""
    return body_rad / config.roll_slope


@njit(cache=True)
def distal_roll(config: BacklashParams, handle_rad: float) -> float:
    """Return the distal end's roll (rad) for a handle roll (rad)."""
    return handle_rad * config.roll_slope
