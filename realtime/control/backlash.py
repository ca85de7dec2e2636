"""Backlash of the insertion, both ways: its inverse (thesis 6.4.1; Tao and Kokotovic) and the body that is believed."""

from __future__ import annotations

from numba import njit

from realtime.control.records import BacklashParams, BacklashState

# A width learned in contact may differ from the rig file's by this much.
_FREEDOM_m = 0.001


@njit(cache=True)
def first_width(config: BacklashParams) -> float:
    """The width (m) believed at first: a play taken for too wide kicks the body at each reversal, too narrow does not."""
    return max(config.width_m - config.caution_m, 0.0)


@njit(cache=True)
def start(config: BacklashParams, state: BacklashState, body_m: float) -> None:
    """Take the gap as taken up forward at body insertion `body_m` (m, relative to home)."""
    state.direction = 1.0
    state.extreme_m = body_m
    state.body_m = body_m
    state.flank = 1.0
    state.width_m = first_width(config)


@njit(cache=True)
def follow(config: BacklashParams, state: BacklashState, handle_m: float) -> float:
    """Where the body is (m, relative to home) after the handle came to `handle_m`: the play operator."""
    half_m = 0.5 * state.width_m
    before_m = state.body_m
    state.body_m = min(max(before_m, (handle_m - half_m) * config.slope), (handle_m + half_m) * config.slope)
    if state.body_m != before_m:
        state.flank = 1.0 if state.body_m > before_m else -1.0
    return state.body_m


@njit(cache=True)
def narrow(config: BacklashParams, state: BacklashState, by_m: float) -> float:
    """Believe the play `by_m` narrower, at most _FREEDOM_m off what the rig file says; returns what was changed (m)."""
    least = max(config.width_m - _FREEDOM_m, 0.0)
    width_m = min(max(state.width_m - by_m, least), config.width_m + _FREEDOM_m)
    changed_m = state.width_m - width_m
    state.width_m = width_m
    return changed_m


@njit(cache=True)
def handle_for(config: BacklashParams, state: BacklashState, body_m: float) -> float:
    """The handle (m) on the flank of the present direction that puts the body at `body_m`; both relative to home."""
    return body_m / config.slope + 0.5 * state.direction * state.width_m


@njit(cache=True)
def apply(config: BacklashParams, state: BacklashState, body_m: float) -> float:
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
    return handle_for(config, state, body_m)


@njit(cache=True)
def apply_ahead(
    config: BacklashParams, state: BacklashState, body_m: float, soon_m: float, later_m: float, depth_m: float
) -> float:
    """As `apply`, with the reversal foreseen: the jump begins before the body has to turn.

    soon_m: where the body is to be about one crossing of the gap from now; later_m: some time after that. The handle
    starts across when by then the body would be wanted behind where it stands (`state.body_m`), and it is worth it:
    the way back is more than `depth_m`. The body stands meanwhile, near the turning point of the motion, where standing
    costs least.
    """
    back_soon = state.direction * (state.body_m - soon_m)
    back_most = max(back_soon, state.direction * (state.body_m - later_m))
    back_now = state.direction * (state.body_m - body_m)
    if (back_soon > 0.0 and back_most > depth_m) or back_now > max(depth_m, config.threshold_m):
        state.direction = -state.direction
    state.extreme_m = body_m
    return handle_for(config, state, body_m)


@njit(cache=True)
def roll(config: BacklashParams, body_rad: float) -> float:
    """The handle roll (rad) that turns the distal end to `body_rad` (rad): the slope's inverse."""
    return body_rad / config.roll_slope


@njit(cache=True)
def distal_roll(config: BacklashParams, handle_rad: float) -> float:
    """The distal end's roll (rad) for a handle roll (rad)."""
    return handle_rad * config.roll_slope
