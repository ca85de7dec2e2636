"""Sensor bias: a constant offset of a sensor, from the begin or from one instant on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.effects.missed_steps import begun_at, seeds, two_levels
from host.diagnosis.model.effect import Array, Context, Effect, Evidence, Parameter, Scale, in_form


def pose(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offsets of position along the base axes."""
    return tuple(Parameter(f"offset_{a}", "m", (1e-3,), linear=True) for a in "xyz")


def instant(s: Scale) -> Parameter:
    """Return the parameter `instant` (s) from which on there is an offset."""
    grid, edge = tuple(np.linspace(0.04, 0.96, 24) * s.duration_s), 0.01 * s.duration_s
    return Parameter("instant", "s", grid, edge, s.duration_s - edge, step=0.005 * s.duration_s, event=True)


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offsets of force along the base axes; second form: and the instant of the jump."""
    offsets = tuple(Parameter(f"offset_{a}", "N", (0.02,), linear=True) for a in "xyz")
    return (*offsets, instant(s)) if form == "jump" else offsets


def scalar(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Offset of one reading; second form: and the instant of the jump."""
    offset = Parameter("offset", s.unit, (s.need,), linear=True)
    return (offset, instant(s)) if form == "jump" else (offset,)


def force_seeds(evidence: Evidence, parameters: tuple[Parameter, ...], form: str) -> tuple[Parameter, ...]:
    """The instant at which two levels of each force fit the residuals best."""
    unit, count = parameters[0].unit, max(len(evidence.time_s), 1)
    each = len(evidence.readings) // count
    rows = [
        [
            one
            for one in evidence.readings[k * each : (k + 1) * each]
            if one.unit == unit and one.residual.size == time_s.size
        ]
        for k, time_s in enumerate(evidence.time_s)
    ]
    if not evidence.one_clock or len({len(own) for own in rows}) != 1 or not rows[0]:
        return parameters
    time_s = np.concatenate(evidence.time_s)
    levels = np.array([np.concatenate([own[k].residual / own[k].scale for own in rows]) for k in range(len(rows[0]))])
    order = np.argsort(time_s, kind="stable")
    *offsets, when = parameters
    return (*offsets, begun_at(when, time_s[order], two_levels(levels[:, order])))


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Shift the reading (n,) by p[0]; for the form `jump` after the instant p[1]."""
    return np.asarray(signal + (p[0] * c.after(p[1]) if form == "jump" else p[0]))


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """Both positions shifted; the tip sensor alone in form `tip`."""
    shift = p[:, None]
    return {**run, "tip": run["tip"] + shift, "shaft": run["shaft"] + (0.0 if form == "tip" else shift)}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Shift the force (3, n) by p[:3]; for the form `jump` after the instant p[3]."""
    return np.asarray(signal + (np.outer(p[:3], c.after(p[3])) if form == "jump" else p[:, None]))


_TRACKER = Effect(
    "sensor_bias",
    "pose",
    86,
    pose,
    "The tracker reads positions shifted by ({offset_x}, {offset_y}, {offset_z}).",
    "y = x + offset",
    apply_pose,
)
_JUMPS = "y = x + offset*(t > instant)"
_FORCE_SENSOR = Effect(
    "sensor_bias",
    "forces",
    86,
    force,
    "The force sensor reads ({offset_x}, {offset_y}, {offset_z}) too much.",
    "y = x + offset",
    apply_force,
)
_FORCE_JUMPS = in_form(
    _FORCE_SENSOR,
    "jump",
    "From {instant} on, the force sensor reads ({offset_x}, {offset_y}, {offset_z}) too much.",
    _JUMPS,
)
_TIP = "The tip sensor alone reads positions shifted by ({offset_x}, {offset_y}, {offset_z})."
EFFECTS = (
    _TRACKER,
    in_form(_TRACKER, "tip", _TIP, "y = x + offset"),
    _FORCE_SENSOR,
    replace(_FORCE_JUMPS, timed=True, at_rest=True, seeds=force_seeds),
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
        of_law=True,
        affine=True,
    ),
    Effect(
        "sensor_bias",
        "drift",
        79,
        scalar,
        "From {instant} on, the reading has an offset of {offset}.",
        _JUMPS,
        apply,
        timed=True,
        forms=("jump",),
        seeds=seeds,
        at_rest=True,
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
