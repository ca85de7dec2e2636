"""Sensor drift: a reading that wanders with time, whatever the motion."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Rate of the drift; second form: level and time constant of a warm-up."""
    if form == "warm_up":
        return (Parameter("level", s.unit, (s.need,), linear=True),
                Parameter("time_constant", "s", spread(0.05 * s.duration_s, 0.7 * s.duration_s, 3), 0.01 * s.duration_s, 3 * s.duration_s, log=True))
    return (Parameter("rate", f"{s.unit}/s", (s.need / s.duration_s,), linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Additive ramp, or exponential approach."""
    if form == "warm_up":
        return np.asarray(signal + p[0] * (1.0 - np.exp(-c.time_s / p[1])))
    return np.asarray(signal + p[0] * c.time_s)


EFFECTS = (
    Effect("sensor_drift", "drift", 80, parameters, "The reading drifts with time, whatever moves.", "y = x + rate*t", apply, timed=True,
           forms=("", "warm_up")),
)
