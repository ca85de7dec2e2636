"""One clock runs faster: a delay that grows with time."""

from __future__ import annotations

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.operators import shift



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Rate of one clock against the other."""
    size = s.dt_s / s.duration_s
    return (Parameter("rate", "s/s", (-5.0 * size, -size, size, 5.0 * size), -0.05, 0.05, step=size),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Delay p[0] t."""
    return shift(signal, c.dt_s, p[0] * c.time_s)


SAYS = "One clock runs faster: the delay grows by {rate}."
EFFECTS = tuple(
    Effect("clock_drift", port, 62, parameters, SAYS, "y(t) = x(t - rate*t)", apply, timed=True) for port in ("motion", "timing")
)
