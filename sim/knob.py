"""Knob angle to the curvature that the pull wires ask of the distal shaft, dead zones included (Fig. 6.8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from sim.catheter_chain import CatheterConfig

DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class KnobConfig:
    """A drum that pulls one wire or the other.

    Around zero both wires are slack for `slack_rad` either way. At `stop_rad` the pulled wire meets its stop (the coils of
    the shaft are shut): turning on only stretches the wire, and turning back first lets it go again before tension passes
    to the other wire. `changeover_rad` adds a reversal that the wire's friction hides, near the stops only.
    `wire_friction` is the coefficient between wire and sheath, `wire_turning_rad` the bend of the body on the wire's way; a
    wire of infinite stiffness sets the curvature whatever rubs.
    """

    slack_rad: float = 4.0 * DEGREE
    stop_rad: float = 84.0 * DEGREE
    curvature_at_stop_per_m: float = 45.0
    changeover_rad: float = 0.0
    centre_rad: float = 0.0
    wire_stiffness_N_per_m: float = math.inf
    calibrated_Nm2: float = 0.1902e-3
    wire_friction: float = 0.0
    wire_turning_rad: float = 0.0


WIRE_CELLS = 12  # of the distal shaft, each with a tension of its own
_HALVINGS = 50
KNOB_PARAMETERS = np.dtype(
    [
        ("slack", "f8"),
        ("stop", "f8"),
        ("gain", "f8"),
        ("changeover", "f8"),
        ("centre", "f8"),
        ("friction", "f8"),
        ("turning", "f8"),
        ("length", "f8"),
        ("wire_share", "f8"),  # of the path at the knob that stretches the wire, without friction
    ],
    align=True,
)
# tension: of each cell over what the stiffness of the shaft asks for 1/m; which wire: +1, -1.
KNOB_STATE = np.dtype([("seated", "f8"), ("curvature", "f8"), ("wire", "f8"), ("tension", "f8", (WIRE_CELLS,))], align=True)


def parameters(config: KnobConfig, catheter: CatheterConfig) -> np.record:
    """`config` as the kernel's record; gain in 1/m per rad between slack and stop, for the stiffness of `catheter`."""
    p = np.zeros(1, KNOB_PARAMETERS).view(np.recarray)[0]
    p.slack, p.stop, p.centre = config.slack_rad, config.stop_rad, config.centre_rad
    p.gain = config.curvature_at_stop_per_m / (config.stop_rad - config.slack_rad) * _softer(config, catheter)
    p.changeover = config.changeover_rad
    p.friction, p.turning, p.length = config.wire_friction, config.wire_turning_rad, catheter.distal_length_m
    shaft_Nm2, stretch_Nm2 = catheter.distal_Nm2[0], config.wire_stiffness_N_per_m * _wire_m3(catheter)
    p.wire_share = 0.0 if math.isinf(stretch_Nm2) else shaft_Nm2 / (shaft_Nm2 + stretch_Nm2)
    return p


def _wire_m3(catheter: CatheterConfig) -> float:
    return catheter.wire_offset_m**2 * catheter.distal_length_m


def _softer(config: KnobConfig, catheter: CatheterConfig) -> float:
    """Curvature over that at the calibrated stiffness: the wire's moment k_w e (path - e L kappa) balances EI kappa."""
    if math.isinf(config.wire_stiffness_N_per_m):
        return 1.0
    wire_Nm2 = config.wire_stiffness_N_per_m * _wire_m3(catheter)
    return (config.calibrated_Nm2 + wire_Nm2) / (catheter.distal_Nm2[0] + wire_Nm2)


def start() -> np.record:
    """State of wires that have not been pulled to a stop yet."""
    return np.zeros(1, KNOB_STATE).view(np.recarray)[0]


@njit(cache=True)
def pull(p, s, knob_rad: float) -> float:  # type: ignore[no-untyped-def]
    """Initial curvature of the distal shaft (1/m) for a knob angle (rad)."""
    angle = knob_rad - p.centre
    size = min(abs(angle), p.stop)
    if p.changeover > 0.0:
        if size >= p.stop:
            s.seated = math.copysign(1.0, angle)
        held = max(0.0, 1.0 - (p.stop - size) / (4.0 * p.changeover)) if angle * s.seated > 0.0 else 0.0
        if held <= 0.0:
            s.seated = 0.0
        size = min(p.stop, size + p.changeover * held)
    path = p.gain * max(0.0, size - p.slack)
    if p.friction > 0.0:
        path = _rub(p, s, path, math.copysign(1.0, angle))
    s.curvature = math.copysign(path, angle)
    return s.curvature


@njit(cache=True)
def _rub(p, s, path: float, wire: float) -> float:  # type: ignore[no-untyped-def]
    """Curvature (1/m) that the pulled wire gives where `path` (1/m) is what it would give without friction.

    The path at the knob is taken up by the stretched wire, in proportion to the tension at the knob, and by the bend:
    path = wire_share * tension + (1 - wire_share) * curvature. The curvature is the mean tension of the cells. Each cell
    keeps its tension as long as that differs from its neighbour's by less than the capstan's factor. The tension at the
    knob is found by halving.
    """
    if wire != s.wire:
        s.wire = wire
        s.tension[:] = 0.0
    first = math.exp(-p.friction * (p.turning + 0.5 * s.curvature * wire * p.length / WIRE_CELLS))
    other = math.exp(-p.friction * s.curvature * wire * p.length / WIRE_CELLS)
    low, high = 0.0, path / max(p.wire_share, 1e-6)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if p.wire_share * middle + (1.0 - p.wire_share) * _tensions(s.tension, middle, first, other, False) < path:
            low = middle
        else:
            high = middle
    return _tensions(s.tension, 0.5 * (low + high), first, other, True)


@njit(cache=True)
def _tensions(kept: np.ndarray, tension: float, first: float, other: float, keep: bool) -> float:
    """Mean tension of the cells with `tension` at the knob; first, other: capstan factors (at most 1) between cells."""
    total = 0.0
    for i in range(WIRE_CELLS):
        factor = first if i == 0 else other
        tension = min(max(kept[i], tension * factor), tension / factor)
        total += tension
        if keep:
            kept[i] = tension
    return total / WIRE_CELLS
