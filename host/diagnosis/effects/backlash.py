"""Backlash: the output follows only after a gap is taken up; of a loaded joint, the gap that its load crosses near zero."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import play

COARSE = 2e-3  # of the travel: least movement that counts, from which it is one of the reading's steps


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the width of the gap, in the motion's unit.

    A gap that is much smaller than the travel counts where the motion is smooth. Of a motion that is read in coarse steps,
    it would take single steps away.
    """
    low = s.tolerance if s.tolerance > COARSE * s.span else 1e-4 * s.span
    return (Parameter("width", s.unit, spread(max(low, 3e-4 * s.span), 0.6 * s.span, 14), low, 2.0 * s.span, log=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Play operator of half-width p[0] / 2."""
    return play(signal, 0.5 * p[0], c.start)


def crossed(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Width of the gap, in the deflection's unit, and the load at which three quarters of each half of it are crossed."""
    # a gap that closes over more of the range bends all of it: that is a curve of the spring, not a gap
    loads = spread(5e-3 * s.motion_span, 0.1 * s.motion_span, 5)
    return (
        Parameter("width", s.unit, (s.need,), linear=True),
        Parameter(
            "load", s.motion_unit, loads, 1e-3 * s.motion_span, 0.15 * s.motion_span, log=True, shape=True, vanishes=True
        ),
    )


def apply_crossed(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Deflection with half of the gap p[0] added on the side to which the load presses."""
    return np.asarray(signal + 0.5 * p[0] * np.tanh(c.motion / p[1]))


EFFECTS = (
    Effect(
        "backlash",
        "motion",
        40,
        parameters,
        "After every reversal the output does not move until the input has crossed a gap of {width}.",
        "y = play(x, width/2)",
        apply,
        family="dry",
        remembers=True,
    ),
    Effect(
        "backlash",
        "travel",
        10,
        parameters,
        "After every reversal the force does not change until the motion has crossed a gap of {width}.",
        "x = play(x, width/2)",
        apply,
        remembers=True,
    ),
    Effect(
        "backlash",
        "deflection",
        10,
        crossed,
        "Where the load changes its side, the joint crosses a gap of {width}; the gap is closed by a load of about {load}.",
        "y = x + width/2*tanh(F/load),  F the load behind friction",
        apply_crossed,
        side="output",
    ),
)
