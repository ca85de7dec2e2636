"""First-order lag."""

from __future__ import annotations

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.operators import lag



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Time constant."""
    return (Parameter("time_constant", "s", spread(0.5 * s.dt_s, 0.05 * s.duration_s, 6), 0.02 * s.dt_s, 0.3 * s.duration_s, log=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """First-order low pass."""
    return lag(signal, c.dt_s, p[0])


SAYS = "The output follows with a first-order lag of {time_constant}."
EFFECTS = tuple(
    Effect("rate_lag", port, 60, parameters, SAYS, "time_constant*dy/dt + y = x", apply, timed=True) for port in ("motion", "timing")
)
