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
    """

    slack_rad: float = 4.0 * DEGREE
    stop_rad: float = 84.0 * DEGREE
    curvature_at_stop_per_m: float = 45.0
    changeover_rad: float = 0.0
    centre_rad: float = 0.0
    wire_stiffness_N_per_m: float = math.inf
    calibrated_Nm2: float = 0.1902e-3


KNOB_PARAMETERS = np.dtype(
    [("slack", "f8"), ("stop", "f8"), ("gain", "f8"), ("changeover", "f8"), ("centre", "f8")], align=True
)
KNOB_STATE = np.dtype([("seated", "f8"), ("curvature", "f8")], align=True)


def parameters(config: KnobConfig, catheter: CatheterConfig) -> np.record:
    """`config` as the kernel's record; gain in 1/m per rad between slack and stop, for the stiffness of `catheter`."""
    p = np.zeros(1, KNOB_PARAMETERS).view(np.recarray)[0]
    p.slack, p.stop, p.centre = config.slack_rad, config.stop_rad, config.centre_rad
    p.gain = config.curvature_at_stop_per_m / (config.stop_rad - config.slack_rad) * _softer(config, catheter)
    p.changeover = config.changeover_rad
    return p


def _softer(config: KnobConfig, catheter: CatheterConfig) -> float:
    """Curvature over that at the calibrated stiffness: the wire's moment k_w e (path - e L kappa) balances EI kappa."""
    if math.isinf(config.wire_stiffness_N_per_m):
        return 1.0
    wire_Nm2 = config.wire_stiffness_N_per_m * catheter.wire_offset_m**2 * catheter.distal_length_m
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
    s.curvature = math.copysign(p.gain * max(0.0, size - p.slack), angle)
    return s.curvature
