"""Gravity: weight of the shaft or a sensor; follows orientation."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Weight per exposed length along the base axes."""
    return tuple(Parameter(f"weight_{a}", "N/m", (0.05,), linear=True) for a in "xyz")


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """Tip force that bends the shaft as its weight does: 3/8 of the weight, which grows with the exposed length."""
    exposed = np.maximum(state["distal"] + state["insertion"], 1e-3)
    return {**state, "extra": state["extra"] + 0.375 * p[:, None] * exposed}


EFFECTS = (
    Effect(
        "gravity_load",
        "shape",
        30,
        parameters,
        "The shaft sags under its weight.",
        "F_tip = 3/8 weight*exposed length",
        apply,
    ),
)
