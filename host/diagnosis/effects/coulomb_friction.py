"""Coulomb friction: a constant force against the motion; in a drive train without force, an offset against the motion."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Lost motion on either side."""
    return (Parameter("lost_motion", s.unit, (s.need,), 0.0, np.inf, linear=True),)


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction force."""
    return (Parameter("force", s.unit, (s.need,), 0.0, np.inf, linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The output stays behind by p[0], whichever way the motion goes."""
    return np.asarray(signal - p[0] * c.moving(c.motion))


def slots(p: Array, form: str) -> dict[str, float]:
    """Level of the sliding force."""
    return {"coulomb": p[0]}


EFFECTS = (
    Effect(
        "coulomb_friction",
        "motion",
        45,
        lost,
        "The output stays behind by {lost_motion}, against the motion, from the first step after a reversal.",
        "y = x - lost_motion*sign(v)",
        apply,
        family="dry",
    ),
    Effect(
        "coulomb_friction",
        "force",
        10,
        force,
        "A constant force of {force} acts against the motion.",
        "F = force*sign(v)",
        slots=slots,
        family="dry",
    ),
)
