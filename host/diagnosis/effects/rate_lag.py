"""First-order lag: the output follows the input with a time constant."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import digital_lag, lag, lagged_rows

FASTEST = 2.0  # samples: a digital filter with a shorter time constant delays by a part of a sample, and little else


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the time constant of the low pass (s)."""
    if form == "digital":
        least = FASTEST * s.dt_s
        times = spread(2.0 * least, max(0.05 * s.duration_s, 4.0 * least), 5)
        return (Parameter("time_constant", "s", times, least, max(0.3 * s.duration_s, 8.0 * least), log=True),)
    times = (0.1 * s.dt_s, *spread(0.5 * s.dt_s, 0.05 * s.duration_s, 6))
    return (Parameter("time_constant", "s", times, 0.02 * s.dt_s, 0.3 * s.duration_s, log=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Pass the signal (n,) through a first-order low pass of time constant p[0] (s); form `digital`: once a sample."""
    if form == "digital":
        return np.repeat(digital_lag(signal[:: c.points], c.dt_s * c.points, p[0], c.start), c.points)
    return lag(signal, c.dt_s, p[0], c.start)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Every row of every pose through the low pass; form `positions`: turns are read promptly."""
    names = ("tip", "shaft") if form == "positions" else ("tip", "shaft", "tip_R", "shaft_R")
    return {**run, **{name: rows(run[name], c, p[0]) for name in names}}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Every row of the force through the low pass."""
    return rows(signal, c, p[0])


def rows(values: Array, c: Context, time_constant_s: float) -> Array:
    """All rows of `values` (..., n) through the low pass."""
    return lagged_rows(values, c.dt_s, time_constant_s)


SAYS = "The output follows with a first-order lag of {time_constant}."
_TRACKER = Effect(
    "rate_lag",
    "pose",
    81,
    parameters,
    "The tracker follows with a lag of {time_constant}.",
    "time_constant*dy/dt + y = x",
    apply_pose,
    timed=True,
    shifts="time",
)
_LAGS = tuple(
    Effect(
        "rate_lag",
        port,
        60,
        parameters,
        SAYS,
        "time_constant*dy/dt + y = x",
        apply,
        timed=True,
        remembers=True,
        shifts="time",
        invariant=True,
    )
    for port in ("motion", "timing")
)
_DIGITAL = "y[k] = y[k-1] + (1 - exp(-period/time_constant))*(x[k] - y[k-1])"
EFFECTS = (
    *_LAGS,
    *(
        in_form(each, "digital", "The samples pass a digital low pass of first order, {time_constant}.", _DIGITAL)
        for each in _LAGS
    ),
    _TRACKER,
    in_form(
        _TRACKER,
        "positions",
        "The tracker's positions follow with a lag of {time_constant}, its orientations at once.",
        "time_constant*dy/dt + y = x",
    ),
    Effect(
        "rate_lag",
        "forces",
        81,
        parameters,
        "The force sensor follows with a lag of {time_constant}.",
        "time_constant*dy/dt + y = x",
        apply_force,
        timed=True,
        shifts="time",
    ),
)
