"""Sensor bias: a constant offset of a sensor."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form


def pose(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offsets of position along the base axes."""
    return tuple(Parameter(f"offset_{a}", "m", (1e-3,), linear=True) for a in "xyz")


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offsets of force along the base axes."""
    return tuple(Parameter(f"offset_{a}", "N", (0.02,), linear=True) for a in "xyz")


def scalar(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offset of one reading."""
    return (Parameter("offset", s.unit, (s.need,), linear=True),)


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Shift the reading (n,) by p[0]."""
    return np.asarray(signal + p[0])


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Both positions shifted; the tip sensor alone in form `tip`."""
    shift = p[:, None]
    return {**run, "tip": run["tip"] + shift, "shaft": run["shaft"] + (0.0 if form == "tip" else shift)}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Shift the force (3, n) by p (3,)."""
    return np.asarray(signal + p[:, None])


_TRACKER = Effect(
    "sensor_bias",
    "pose",
    86,
    pose,
    "The tracker reads positions shifted by ({offset_x}, {offset_y}, {offset_z}).",
    "y = x + offset",
    apply_pose,
)
_TIP = "The tip sensor alone reads positions shifted by ({offset_x}, {offset_y}, {offset_z})."
EFFECTS = (
    _TRACKER,
    in_form(_TRACKER, "tip", _TIP, "y = x + offset"),
    Effect(
        "sensor_bias",
        "forces",
        86,
        force,
        "The force sensor reads ({offset_x}, {offset_y}, {offset_z}) too much.",
        "y = x + offset",
        apply_force,
    ),
    Effect(
        "sensor_bias",
        "drift",
        78,
        scalar,
        "The reading has a constant offset of {offset}.",
        "y = x + offset",
        apply,
        at_rest=True,
        invariant=True,
        affine=True,
    ),
    # Not invariant: behind a plant that integrates it is a ramp.
    Effect(
        "sensor_bias",
        "shift",
        27,
        scalar,
        "What acts is the recorded input with a constant offset of {offset}.",
        "u = x + offset",
        apply,
        at_rest=True,
    ),
)
