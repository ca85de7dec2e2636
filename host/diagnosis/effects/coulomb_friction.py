"""Coulomb friction: a constant force against the motion; in a drive train without force, an offset against the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import play

BRISTLES = 2e-3  # of the travel: friction that builds up over less is dry friction, over more presliding


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `lost_motion`, the lag in either direction."""
    return (Parameter("lost_motion", s.unit, (s.need,), 0.0, np.inf, linear=True),)


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction force; second form: and the distance, far below the travel, over which what touches yields; third: and the
    speed below which friction grows with speed, as that of a lubricated or simulated contact; fourth: and the power by which
    it does so.
    """
    level = Parameter("force", s.unit, (s.need,), 0.0, np.inf, linear=True)
    if form == "":
        return (level,)
    if form == "smooth":
        return (level, rising(s))
    if form == "gradual":
        return (level, rising(s), Parameter("power", "", (1.8,), 0.5, 5.0, log=True))
    low, high = 1e-5 * s.motion_span, BRISTLES * s.motion_span
    return (level, Parameter("distance", s.motion_unit, spread(3.0 * low, 0.6 * high, 3), low, high, log=True))


def rising(s: Scale) -> Parameter:
    """Speed below which friction grows with speed."""
    tried = spread(0.02 * s.speed, 0.5 * s.speed, 3)
    return Parameter("speed", f"{s.motion_unit}/s", tried, 2e-3 * s.speed, s.speed, log=True, vanishes=True)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Apply a lag of p[0] against the direction of motion."""
    return np.asarray(signal - p[0] * c.moving(c.motion))


def held(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Load that friction takes up before anything deflects."""
    low = max(s.tolerance, 1e-4 * s.span)
    return (Parameter("friction", s.unit, spread(max(low, 4e-3 * s.span), 0.3 * s.span, 8), low, s.span, log=True),)


def apply_held(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Load behind friction: within p[0] of the load before it, and at rest until it has to move."""
    return play(signal, p[0], c.start)


def slots(p: Array, form: str) -> dict[str, float]:
    """Level of the sliding force, and the distance of its bristles or the speed at which it is nearly reached."""
    if form == "smooth":
        return {"smooth": p[0], "smooth_speed": p[1]}
    if form == "gradual":
        return {"smooth": p[0], "smooth_speed": p[1], "smooth_power": p[2]}
    return {"presliding": p[0], "presliding_distance": p[1]} if form == "bristles" else {"coulomb": p[0]}


_DRY = Effect(
    "coulomb_friction",
    "force",
    10,
    force,
    "A constant force of {force} acts against the motion.",
    "F = force*sign(v)",
    slots=slots,
    family="dry",
    remembers=True,
    dissipates=True,
)
_RISING = replace(
    in_form(
        _DRY,
        "smooth",
        "A force of up to {force} acts against the motion; below a speed of about {speed} it is smaller.",
        "F = force*tanh(v/speed)",
    ),
    timed=True,
    remembers=False,
    rounded=True,
)
EFFECTS = (
    Effect(
        "coulomb_friction",
        "motion",
        45,
        lost,
        "The output lags by {lost_motion}, against the motion, immediately after each reversal.",
        "y = x - lost_motion*sign(v)",
        apply,
        family="dry",
        remembers=True,
        dissipates=True,
    ),
    Effect(
        "coulomb_friction",
        "load",
        44,
        held,
        "Dry friction takes up to {friction} of the load: after each reversal nothing deflects until the load has changed "
        "by twice as much.",
        "|F - x| <= friction,  F standing between",
        apply_held,
        forms=("held",),
        family="dry",
        remembers=True,
        dissipates=True,
    ),
    _DRY,
    in_form(
        _DRY,
        "bristles",
        "A constant force of {force} acts against the motion; it builds up within {distance}, far below the travel.",
        "F = force*z,  dz = (1 - z*sign(dx))*dx/distance",
    ),
    _RISING,
    in_form(_RISING, "gradual", _RISING.says, "F = force*v/(speed^power + |v|^power)^(1/power)"),
)
