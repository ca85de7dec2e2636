"""Sensor scale: the gain of a sensor is off; seen where several channels disagree."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale, spread



def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Relative error of gain."""
    return (Parameter("gain_error", "", (s.need / s.span,), -0.9, 3.0, linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Reading times 1 + p[0]."""
    return np.asarray(signal * (1.0 + p[0]))


EFFECTS = (Effect("sensor_scale", "vector", 85, parameters, "The sensor reads {gain_error} too much.", "y = x*(1 + gain_error)", apply),)
