"""Pure delay of a channel."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import shift, shifted_rows

LONGEST = 0.25  # of the recording
EARLIEST = 8.0  # samples by which a channel may come first; what comes earlier is found before (`clock_lead_samples`)


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Delay: no longer than leaves most of the recording to compare, and a lead of `EARLIEST` samples at most.

    No law answers an input that is yet to come, so a lead is never named. It is a matter of the recording: of clocks, of
    filters of the sensors, of an integrator that moves the place with the speed of the end of each step.
    """
    longest = LONGEST * s.duration_s
    delays = (0.05 * s.dt_s, 0.4 * s.dt_s, 2.0 * s.dt_s, *spread(6.0 * s.dt_s, max(0.5 * longest, 7.0 * s.dt_s), 7))
    leads = (-6.0 * s.dt_s, -2.5 * s.dt_s, -1.0 * s.dt_s, -0.4 * s.dt_s, -0.05 * s.dt_s)
    return (Parameter("delay", "s", (*leads, *delays), -EARLIEST * s.dt_s, longest, step=s.dt_s, dead_time=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The signal as it was p[0] seconds earlier."""
    return shift(signal, c.dt_s, np.full(signal.size, p[0]), c.start)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Every row of every pose late."""
    late = np.full(c.time_s.size, p[0])
    return {**run, **{name: rows(run[name], c, late) for name in ("tip", "shaft", "tip_R", "shaft_R")}}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Every row of the force late."""
    return rows(signal, c, np.full(c.time_s.size, p[0]))


def rows(values: Array, c: Context, late: Array) -> Array:
    """All rows of `values` (..., n) shifted by `late` (n,)."""
    return shifted_rows(values, c.dt_s, late)


SAYS = "The channel is delayed by {delay} at every frequency."
EFFECTS = tuple(
    Effect(
        "latency",
        port,
        61,
        parameters,
        SAYS,
        "y(t) = x(t - delay)",
        apply,
        timed=True,
        remembers=True,
        shifts="time",
        invariant=True,
    )
    for port in ("motion", "timing")
) + (
    Effect(
        "latency",
        "pose",
        82,
        parameters,
        "The tracker's poses are delayed by {delay}.",
        "y(t) = x(t - delay)",
        apply_pose,
        timed=True,
        shifts="time",
    ),
    Effect(
        "latency",
        "forces",
        82,
        parameters,
        "The force readings are delayed by {delay}.",
        "y(t) = x(t - delay)",
        apply_force,
        timed=True,
        shifts="time",
    ),
)
