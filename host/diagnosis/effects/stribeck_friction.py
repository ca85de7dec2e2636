"""Stribeck friction: friction falls from its static value as speed grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import dahl


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Extra lost motion at rest, and the speed at which it has gone."""
    return (
        Parameter("kinetic", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
        Parameter("static_excess", s.unit, (s.need,), 0.0, np.inf, linear=True),
        Parameter("speed", f"{s.unit}/s", spread(0.1 * s.speed, 1.5 * s.speed, 3), 0.01 * s.speed, 10 * s.speed, log=True),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Kinetic force, excess of the static force, the Stribeck speed, and the distance over which the bristles yield; second
    form: and the speed below which friction grows with speed, as that of a lubricated or simulated contact.
    """
    unit = f"{s.motion_unit}/s"
    law = (
        Parameter("kinetic_force", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
        Parameter("static_excess", s.unit, (s.need,), 0.0, np.inf, linear=True),
        Parameter("speed", unit, spread(0.05 * s.speed, 1.0 * s.speed, 4), 0.005 * s.speed, 10 * s.speed, log=True),
    )
    if form == "smooth":
        rises = spread(5e-3 * s.speed, 0.1 * s.speed, 3)
        return (*law, Parameter("rising_speed", unit, rises, 5e-4 * s.speed, 0.5 * s.speed, log=True, vanishes=True))
    return (
        *law,
        Parameter(
            "distance",
            s.motion_unit,
            spread(2e-3 * s.motion_span, 0.05 * s.motion_span, 3),
            1e-5 * s.motion_span,
            s.motion_span,
            log=True,
            vanishes=True,
        ),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Lost motion that shrinks with speed."""
    level = p[0] + p[1] * np.exp(-((c.rate(c.motion) / p[2]) ** 2))
    return np.asarray(signal - level * dahl(c.motion, 2.0 * c.tolerance, 0.0))


def slots(p: Array, form: str) -> dict[str, float]:
    """Kinetic level, static excess, Stribeck speed, and the bristles' distance or the speed below which friction rises."""
    if form == "smooth":
        return {"smooth": p[0], "smooth_excess": p[1], "smooth_stribeck": p[2], "smooth_speed": p[3]}
    return {"coulomb": p[0], "static_excess": p[1], "stribeck_speed": p[2], "stribeck_distance": p[3]}


_WITH_BRISTLES = Effect(
    "stribeck_friction",
    "force",
    13,
    force,
    "Friction falls with speed: it is {kinetic_force} above a speed of {speed}, and {static_excess} more at rest.",
    "F = (kinetic + static_excess*exp(-(v/speed)^2))*z,  dz = (1 - z*sign(dx))*dx/distance",
    slots=slots,
    timed=True,
    contains=("coulomb_friction", "presliding_friction"),
    family="dry",
    remembers=True,
    dissipates=True,
)
_RISING = in_form(
    _WITH_BRISTLES,
    "smooth",
    "Friction falls with speed: it is {kinetic_force} above a speed of {speed}, and up to {static_excess} more below; it "
    "rises from zero to a speed of about {rising_speed}.",
    "F = (kinetic + static_excess*exp(-(v/speed)^2))*tanh(v/rising_speed)",
)
EFFECTS = (
    Effect(
        "stribeck_friction",
        "motion",
        48,
        lost,
        "The output lags most at low speed: by {static_excess} more at rest than at high speed.",
        "y = x - (kinetic + static_excess*exp(-(v/speed)^2))*sign(v)",
        apply,
        timed=True,
        contains=("coulomb_friction",),
        family="dry",
        remembers=True,
        dissipates=True,
    ),
    _WITH_BRISTLES,
    replace(_RISING, remembers=False, contains=("coulomb_friction",)),
)
