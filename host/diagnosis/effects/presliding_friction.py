"""Presliding friction: friction builds up over a distance after each reversal (Dahl; Maxwell slip as second form)."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effects.coulomb_friction import BRISTLES
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import dahl, maxwell_slip


def build_up(s: Scale, longest: float, count: int) -> Parameter:
    """Distance over which lost motion builds up: `count` starts up to `longest` of the span."""
    return Parameter(
        "distance", s.unit, spread(0.01 * s.span, longest * s.span, count), 1e-3 * s.span, 3.0 * s.span, log=True
    )


def yielding(s: Scale, count: int, first: float = 3e-3, least: float = 3e-4) -> Parameter:
    """Distance over which a friction force builds up: `count` starts from `first` of the span on, no less than `least`."""
    span = s.motion_span
    grid = spread(first * span, 0.3 * span, count)
    return Parameter("distance", s.motion_unit, grid, least * span, 3.0 * span, log=True)


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Lost motion when fully built up, and the distance over which that happens."""
    return (
        Parameter("lost_motion", s.unit, (s.need,), 0.0, np.inf, linear=True),
        build_up(s, 0.6, 5),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction force when fully built up, and the distance over which that happens."""
    return (
        Parameter("force", s.unit, (s.need,), 0.0, np.inf, linear=True),
        yielding(s, 6, 2.0 * BRISTLES, BRISTLES),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Lost motion p[0] times a friction state that builds up over p[1]."""
    start = -c.start / p[0] if p[0] > 0.0 else 0.0
    state = maxwell_slip if form == "maxwell" else dahl
    return np.asarray(signal - p[0] * state(c.motion, p[1], start))


def slots(p: Array, form: str) -> dict[str, float]:
    """Level and distance of the hysteretic force."""
    return {"presliding": p[0], "presliding_distance": p[1], "presliding_maxwell": float(form == "maxwell")}


EFFECTS = (
    Effect(
        "presliding_friction",
        "motion",
        46,
        lost,
        "The output stays behind by up to {lost_motion}, built up over {distance} after each reversal.",
        "y = x - lost_motion*z,  dz = (1 - z*sign(dx))*dx/distance",
        apply,
        forms=("dahl", "maxwell"),
        contains=("backlash", "coulomb_friction"),
        family="dry",
        remembers=True,
    ),
    Effect(
        "presliding_friction",
        "force",
        11,
        force,
        "Friction of {force} builds up over {distance} after each reversal.",
        "F = force*z,  dz = (1 - z*sign(dx))*dx/distance",
        slots=slots,
        forms=("dahl", "maxwell"),
        contains=("coulomb_friction",),
        family="dry",
        remembers=True,
    ),
)
