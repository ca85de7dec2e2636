"""Sensor drift: a reading that drifts with time, independent of motion."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread


def warming(s: Scale) -> Parameter:
    """Return the parameter `time_constant` (s) of a warm-up."""
    d = s.duration_s
    return Parameter("time_constant", "s", spread(0.05 * d, 0.7 * d, 3), 0.01 * d, 3 * d, log=True)


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Rate of the drift; second form: level and time constant of a warm-up."""
    if form == "warm_up":
        return (
            Parameter("level", s.unit, (s.need,), linear=True),
            warming(s),
        )
    return (Parameter("rate", f"{s.unit}/s", (s.need / s.duration_s,), linear=True),)


def offset_and_rate(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offset at the first sample and rate of the drift."""
    return (Parameter("offset", s.unit, (s.need,), linear=True), *parameters(s, ""))


def apply_both(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Shift the reading (n,) by p[0] and add a ramp."""
    return np.asarray(signal + p[0] + p[1] * c.time_s)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Add a ramp, or an exponential approach for the form `warm_up`."""
    if form == "warm_up":
        return np.asarray(signal + p[0] * (1.0 - np.exp(-c.time_s / p[1])))
    return np.asarray(signal + p[0] * c.time_s)


def vector(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Rates along the base axes; second form: levels and time constant of a warm-up."""
    if form == "warm_up":
        level = tuple(Parameter(f"level_{a}", s.unit, (s.need,), linear=True) for a in "xyz")
        return (
            *level,
            warming(s),
        )
    return tuple(Parameter(f"rate_{a}", f"{s.unit}/s", (s.need / s.duration_s,), linear=True) for a in "xyz")


def _wander(c: Context, p: Array, form: str) -> Array:
    return np.outer(p[:3], 1.0 - np.exp(-c.time_s / p[3]) if form == "warm_up" else c.time_s)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Add the same drift to both positions."""
    wander = _wander(c, p, form)
    return {**run, "tip": run["tip"] + wander, "shaft": run["shaft"] + wander}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Add the drift to the force reading."""
    return np.asarray(signal + _wander(c, p, form))


WARMS_UP = "y = x + level*(1 - exp(-t/time_constant))"
_TRACKER = Effect(
    "sensor_drift",
    "pose",
    88,
    vector,
    "The tracker's positions drift with time, independent of motion.",
    "y = x + rate*t",
    apply_pose,
    timed=True,
    at_rest=True,
)
_FORCE_SENSOR = Effect(
    "sensor_drift",
    "forces",
    88,
    vector,
    "The force sensor drifts with time, independent of contact.",
    "y = x + rate*t",
    apply_force,
    timed=True,
    at_rest=True,
)
EFFECTS = (
    _TRACKER,
    in_form(
        _TRACKER,
        "warm_up",
        "The tracker's positions drift with a time constant of {time_constant}, independent of motion.",
        WARMS_UP,
    ),
    _FORCE_SENSOR,
    in_form(
        _FORCE_SENSOR,
        "warm_up",
        "The force sensor drifts with a time constant of {time_constant}, independent of contact.",
        WARMS_UP,
    ),
    Effect(
        "sensor_drift",
        "drift",
        80,
        parameters,
        "The reading drifts with time, independent of motion.",
        "y = x + rate*t",
        apply,
        timed=True,
        at_rest=True,
    ),
    Effect(
        "sensor_drift",
        "drift",
        80,
        parameters,
        "The reading drifts by {level} with a time constant of {time_constant}, independent of motion.",
        WARMS_UP,
        apply,
        timed=True,
        forms=("warm_up",),
        contains=("sensor_bias",),
        at_rest=True,
    ),
    Effect(
        "sensor_drift",
        "drift",
        80,
        offset_and_rate,
        "The reading has an offset of {offset} and drifts with time, independent of motion.",
        "y = x + offset + rate*t",
        apply_both,
        timed=True,
        forms=("offset",),
        contains=("sensor_bias",),
        at_rest=True,
        joins=(("sensor_bias", ""), ("sensor_drift", "")),  # of opposite sign, each of them hides the other
    ),
)
