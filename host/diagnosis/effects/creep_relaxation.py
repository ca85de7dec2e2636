"""Creep: deflection or force continues to change while the input rests (standard linear solid)."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread
from host.diagnosis.model.operators import lag, lagged_rows


def taus(s: Scale) -> Parameter:
    """Time constant between a few samples and the whole recording."""
    return Parameter(
        "time_constant",
        "s",
        spread(max(10 * s.dt_s, 0.01 * s.duration_s), 0.3 * s.duration_s, 4),
        3 * s.dt_s,
        3 * s.duration_s,
        log=True,
    )


def of_motion(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Slow share of the motion and its time constant."""
    return (Parameter("slow_share", "", (min(s.need / s.span, 0.5),), 0.0, 1.0, linear=True), taus(s))


def of_load(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Slow deflection per load and its time constant."""
    return (Parameter("compliance", f"{s.unit}/{s.source_unit}", (s.need / s.source_rms,), linear=True), taus(s))


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Stiffness of the branch that relaxes, and its time constant."""
    return (
        Parameter(
            "stiffness",
            f"{s.unit}/{s.motion_unit}",
            (s.need / s.motion_span,),
            0.0,
            np.inf,
            linear=True,
            follows="stiffness",
        ),
        taus(s),
    )


def apply_motion(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Let a share p[0] of the motion follow with time constant p[1]."""
    start = c.start / p[0] if abs(p[0]) > 1e-3 else 0.0
    return np.asarray(signal + p[0] * (lag(signal, c.dt_s, p[1], start) - signal))


def apply_load(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Add p[0] times the load (n,) after a lag with time constant p[1]."""
    return np.asarray(signal + p[0] * lag(c.load, c.dt_s, p[1], c.start / p[0] if p[0] != 0.0 else 0.0))


def slots(p: Array, form: str) -> dict[str, float]:
    """Maxwell branch parallel to the spring."""
    return {"maxwell_stiffness": p[0], "maxwell_time": p[1]}


def share(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Slow deflection against the prompt one, and its time constant: a share of what is there, or as much again and more."""
    most = 1.0 if form != "force" else 5.0
    return (Parameter("slow_share", "", (0.2,), 0.0, most, linear=True), taus(s))


def apply_shape(state: dict, c: Context, p: Array, form: str) -> dict:
    """Let the shaft creep under force (`force`), or the bend follow the knob slowly (`bend`)."""
    if form == "bend":
        return {**state, "kappa": state["kappa"] + p[0] * (lagged_rows(state["kappa"], c.dt_s, p[1]) - state["kappa"])}
    slow = lagged_rows(state["push"], c.dt_s, p[1])
    return {**state, "push": state["push"] + p[0] * slow}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Let the reading continue to change after the force has settled."""
    return np.asarray(signal + p[0] * (lagged_rows(signal, c.dt_s, p[1]) - signal))


EFFECTS = (
    Effect(
        "creep_relaxation",
        "forces",
        84,
        share,
        "The force sensor's reading creeps: a share of {slow_share} has the time constant {time_constant}.",
        "y = x + slow_share*(lag(x, time_constant) - x)",
        apply_force,
        timed=True,
        several=True,
    ),
    Effect(
        "creep_relaxation",
        "shape",
        22,
        share,
        "Under force the shaft creeps with a time constant of {time_constant}.",
        "u = C (F + slow_share*lag(F, time_constant))",
        apply_shape,
        timed=True,
        forms=("force",),
        several=True,
    ),
    Effect(
        "creep_relaxation",
        "motion",
        55,
        of_motion,
        "A share of {slow_share} of the motion follows slowly, with a time constant of {time_constant}.",
        "y = x + slow_share*(lag(x, time_constant) - x)",
        apply_motion,
        timed=True,
        remembers=True,
        invariant=True,
        contains=("rate_lag",),
        several=True,
    ),
    Effect(
        "creep_relaxation",
        "motion",
        72,
        of_load,
        "Under {source} the output creeps with a time constant of {time_constant}.",
        "y = x + compliance*lag(load, time_constant)",
        apply_load,
        side="output",
        source="load",
        timed=True,
        remembers=True,
        several=True,
    ),
    Effect(
        "creep_relaxation",
        "force",
        21,
        force,
        "Part of the stiffness, {stiffness}, relaxes with a time constant of {time_constant}.",
        "F = stiffness*(x - lag(x, time_constant))",
        slots=slots,
        filters=True,
        timed=True,
        remembers=True,
        several=True,
    ),
)
