"""Dead zone: no output within a band around a point of the input; no memory."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Centre and half-width of the band."""
    inside = tuple(s.low + f * s.span for f in (0.15, 0.3, 0.5, 0.7, 0.85))
    centre = inside + ((0.0,) if s.low < 0.0 < s.high else ())
    narrow = min(max(2.0 * s.need, 2e-3 * s.span), 0.01 * s.span)
    widths = spread(narrow, 0.25 * s.span, 6)
    return (
        Parameter("centre", s.unit, centre, s.low, s.high, step=0.1 * s.span),
        Parameter("half_width", s.unit, widths, min(1e-3 * s.span, 0.2 * narrow), 0.5 * s.span, log=True),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The band is cut out and the two halves are joined."""
    return np.asarray(signal - np.clip(signal - p[0], -p[1], p[1]))


EFFECTS = tuple(
    Effect(
        "dead_zone",
        port,
        30,
        parameters,
        "Nothing happens within {half_width} of {centre}, whichever way it is entered.",
        "y = x - clip(x - centre, -half_width, half_width)",
        apply,
        natural_bounds=True,
    )
    for port in ("motion", "limit")
)
