"""Softening: gain or stiffness changes with time."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Relative change of gain per second."""
    return (
        Parameter(
            "rate", "1/s", (s.need / (s.span * s.duration_s),), -10.0 / s.duration_s, 10.0 / s.duration_s, linear=True
        ),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Gain that grows in proportion to time, about the middle of the motion."""
    return np.asarray(signal + p[0] * c.time_s * signal)


def slots(p: Array, form: str) -> dict[str, float]:
    """Relative change of stiffness per second."""
    return {"softening": p[0]}


def apply_shape(state: dict, c: Context, p: Array, form: str) -> dict:
    """Bending compliance that grows in proportion to time."""
    return {**state, "flex": state["flex"] * np.maximum(1.0 + p[0] * c.time_s, 0.05)}


def fixed(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Relative change per second."""
    return (Parameter("rate", "1/s", (0.1 / s.duration_s,), -10.0 / s.duration_s, 10.0 / s.duration_s, linear=True),)


def apply_contact(law: dict, c: Context, p: Array, form: str) -> dict:
    """Tissue stiffness that changes in proportion to time."""
    return {**law, "stiffness": law["stiffness"] * np.maximum(1.0 + p[0] * c.time_s, 0.02)}


EFFECTS = (
    Effect(
        "softening",
        "shape",
        21,
        fixed,
        "The shaft's compliance grows by {rate} of itself as time goes on.",
        "1/EI = (1 + rate*t)/EI_0",
        apply_shape,
        timed=True,
    ),
    Effect(
        "softening",
        "contact",
        25,
        fixed,
        "The tissue's stiffness changes by {rate} of itself as time goes on.",
        "k = k_0 (1 + rate*t)",
        apply_contact,
        timed=True,
    ),
    Effect(
        "softening",
        "motion",
        20,
        parameters,
        "The gain changes by {rate} of itself as time goes on.",
        "y = x*(1 + rate*t)",
        apply,
        timed=True,
    ),
    Effect(
        "softening",
        "force",
        22,
        parameters,
        "The stiffness changes by {rate} of itself as time goes on.",
        "F = stiffness*rate*t*x",
        slots=slots,
        timed=True,
    ),
)
