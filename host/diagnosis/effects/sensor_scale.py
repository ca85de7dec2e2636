"""Sensor scale: the gain of a sensor is off; seen where several channels disagree."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `gain_error`, relative."""
    return (Parameter("gain_error", "", (0.02,), -0.9, 3.0, linear=True),)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Positions of both sensors times 1 + p[0]."""
    return {**run, "tip": run["tip"] * (1.0 + p[0]), "shaft": run["shaft"] * (1.0 + p[0])}


def apply_force(force: Array, c: Context, p: Array, form: str) -> Array:
    """Scale the force (3, n) by 1 + p[0]."""
    return np.asarray(force * (1.0 + p[0]))


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Scale the reading (n,) by 1 + p[0]."""
    return np.asarray(signal * (1.0 + p[0]))


EFFECTS = (
    Effect(
        "sensor_scale",
        "pose",
        85,
        parameters,
        "The tracker reads lengths {gain_error} too large.",
        "y = x*(1 + gain_error)",
        apply_pose,
    ),
    Effect(
        "sensor_scale",
        "forces",
        85,
        parameters,
        "The force sensor reads {gain_error} too much.",
        "y = x*(1 + gain_error)",
        apply_force,
    ),
    Effect(
        "sensor_scale",
        "scale",
        28,
        parameters,
        "The gain is off by {gain_error}.",
        "y = x*(1 + gain_error)",
        apply,
        invariant=True,
        affine=True,
    ),
)
