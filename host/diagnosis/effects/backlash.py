"""Backlash: the output follows only after a gap is taken up; it remembers the last reversal."""

from __future__ import annotations

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import play


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the width of the gap, in the motion's unit."""
    low = max(s.tolerance, 1e-4 * s.span)
    return (Parameter("width", s.unit, spread(max(low, 4e-3 * s.span), 0.6 * s.span, 10), low, 2.0 * s.span, log=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Play operator of half-width p[0] / 2."""
    return play(signal, 0.5 * p[0], c.start)


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
)
