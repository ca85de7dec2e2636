"""Rectified sensor: the reading has lost its sign."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Share of the sign that is lost (1: all of it). Below a half it is a difference of gain (`asymmetry`)."""
    return (Parameter("share", "", (1.0,), 0.5, 1.0, step=0.3),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Replace a share p[0] of the signal, or of every component, by its magnitude."""
    return np.asarray(signal + p[0] * (np.abs(signal) - signal))


def about_level(s: Scale, form: str) -> tuple[Parameter, ...]:
    """The same, and the reading about which the sign is lost: an offset behind the rectifier. Nothing reads below it."""
    level = Parameter("level", s.unit, (s.low,), s.low - 0.1 * s.span, s.low + 0.5 * s.span, step=1e-2 * s.span)
    return (*parameters(s, form), level)


def apply_about_level(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Replace a share p[0] of the signal's distance from p[1] by its magnitude."""
    return np.asarray(p[1] + apply(signal - p[1], c, p, form))


EFFECTS = (
    Effect(
        "rectified_sensor",
        "forces",
        90,
        parameters,
        "The force sensor gives magnitudes only.",
        "y = |x|",
        apply,
        natural_bounds=True,
        hides=True,
    ),
    Effect(
        "rectified_sensor",
        "drift",
        90,
        parameters,
        "The sensor gives the magnitude without the sign.",
        "y = |x|",
        apply,
        natural_bounds=True,
        hides=True,
    ),
    Effect(
        "rectified_sensor",
        "drift",
        91,
        about_level,
        "The sensor gives the distance from {level} without the sign.",
        "y = level + |x - level|",
        apply_about_level,
        forms=("level",),
        natural_bounds=True,
        hides=True,
    ),
)
