"""Gravity: weight of the shaft or a sensor; follows orientation."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Weight per exposed length along the base axes, and the length whose weight the tip carries besides."""
    weights = tuple(Parameter(f"weight_{a}", "N/m", (0.05,), linear=True) for a in "xyz")
    return (*weights, Parameter("tip_length", "m", (0.0, 0.03), 0.0, 0.5, step=0.01))


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """An even load on the exposed shaft, and a part of it at the tip."""
    even = np.ones(c.time_s.size) * p[:3, None]
    return {**state, "load": state["load"] + even, "extra": state["extra"] + p[3] * even}


EFFECTS = (
    Effect(
        "gravity_load",
        "shape",
        30,
        parameters,
        "The shaft sags under its weight.",
        "dF/ds = weight,  F_tip = weight*tip_length",
        apply,
    ),
)
