"""Nonlinear stiffness: a hardening or softening spring."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, is_force


def per_load(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameters `compliance` and `cubic`; none where the output is a force, which no spring deflects."""
    if is_force(s.unit):
        return ()
    unit = f"{s.unit}/{s.source_unit}"
    return (
        Parameter("compliance", unit, (s.need / s.source_rms,), linear=True),
        Parameter("cubic", f"{unit}3", (s.need / s.source_rms**3,), linear=True),
    )


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


def bend(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Change of compliance with the size of the force."""
    return (Parameter("per_force_squared", "1/N2", (1.0,), linear=True),)


def apply_shape(state: dict, c: Context, p: Array, form: str) -> dict:
    """Deflection grows with the force by an extra cubic part."""
    return {**state, "push": state["push"] * (1.0 + p[0] * np.sum(state["push"] ** 2, axis=0))}


_SPRING = Effect(
    "nonlinear_stiffness",
    "force",
    20,
    force,
    "The spring hardens or softens with deflection: cubic coefficient {cubic}.",
    "F = cubic*x^3",
    slots=slots,
)
EFFECTS = (
    Effect(
        "nonlinear_stiffness",
        "shape",
        20,
        bend,
        "The shaft's deflection is not linear in the force.",
        "u = C F (1 + a F^2)",
        apply_shape,
    ),
    Effect(
        "nonlinear_stiffness",
        "motion",
        71,
        per_load,
        "The spring between input and output is not linear in {source}.",
        "y = x + compliance*load + cubic*load^3",
        apply,
        side="output",
        source="load",
        contains=("compliance",),
    ),
    _SPRING,
    in_form(
        _SPRING,
        "quadratic",
        "The spring hardens or softens with deflection, not alike in both directions: coefficients {quadratic} and {cubic}.",
        "F = quadratic*x^2 + cubic*x^3",
    ),
)
