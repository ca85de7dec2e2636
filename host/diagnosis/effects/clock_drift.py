"""One clock runs faster: a delay that grows with time."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from host.diagnosis.effects.latency import rows
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form
from host.diagnosis.model.operators import shift

SMOOTH = 0.5  # of the largest change from sample to sample, below which no change of it is a step or noise


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Rate of one clock against the other; form `set`: and the time at which both agree, at first a recording's middle."""
    size = s.dt_s / s.duration_s
    rates = tuple(sign * times * size for times in (0.04, 0.2, 1.0, 5.0) for sign in (-1.0, 1.0))
    rate = Parameter("rate", "s/s", rates, -0.05, 0.05, step=size)
    if form == "set":
        agree = Parameter("agree", "s", (0.5 * s.duration_s,), -s.duration_s, 2.0 * s.duration_s, step=0.1 * s.duration_s)
        return rate, agree
    return (rate,)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Delay the signal (n,) by p[0] t, or by p[0] (t - p[1]); on a spline where it runs smoothly, which a line flattens."""
    late = p[0] * (c.time_s - p[1] if form == "set" else c.time_s)
    steps = np.diff(signal)
    bend, most = np.max(np.abs(np.diff(steps)), initial=0.0), np.max(np.abs(steps), initial=0.0)
    if not bend < SMOOTH * most:  # nor where a part of a simulation gave no number
        return shift(signal, c.dt_s, late)
    return np.asarray(CubicSpline(c.time_s, signal)(np.clip(c.time_s - late, c.time_s[0], c.time_s[-1])))


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Every row of every pose later and later."""
    return {**run, **{name: rows(run[name], c, p[0] * c.time_s) for name in ("tip", "shaft", "tip_R", "shaft_R")}}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Every row of the force later and later."""
    return rows(signal, c, p[0] * c.time_s)


SAYS = "One clock runs faster: the delay grows by {rate}."
_DRIFTS = tuple(
    Effect("clock_drift", port, 62, parameters, SAYS, "y(t) = x(t - rate*t)", apply, timed=True, shifts="rate")
    for port in ("motion", "timing", "clock")
)
_SET = "One clock runs faster: the delay grows by {rate}; both agree at {agree}."
EFFECTS = (
    *_DRIFTS,
    *(in_form(each, "set", _SET, "y(t) = x(t - rate*(t - agree))") for each in _DRIFTS),
    Effect(
        "clock_drift",
        "pose",
        83,
        parameters,
        "The tracker's clock has a rate error: its delay grows by {rate}.",
        "y(t) = x(t - rate*t)",
        apply_pose,
        timed=True,
        shifts="rate",
    ),
    Effect(
        "clock_drift",
        "forces",
        83,
        parameters,
        "The force sensor's clock has a rate error: its delay grows by {rate}.",
        "y(t) = x(t - rate*t)",
        apply_force,
        timed=True,
        shifts="rate",
    ),
)
