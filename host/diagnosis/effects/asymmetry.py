"""Asymmetry: another gain or friction in one direction than in the other."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Relative difference of gain on the two sides of a centre."""
    inside = tuple(s.low + f * s.span for f in (0.5, 0.2, 0.35, 0.65, 0.8))
    centre = (0.0, *inside) if s.low < 0.0 < s.high else inside
    return (
        Parameter("ratio", "", (s.need / s.span,), -2.0, 2.0, linear=True),
        Parameter("centre", s.unit, centre, s.low, s.high, step=0.1 * s.span),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Half the difference of viscous friction between the directions."""
    return (Parameter("viscous_difference", f"{s.unit} s/{s.motion_unit}", (s.need / max(s.speed, 1e-300),), linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Gain 1 + ratio above the centre, 1 - ratio below."""
    return np.asarray(signal + p[0] * np.abs(signal - p[1]))


def slots(p: Array, form: str) -> dict[str, float]:
    """Return the coefficient of |v| for the force kernel."""
    return {"viscous_asymmetry": p[0]}


EFFECTS = (
    Effect(
        "asymmetry",
        "motion",
        32,
        parameters,
        "The gain differs by {ratio} on the two sides of {centre}.",
        "y = x + ratio*|x - centre|",
        apply,
        contains=("sensor_bias", "sensor_scale", "saturation"),  # centre at the edge of the motion; ratio of 1 or -1
    ),
    Effect(
        "asymmetry",
        "force",
        15,
        force,
        "Friction differs between the two directions: {viscous_difference}.",
        "F = viscous_difference*|v|",
        slots=slots,
        timed=True,
    ),
)
