"""Gravity: weight of the shaft, a sensor or an arm; follows orientation."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Weight per exposed length along the base axes, and the further length whose weight the tip carries."""
    weights = tuple(Parameter(f"weight_{a}", "N/m", (0.05,), linear=True) for a in "xyz")
    return (*weights, Parameter("tip_length", "m", (0.0, 0.03), 0.0, 0.5, step=0.01))


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """An even load on the exposed shaft, and a part of it at the tip."""
    even = np.ones(c.time_s.size) * p[:3, None]
    return {**state, "load": state["load"] + even, "extra": state["extra"] + p[3] * even}


def on_an_angle(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Moments of the weight at angles of a quarter turn and of zero; only where the motion is an angle."""
    if s.motion_unit != "rad":
        return ()
    return tuple(Parameter(f"moment_{part}", s.unit, (s.need,), linear=True) for part in ("sine", "cosine"))


def slots(p: Array, form: str) -> dict[str, float]:
    """Moment of a weight that turns with the angle."""
    return {"moment_sine": p[0], "moment_cosine": p[1]}


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
    Effect(
        "gravity_load",
        "force",
        15,
        on_an_angle,
        "A weight on an arm pulls with {moment_sine} at a quarter turn and {moment_cosine} at zero.",
        "M = moment_sine*sin(x) + moment_cosine*cos(x)",
        slots=slots,
    ),
)
