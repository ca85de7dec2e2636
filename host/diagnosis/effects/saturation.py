"""Saturation: a limit beyond which nothing follows; of a signal, of a speed, or of a drive inside a loop."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import servo


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Limit above (or below), or one on each side, reached over a knee."""
    if form == "both":
        middle = tuple(s.low + f * s.span for f in (0.5, 0.4, 0.6, 0.3, 0.7))
        return (
            Parameter("middle", s.unit, middle, s.low, s.high, step=0.05 * s.span),
            Parameter(
                "limit", s.unit, tuple(f * s.span for f in (0.47, 0.42, 0.35, 0.25, 0.15)), 0.0, s.span, step=0.05 * s.span
            ),
            # a wider knee bends the whole range: that is a curve, not a limit
            Parameter("knee", s.unit, (0.005 * s.span, 0.03 * s.span), 1e-3 * s.span, 0.2 * s.span, log=True, shape=True),
        )
    share = (0.98, 0.93, 0.85, 0.75, 0.6, 0.4) if form == "upper" else (0.02, 0.07, 0.15, 0.25, 0.4, 0.6)
    return (Parameter("limit", s.unit, tuple(s.low + f * s.span for f in share), s.low, s.high, step=0.05 * s.span),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Clip the signal (n,) at the upper, the lower or both limits, as `form` says."""
    if form == "both":
        u = (signal - p[0]) / p[2]
        edge = p[1] / p[2]
        return np.asarray(p[0] - p[1] + p[2] * (np.logaddexp(0.0, u + edge) - np.logaddexp(0.0, u - edge)))
    return np.asarray(np.minimum(signal, p[0]) if form == "upper" else np.maximum(signal, p[0]))


def of_gradual(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `limit`, which the largest signal may come near or lie beyond."""
    top = max(abs(s.low), abs(s.high))
    return (Parameter("limit", s.unit, tuple(f * top for f in (0.7, 1.0, 1.5, 2.5)), 0.1 * top, 20.0 * top, log=True),)


def apply_gradual(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Signal (n,) that comes ever closer to p[0], at either side, and follows as it is near zero."""
    return np.asarray(p[0] * np.tanh(signal / p[0]))


def largest(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `limit`, the largest reading of either sign."""
    top = max(abs(s.low), abs(s.high))
    return (Parameter("limit", s.unit, tuple(f * top for f in (0.97, 0.85, 0.7, 0.5)), 0.05 * top, top, step=0.05 * top),)


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Clip every component of the force at p[0] (N)."""
    return np.asarray(np.clip(signal, -p[0], p[0]))


def of_loop(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Fastest motion, and the time constant with which it is approached."""
    speeds = tuple(f * s.speed for f in (0.4, 0.8, 1.2, 1.7, 2.4))
    longest = 0.1 * s.duration_s
    taus = spread(s.dt_s, max(0.3 * longest, 4.0 * s.dt_s), 4)
    return (
        Parameter("limit", f"{s.unit}/s", speeds, 0.02 * s.speed, 20.0 * s.speed, log=True),
        # a tenth of a sample is not a time constant: the limit of a speed alone, which is a form of its own right
        Parameter("time_constant", "s", taus, 0.1 * s.dt_s, max(longest, 5.0 * s.dt_s), log=True, vanishes=True),
    )


def apply_loop(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Output of a position loop whose speed is limited."""
    return servo(signal, c.dt_s, p[1], 0.0, p[0], c.start)


def of_drive(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `limit` of the drive."""
    top = max(abs(s.low), abs(s.high))
    return (
        Parameter("limit", s.unit, tuple(f * top for f in (0.97, 0.9, 0.75, 0.6, 0.4)), 0.05 * top, top, step=0.05 * top),
    )


def slots(p: Array, form: str) -> dict[str, float]:
    """Return the slot of the controller's output limit."""
    return {"drive_limit": p[0]}


SIDES = (
    ("upper", "The output does not follow above {limit}.", "y = min(x, limit)"),
    ("lower", "The output does not follow below {limit}.", "y = max(x, limit)"),
)
EFFECTS = (
    (
        Effect(
            "saturation",
            "motion",
            65,
            of_loop,
            "A position loop moves no faster than {limit}; below that it follows with a time constant of {time_constant}.",
            "dy/dt = clip((x - y)/time_constant, -limit, limit)",
            apply_loop,
            timed=True,
            forms=("loop",),
            contains=("rate_lag",),
            remembers=True,
            filters=True,
        ),
        Effect(
            "saturation",
            "loop",
            34,
            of_drive,
            "The output of the drive is limited to {limit}.",
            "u = clip(c, -limit, limit)  inside the loop",
            slots=slots,
            natural_bounds=True,
        ),
    )
    + tuple(
        Effect(
            "saturation",
            port,
            33,
            parameters,
            says,
            equation,
            apply,
            forms=(side,),
            natural_bounds=True,
        )
        for port in ("motion", "limit")
        for side, says, equation in SIDES
    )
    + tuple(
        Effect(
            "saturation",
            port,
            34,
            parameters,
            "The output does not follow beyond {limit} to either side of {middle}.",
            "y = clip(x, middle - limit, middle + limit), rounded over the knee",
            apply,
            forms=("both",),
            natural_bounds=True,
        )
        for port in ("motion", "limit")
    )
    + (
        # not of a motion: a curve between two motions is not known to have a limit
        Effect(
            "saturation",
            "limit",
            34,
            of_gradual,
            "The output follows ever less, up to {limit} at either side.",
            "y = limit*tanh(x/limit)",
            apply_gradual,
            forms=("gradual",),
            natural_bounds=True,
        ),
        Effect(
            "saturation",
            "forces",
            89,
            largest,
            "The force sensor does not read beyond {limit}.",
            "y = clip(x, -limit, limit)",
            apply_force,
            natural_bounds=True,
        ),
    )
)
