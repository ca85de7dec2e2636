"""Missed steps: a jump between command and encoder that stays."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale

EDGE = 0.01  # of the recording


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Size of the jump and its instant: neither at the first nor at the last samples, which no plateau bears out."""
    return (
        Parameter("jump", s.unit, (s.need,), linear=True),
        Parameter(
            "instant",
            "s",
            tuple(np.linspace(0.02, 0.98, 49) * s.duration_s),
            EDGE * s.duration_s,
            (1.0 - EDGE) * s.duration_s,
            step=0.005 * s.duration_s,
        ),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """A step at the instant, one sample wide."""
    return np.asarray(signal + p[0] * np.clip((c.time_s - p[1]) / c.dt_s + 0.5, 0.0, 1.0))


EFFECTS = (
    Effect(
        "missed_steps",
        "motion",
        10,
        parameters,
        "At {instant} the axis lost {jump} and never got it back.",
        "y = x + jump*(t > instant)",
        apply,
        timed=True,
    ),
)
