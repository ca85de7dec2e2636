"""Handle motion to catheter body motion: buckling play along the vessel, torsional windup about it.

Insertion: the shaft between handle and vessel bows out in its free gap (nearly no force) until it is either stretched or
bowed against its guide (stiff), while the vessel holds the body by friction. Play is what comes of that; its width on
slow motion is `play_width_m`, whatever the speed, and a push at the tip stronger than the friction moves the body back.
Roll: the shaft twists between the handle and a bed that resists turning, so only a share `roll_slope` arrives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True)
class VesselConfig:
    """The way from the handle to the sheath's exit (thesis 6.2.1, 6.2.2)."""

    home_insertion_m: float = -0.0890  # body insertion d when the insertion stage reads 0
    play_width_m: float = 0.0031
    insertion_slope: float = 1.0
    link_stiffness_N_per_m: float = 20000.0  # shaft stretched, or bowed against its guide
    slack_stiffness_N_per_m: float = 20.0  # shaft bowing freely
    friction_N: float = 1.0  # the vessel's hold on the body
    damping_N_s_per_m: float = 2.0
    roll_slope: float = 0.48
    windup_stiffness_Nm_per_rad: float = 6.0e-4  # GJ of the body over 0.9 m of vessel
    roll_lag_s: float = 0.003
    start_in_play: float = 0.0  # -1..1: body at the pulled flank, centred, at the pushed flank


VESSEL_PARAMETERS = np.dtype(
    [
        ("home_m", "f8"),
        ("gap_m", "f8"),
        ("slope", "f8"),
        ("link_stiffness", "f8"),
        ("slack_stiffness", "f8"),
        ("friction_N", "f8"),
        ("damping", "f8"),
        ("rigid", "i8"),
        ("windup", "f8"),
        ("bed", "f8"),
        ("roll_damping", "f8"),
    ],
    align=True,
)
VESSEL_STATE = np.dtype([("body_m", "f8"), ("roll_rad", "f8"), ("link_force_N", "f8")], align=True)


def parameters(config: VesselConfig) -> np.record:
    """`config` as the kernel's record. The free gap is what leaves `play_width_m` once friction has loaded the link."""
    p = np.zeros(1, VESSEL_PARAMETERS).view(np.recarray)[0]
    k, soft = config.link_stiffness_N_per_m, config.slack_stiffness_N_per_m
    p.home_m, p.slope = config.home_insertion_m, config.insertion_slope
    p.gap_m = max(0.0, (config.play_width_m - 2.0 * config.friction_N / k) / (1.0 - soft / k))
    p.rigid = int(config.play_width_m <= 0.0)
    p.link_stiffness, p.slack_stiffness = k, soft
    p.friction_N, p.damping = config.friction_N, config.damping_N_s_per_m
    p.windup = config.windup_stiffness_Nm_per_rad
    p.bed = p.windup * (1.0 / config.roll_slope - 1.0)
    p.roll_damping = config.roll_lag_s * (p.windup + p.bed)
    return p


def start(config: VesselConfig, handle_m: float, roll_rad: float) -> np.record:
    """State with the body at rest inside the backlash as `start_in_play` says, roll settled."""
    s = np.zeros(1, VESSEL_STATE).view(np.recarray)[0]
    side = min(1.0, max(-1.0, config.start_in_play))
    s.body_m = config.home_insertion_m + config.insertion_slope * handle_m - 0.5 * side * config.play_width_m
    s.roll_rad = config.roll_slope * roll_rad
    return s


@njit(cache=True)
def _link_shortening(load_N: float, drag: float, p) -> float:  # type: ignore[no-untyped-def]
    """Shortening y of the link that solves link(y) + drag*y = load, for the soft-in-the-gap, stiff-outside link."""
    half = 0.5 * p.gap_m
    inside = load_N / (p.slack_stiffness + drag)
    if abs(inside) <= half:
        return inside
    beyond = (abs(load_N) - (p.slack_stiffness + drag) * half) / (p.link_stiffness + drag)
    return math.copysign(half + beyond, load_N)


@njit(cache=True)
def push(p, s, handle_m: float, exit_force_N: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """Move the body with the handle. Backward Euler of drag * v = link(handle - body) + exit force - Coulomb friction.

    handle_m: stage reading (m); exit_force_N: axial force of the exposed catheter on the body (negative pushes it back).
    """
    wanted = p.home_m + p.slope * handle_m
    if p.rigid:
        s.body_m = wanted
        return
    drag = p.damping / dt_s
    free = drag * (wanted - s.body_m) - exit_force_N
    forward = wanted - _link_shortening(free + p.friction_N, drag, p)
    backward = wanted - _link_shortening(free - p.friction_N, drag, p)
    if forward > s.body_m:
        s.body_m = forward
    elif backward < s.body_m:
        s.body_m = backward
    shortening = wanted - s.body_m
    stiff = max(0.0, abs(shortening) - 0.5 * p.gap_m)
    soft = min(abs(shortening), 0.5 * p.gap_m)
    s.link_force_N = math.copysign(p.slack_stiffness * soft + p.link_stiffness * stiff, shortening)


@njit(cache=True)
def roll_compliance(p, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Turn of the body within one step by 1 Nm about the axis at the sheath's exit (rad/Nm)."""
    return 1.0 / (p.windup + p.bed + p.roll_damping / dt_s)


@njit(cache=True)
def free_roll(p, s, handle_rad: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Roll after one step without torque at the exit (rad); add roll_compliance * torque for the remainder."""
    return (p.windup * handle_rad + p.roll_damping / dt_s * s.roll_rad) * roll_compliance(p, dt_s)
