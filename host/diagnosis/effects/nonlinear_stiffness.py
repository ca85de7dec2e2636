"""Nonlinear stiffness: a hardening or softening spring."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread



def per_load(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Compliance and its cubic part."""
    unit = f"{s.unit}/{s.source_unit}"
    return (Parameter("compliance", unit, (s.need / s.source_rms,), linear=True),
            Parameter("cubic", f"{unit}3", (s.need / s.source_rms**3,), linear=True))


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Cubic coefficient; second form: quadratic and cubic."""
    half = 0.5 * s.motion_span
    cubic = Parameter("cubic", f"{s.unit}/{s.motion_unit}3", (s.need / half**3,), linear=True)
    if form == "quadratic":
        return (Parameter("quadratic", f"{s.unit}/{s.motion_unit}2", (s.need / half**2,), linear=True), cubic)
    return (cubic,)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Deflection with a linear and a cubic part in the load."""
    return np.asarray(signal + p[0] * c.load + p[1] * c.load**3)


def slots(p: Array, form: str) -> dict[str, float]:
    """Coefficients of the square and cube of position."""
    return {"quadratic": p[0], "cubic": p[1]} if form == "quadratic" else {"cubic": p[0]}


EFFECTS = (
    Effect("nonlinear_stiffness", "motion", 71, per_load, "The spring between input and output is not linear in {source}.",
           "y = x + compliance*load + cubic*load^3", apply, side="output", source="load", contains=("compliance",)),
    Effect("nonlinear_stiffness", "force", 20, force, "The spring hardens or softens with deflection: cubic coefficient {cubic}.",
           "F = cubic*x^3", slots=slots, forms=("", "quadratic")),
)
