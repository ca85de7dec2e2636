"""Coupling: another channel moves this one."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `gain` from the other channel."""
    return (
        Parameter(
            "gain", f"{s.unit}/{s.source_unit}" if s.unit != s.source_unit else "", (s.need / s.source_rms,), linear=True
        ),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Adds p[0] times the other channel."""
    return np.asarray(signal + p[0] * c.load)


EFFECTS = (
    Effect(
        "coupling",
        "motion",
        73,
        parameters,
        "{source} also moves this channel, with gain {gain}.",
        "y = x + gain*other",
        apply,
        source="other",
    ),
    Effect(
        "coupling",
        "mix",
        21,
        parameters,
        "{source} also changes this reading, with gain {gain}.",
        "y = x + gain*other",
        apply,
        source="other",
    ),
)
