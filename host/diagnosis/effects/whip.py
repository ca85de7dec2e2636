"""Whip: the output turns unevenly, once a turn: a pre-curved shaft in a curved vessel, or a disk or gear off its centre."""

from __future__ import annotations

import math

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale
from host.diagnosis.model.operators import whip

LEAST = 1e-6  # rad, amplitude: below what encoders resolve


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Amplitude and phase; none where the axis does not turn by more than a radian."""
    if s.span < 1.0:
        return ()
    small = (math.sqrt(2.0) * s.need,) if LEAST < s.need < 0.05 else ()  # a disk off its centre: the mismatch is the sine
    return (
        Parameter("amplitude", "rad", (*small, 0.1, 0.4, 0.9, 1.5), LEAST, 6.0, log=True),
        Parameter("phase", "rad", tuple(np.arange(8) * np.pi / 4), -20.0, 20.0, step=0.3),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Solution of y + A sin(y + phase) = x on the branch that is followed; form `weak`: x + A sin(x + phase)."""
    if form == "weak":
        return np.asarray(signal + p[0] * np.sin(signal + p[1]))
    return whip(signal, p[0], p[1])


def apply_weak(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Return x + A sin(x + phase) for the roll angle x (n,) in rad."""
    return apply(signal, c, p, "weak")


SAYS = "The output turns unevenly, once a turn of the input: amplitude {amplitude}."
EFFECTS = (
    Effect("whip", "turn", 42, parameters, SAYS, "y + amplitude*sin(y + phase) = x", apply),
    Effect("whip", "turn", 42, parameters, SAYS, "y = x + amplitude*sin(x + phase)", apply, forms=("weak",)),
    Effect(
        "whip",
        "turn",
        74,
        parameters,
        SAYS,
        "y + amplitude*sin(y + phase) = x, behind the gain",
        apply,
        side="output",
        forms=("tip",),
    ),
    Effect(
        "whip",
        "turn",
        74,
        parameters,
        SAYS,
        "y = x + amplitude*sin(x + phase), behind the gain",
        apply_weak,
        side="output",
        forms=("tip weak",),
    ),
)
