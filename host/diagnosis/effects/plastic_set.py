"""Plastic set: the unloaded shape shifts after an overload and stays."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale
from host.diagnosis.model.operators import overload


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Yield level, and set per excess."""
    size = max(abs(s.low), abs(s.high))
    return (
        Parameter("set_per_excess", "", (s.need / size,), -1.0, 1.0, linear=True),
        Parameter("yield", s.unit, tuple(f * size for f in (0.5, 0.7, 0.85, 0.95)), 0.2 * size, size, step=0.1 * size),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Offset that grows with each excess beyond the yield level."""
    return np.asarray(signal + p[0] * overload(signal, p[1]))


def bend(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Yield curvature, and set per excess."""
    size = max(abs(s.low), abs(s.high))
    return (
        Parameter("set_per_excess", "", (0.1,), -1.0, 1.0, linear=True),
        Parameter(
            "yield_curvature", "1/m", tuple(f * size for f in (0.4, 0.6, 0.75, 0.9)), 0.1 * size, size, step=0.1 * size
        ),
    )


def apply_shape(state: dict, c: Context, p: Array, form: str) -> dict:
    """Rest curvature that shifts with each excess."""
    return {**state, "kappa": state["kappa"] + p[0] * overload(np.ascontiguousarray(state["kappa"]), p[1])}


EFFECTS = (
    Effect(
        "plastic_set",
        "shape",
        23,
        bend,
        "The shaft keeps {set_per_excess} of a bend in excess of {yield_curvature}.",
        "kappa = kappa + set*max excess so far",
        apply_shape,
    ),
    Effect(
        "plastic_set",
        "motion",
        57,
        parameters,
        "A motion beyond {yield} shifts the position at rest permanently, by {set_per_excess} of the excess.",
        "y = x + set_per_excess*max excess of |x| over yield so far",
        apply,
    ),
)
