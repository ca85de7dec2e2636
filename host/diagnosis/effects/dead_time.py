"""Dead time with a second-order lag: one continuous form whose corners are delay, lag and resonance."""

from __future__ import annotations

import math

from host.diagnosis.effects.latency import LONGEST
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import delayed_second_order

CRITICAL = 1.0 / math.sqrt(2.0)  # damping ratio from which on no frequency is amplified
SHORT = 0.1  # of the dead time and lags together: a part below this is not named


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Dead time, and the coefficients of y' and y'': both passive, so neither is negative.

    Their start values: overdamped and rung, each with the dead time that leaves the phase at low frequencies alike.
    """
    longest = LONGEST * s.duration_s
    lags = spread(max(s.dt_s, 1e-3 * s.duration_s), max(0.03 * s.duration_s, 4.0 * s.dt_s), 4)
    delays = (0.5 * s.dt_s, *spread(2.0 * s.dt_s, max(0.1 * s.duration_s, 4.0 * s.dt_s), 4))
    squares = tuple(lag * lag for lag in spread(0.5 * s.dt_s, max(0.03 * s.duration_s, 4.0 * s.dt_s), 4))
    return (
        Parameter("delay", "s", delays, 0.0, longest, step=s.dt_s, dead_time=True),
        Parameter("lag", "s", lags, 0.0, 0.3 * s.duration_s, step=s.dt_s),
        Parameter("inertia", "s2", squares, 0.0, (0.2 * s.duration_s) ** 2, step=s.dt_s**2),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The signal as it was, through the lag."""
    return delayed_second_order(signal, c.dt_s, p[0], p[1], p[2], c.start, c.start_rate)


def corner(p: Array) -> tuple[str, str]:
    """The id that dead time, lag and inertia stand for, and the sentence for it.

    A response that overshoots and whose period is longer than the dead time is a resonance; else the longer of dead time
    and lag gives the name, since it makes most of the phase at low frequencies.
    """
    delay, lag, inertia = float(p[0]), float(p[1]), float(p[2])
    period = math.sqrt(max(inertia, 0.0))
    rings = lag < 2.0 * CRITICAL * period
    total = delay + max(lag, period)
    dead = "" if delay < SHORT * total else " It has a dead time of {delay}."
    coefficients = " Coefficients: lag {lag}, inertia {inertia}."
    if rings and period > delay:
        hertz, ratio = 1.0 / (2.0 * math.pi * period), lag / (2.0 * period)
        return "resonance", f"The output oscillates at {hertz:.3g} Hz, damping ratio {ratio:.2g}.{dead}"
    if delay > lag:
        if max(lag, period) < SHORT * total:
            return "latency", "The channel is delayed by {delay} at every frequency."
        return "latency", f"The channel is delayed by {{delay}} and follows with a second-order lag.{coefficients}"
    slow, fast = _time_constants(lag, inertia)
    if fast is None or fast < SHORT * slow:
        return "rate_lag", f"The output follows with a first-order lag of {slow:.3g} s.{dead}"
    return "rate_lag", f"The output follows with lags of {slow:.3g} s and {fast:.3g} s.{dead}"


def _time_constants(lag: float, inertia: float) -> tuple[float, float | None]:
    """Both time constants of an overdamped form, or its lag alone where they are a complex pair."""
    root = lag * lag - 4.0 * inertia
    if root < 0.0:
        return lag, None
    return 0.5 * (lag + math.sqrt(root)), 0.5 * (lag - math.sqrt(root))


EFFECTS = tuple(
    Effect(
        "rate_lag",
        port,
        62,
        parameters,
        "The output follows with a delay of {delay} and a second-order lag: lag {lag}, inertia {inertia}.",
        "inertia*y'' + lag*y' + y = x(t - delay)",
        apply,
        timed=True,
        forms=("dead_time",),
        contains=("latency", "rate_lag", "resonance"),
        corner=corner,
        spans=("latency", "rate_lag", "resonance"),
        remembers=True,
        begins_with_speed=True,
        shifts="time",
        invariant=True,
    )
    for port in ("motion", "timing")
)
