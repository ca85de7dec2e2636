"""Dead zone: no output within a band around a point of the input; or no motion of a position loop within an error."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import servo


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


def of_loop(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Error within which the loop rests, and its time constant."""
    widths = spread(max(0.3 * s.need, 2e-3 * s.span), max(3.0 * s.need, 4e-3 * s.span), 5)
    longest = 0.1 * s.duration_s
    taus = spread(s.dt_s, max(0.3 * longest, 4.0 * s.dt_s), 5)
    return (
        Parameter("half_width", s.unit, widths, 1e-4 * s.span, 0.5 * s.span, log=True),
        Parameter("time_constant", "s", taus, 0.1 * s.dt_s, max(longest, 5.0 * s.dt_s), log=True),
    )


def apply_loop(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Output of a position loop that does nothing while its error is small."""
    return servo(signal, c.dt_s, p[1], p[0], np.inf, c.start)


def of_drive(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Size of the controller's output below which nothing is driven."""
    widths = spread(0.02 * s.need + 1e-12, 2.0 * s.need + 1e-9, 5)
    return (Parameter("half_width", s.unit, widths, 1e-4 * s.need, 100.0 * s.need, log=True),)


def slots(p: Array, form: str) -> dict[str, float]:
    """Dead band of the controller's output."""
    return {"drive_dead_band": p[0]}


EFFECTS = (
    Effect(
        "dead_zone",
        "motion",
        64,
        of_loop,
        "A position loop rests while its error is below {half_width}; it follows with a time constant of {time_constant}.",
        "time_constant*dy/dt = e - clip(e, -half_width, half_width),  e = x - y",
        apply_loop,
        timed=True,
        forms=("loop",),
        contains=("rate_lag", "backlash"),
        remembers=True,
        filters=True,
    ),
    Effect(
        "dead_zone",
        "loop",
        30,
        of_drive,
        "The drive does not respond while the controller's output is below {half_width}.",
        "u = c - clip(c, -half_width, half_width)  inside the loop",
        slots=slots,
    ),
) + tuple(
    Effect(
        "dead_zone",
        port,
        30,
        parameters,
        "The output does not respond within {half_width} of {centre}, in either direction of motion.",
        "y = x - clip(x - centre, -half_width, half_width)",
        apply,
        natural_bounds=True,
    )
    for port in ("motion", "limit")
)
