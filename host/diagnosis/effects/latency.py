"""Pure delay of a channel."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.operators import shift



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Delay."""
    size = max(2.0 * s.dt_s, 1e-3 * s.duration_s)
    return (Parameter("delay", "s", (0.5 * s.dt_s, 2.0 * s.dt_s, 6.0 * s.dt_s, size), 0.0, 0.05 * s.duration_s, step=s.dt_s),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The signal as it was p[0] seconds earlier."""
    return shift(signal, c.dt_s, np.full(signal.size, p[0]))


SAYS = "The channel is {delay} late, at every frequency alike."
EFFECTS = tuple(
    Effect("latency", port, 61, parameters, SAYS, "y(t) = x(t - delay)", apply, timed=True) for port in ("motion", "timing")
)
