"""Viscous friction: force, or lost motion, in proportion to speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `lost_motion_per_speed` (s)."""
    return (Parameter("lost_motion_per_speed", "s", (s.need / max(s.speed, 1e-300),), 0.0, np.inf, linear=True),)


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Force per speed; quadratic form: force per speed squared."""
    power = 2 if form == "quadratic" else 1
    unit = f"{s.unit} s{power if power > 1 else ''}/{s.motion_unit}{power if power > 1 else ''}"
    size = s.need / max(s.speed, 1e-300) ** power
    return (Parameter("coefficient", unit, (size,), 0.0, np.inf, linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Apply a lag in proportion to the speed."""
    return np.asarray(signal - p[0] * c.rate(c.motion))


def slots(p: Array, form: str) -> dict[str, float]:
    """Coefficient of v, or of v |v|."""
    return {"drag" if form == "quadratic" else "viscous": p[0]}


_LINEAR = Effect(
    "viscous_friction",
    "force",
    14,
    force,
    "A force of {coefficient} times the speed acts against the motion.",
    "F = coefficient*v",
    slots=slots,
    timed=True,
    dissipates=True,
    of_law=True,
)
EFFECTS = (
    Effect(
        "viscous_friction",
        "motion",
        50,
        lost,
        "The output lags by {lost_motion_per_speed} times the speed.",
        "y = x - lost_motion_per_speed*v",
        apply,
        timed=True,
        dissipates=True,
        invariant=True,
    ),
    _LINEAR,
    replace(
        in_form(
            _LINEAR,
            "quadratic",
            "A drag of {coefficient} times the square of the speed acts against the motion.",
            "F = coefficient*v*|v|",
        ),
        extended=True,
        of_law=False,
    ),
)
