"""Friction of the pull-wire in its sheath (thesis 8.1.1): the knob that bends the shaft in spite of it, and what it bends.

The tension of a wire that is pulled falls along every bend by the capstan's factor exp(-mu turning); of a wire that is let
go it rises by as much. Each cell of the distal shaft keeps its tension as long as that differs from its neighbour's by less
than the factor, so after a reversal the cells let go one after the other. The shaft bends by the mean tension of its cells.

Tensions are in 1/m: the curvature that they give. The path at the knob is taken up by the stretched wire and by the bend:
path = s tension at the knob + (1 - s) curvature, where s is `wire_share`. Without friction tension, path and curvature are
one number. `host.mechanics.constitutive` has the same law for the models, with loads.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control.declare import Floats
from realtime.control.inverse_kinematics import curvature_of_knob, knob_of_curvature
from realtime.control.records import WIRE_CELLS, KinematicsParams, WireParams, WireState

# The direction of bending turns when the requested curvature has come back by this share of the first cell's band. Less
# than that is noise, which must not send the knob through the band.
_REVERSAL = 0.1
_HALVINGS = 30
_FURTHEST = 8.0  # tension at the knob over that of the shaft: beyond it a wire is stuck


@njit(cache=True)
def _mean(kept: Floats, tension: float, first: float, other: float, keep: bool) -> float:
    """Return the mean tension of the cells with `tension` at the knob; `first`, `other`: the factors between cells."""
    total = 0.0
    for i in range(WIRE_CELLS):
        factor = first if i == 0 else other
        tension = min(max(kept[i], tension * factor), tension / factor)
        total += tension
        if keep:
            kept[i] = tension
    return total / WIRE_CELLS


@njit(cache=True)
def _factors(config: WireParams, curvature_per_m: float) -> tuple[float, float]:
    """Return the capstan's factors before the first cell, which has the body's bend before it, and between others."""
    turning = abs(curvature_per_m) * config.distal_length_m / WIRE_CELLS
    return math.exp(-config.friction * (config.turning_rad + 0.5 * turning)), math.exp(-config.friction * turning)


@njit(cache=True)
def _take_side(state: WireState, curvature_per_m: float) -> None:
    """Change to the other wire, which is slack, where the curvature changes its sign."""
    side = -1.0 if curvature_per_m < 0.0 else 1.0
    if side != state.side:
        state.side = side
        for i in range(WIRE_CELLS):
            state.tension[i] = 0.0


@njit(cache=True)
def start(kinematics: KinematicsParams, state: WireState, knob_rad: float) -> float:
    """Start with the shaft where `knob_rad` (rad) brings it without friction. Return that knob angle."""
    curvature = curvature_of_knob(kinematics, knob_rad)
    _take_side(state, curvature)
    state.curvature_per_m = state.extreme_per_m = curvature
    for i in range(WIRE_CELLS):
        state.tension[i] = abs(curvature)
    state.direction = 1.0
    return knob_rad


@njit(cache=True)
def follow(config: WireParams, kinematics: KinematicsParams, state: WireState, knob_rad: float) -> float:
    """Return the knob angle (rad) that would bend the shaft as `knob_rad` (rad) does, if the wire had no friction."""
    if config.friction <= 0.0 or config.wire_share <= 0.0:
        return knob_rad
    signed_path = curvature_of_knob(kinematics, knob_rad)
    _take_side(state, signed_path)
    path, share = abs(signed_path), config.wire_share
    first, other = _factors(config, state.curvature_per_m)
    low, high = 0.0, path / share
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if share * middle + (1.0 - share) * _mean(state.tension, middle, first, other, False) < path:
            low = middle
        else:
            high = middle
    state.curvature_per_m = state.side * _mean(state.tension, 0.5 * (low + high), first, other, True)
    return knob_of_curvature(kinematics, state.curvature_per_m)


@njit(cache=True)
def apply(config: WireParams, kinematics: KinematicsParams, state: WireState, knob_rad: float) -> float:
    """Return the knob angle (rad) that brings the shaft to where `knob_rad` (rad) would bring it without friction."""
    if config.friction <= 0.0 or config.wire_share <= 0.0:
        return knob_rad
    signed = curvature_of_knob(kinematics, knob_rad)
    first, other = _factors(config, signed)
    if state.direction * (signed - state.extreme_per_m) >= 0.0:
        state.extreme_per_m = signed
    elif abs(signed - state.extreme_per_m) > _REVERSAL * abs(signed) * (1.0 - first):
        state.direction = -state.direction
        state.extreme_per_m = signed
    _take_side(state, signed)
    wanted = abs(signed)
    # Between these two tensions at the knob the first cell, and so the shaft, stands.
    low, high = state.tension[0] / first, _FURTHEST * wanted
    if state.direction * state.side < 0.0:
        low, high = 0.0, state.tension[0] * first
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _mean(state.tension, middle, first, other, False) < wanted:
            low = middle
        else:
            high = middle
    path = config.wire_share * 0.5 * (low + high) + (1.0 - config.wire_share) * wanted
    return knob_of_curvature(kinematics, state.side * path)
