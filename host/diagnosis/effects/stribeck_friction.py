"""Stribeck friction: friction falls from its static value as speed grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import dahl

SOONEST = 0.33  # of the Stribeck speed: friction that has not risen before does not fall


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Extra lost motion at rest, and the speed at which it has gone."""
    return (
        Parameter("kinetic", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
        Parameter("static_excess", s.unit, (s.need,), 0.0, np.inf, linear=True),
        Parameter("speed", f"{s.unit}/s", spread(0.1 * s.speed, 1.5 * s.speed, 3), 0.01 * s.speed, 10 * s.speed, log=True),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Kinetic force, excess of the static force, the Stribeck speed, and the distance over which the bristles yield; second
    form: kinetic force, half of the static one, and the Stribeck speed; third: as the first, with the share of that
    speed below which friction grows with speed, in the place of the distance.
    """
    if form == "smooth":
        tried = spread(0.3 * s.speed, 1.2 * s.speed, 3)
        return (
            Parameter("kinetic_force", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
            Parameter("static_excess", s.unit, (s.need,), 0.0, np.inf, linear=True),
            Parameter("speed", f"{s.motion_unit}/s", tried, 0.05 * s.speed, 10 * s.speed, log=True),
            Parameter("rise_share", "", (0.02, 0.1), 1e-3, SOONEST, log=True, vanishes=True),
        )
    if form == "double":
        # Beyond the recorded speeds, its fall is one of the damping.
        tried = spread(0.1 * s.speed, 0.7 * s.speed, 3)
        return (
            Parameter("kinetic_force", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
            Parameter("speed", f"{s.motion_unit}/s", tried, 0.05 * s.speed, s.speed, log=True),
        )
    return (
        Parameter("kinetic_force", s.unit, (0.7 * s.need,), 0.0, np.inf, linear=True),
        Parameter("static_excess", s.unit, (s.need,), 0.0, np.inf, linear=True),
        Parameter(
            "speed", f"{s.motion_unit}/s", spread(0.05 * s.speed, 1.0 * s.speed, 4), 0.005 * s.speed, 10 * s.speed, log=True
        ),
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
    """Kinetic level, static excess, Stribeck speed, and the bristles' distance; form `double` has none,
    form `smooth` the speed at which friction has risen.
    """
    if form == "double":
        return {"coulomb": p[0], "static_excess": p[0], "stribeck_speed": p[1]}
    if form == "smooth":
        return {"smooth": p[0], "smooth_excess": p[1], "smooth_stribeck": p[2], "smooth_speed": p[2] * p[3]}
    return {"coulomb": p[0], "static_excess": p[1], "stribeck_speed": p[2], "stribeck_distance": p[3]}


_FORCE = Effect(
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
    _FORCE,
    # Twice the friction at rest is plainly another law than Coulomb friction: this form does not contain it.
    replace(
        in_form(
            _FORCE,
            "double",
            "Friction falls with speed: it is {kinetic_force} above a speed of {speed}, and twice as much at rest.",
            "F = kinetic*(1 + exp(-(v/speed)^2))*sign(v)",
        ),
        contains=(),
    ),
    replace(
        in_form(
            _FORCE,
            "smooth",
            "Friction falls with speed: it is {kinetic_force} above a speed of {speed}, and up to {static_excess} more "
            "below it; below about {rise_share} of that speed it is smaller.",
            "F = (kinetic + static_excess*exp(-(v/speed)^2))*tanh(v/(rise_share*speed))",
        ),
        contains=("coulomb_friction",),
        remembers=False,
        rounded=True,
    ),
)
