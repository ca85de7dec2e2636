"""Softening: gain or stiffness changes with time or with the distance travelled."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, spread


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Relative change of gain per second, per distance (`travel`), or in all and its time constant (`run_in`)."""
    if form == "run_in":
        slowest = 0.6 * s.duration_s
        taus = spread(0.05 * s.duration_s, 0.4 * s.duration_s, 4)
        return (
            Parameter("change", "", (s.need / s.span,), -0.95, 10.0, linear=True),
            Parameter("time_constant", "s", taus, 0.01 * s.duration_s, slowest, log=True),
        )
    if form == "travel":
        path = max(s.speed * s.duration_s, s.span)
        return (Parameter("rate", f"1/{s.unit}", (s.need / (s.span * path),), -10.0 / path, 10.0 / path, linear=True),)
    return (
        Parameter(
            "rate", "1/s", (s.need / (s.span * s.duration_s),), -10.0 / s.duration_s, 10.0 / s.duration_s, linear=True
        ),
    )


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Gain that changes in proportion to time, to the distance travelled so far, or towards another one."""
    if form == "run_in":
        return np.asarray(signal * (1.0 + p[0] * (1.0 - np.exp(-c.time_s / p[1]))))
    if form == "travel":
        path = np.concatenate((np.zeros(1), np.cumsum(np.abs(np.diff(c.motion)))))
        return np.asarray(signal * (1.0 + p[0] * path))
    return np.asarray(signal + p[0] * c.time_s * signal)


def slots(p: Array, form: str) -> dict[str, float]:
    """Relative change of stiffness per second."""
    return {"softening": p[0]}


def apply_shape(state: dict, c: Context, p: Array, form: str) -> dict:
    """Bending compliance that grows in proportion to time."""
    return {**state, "flex": state["flex"] * np.maximum(1.0 + p[0] * c.time_s, 0.05)}


def fixed(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `rate`, relative change per second."""
    return (Parameter("rate", "1/s", (0.1 / s.duration_s,), -10.0 / s.duration_s, 10.0 / s.duration_s, linear=True),)


def apply_contact(law: dict, c: Context, p: Array, form: str) -> dict:
    """Tissue stiffness that changes in proportion to time."""
    return {**law, "stiffness": law["stiffness"] * np.maximum(1.0 + p[0] * c.time_s, 0.02)}


EFFECTS = (
    Effect(
        "softening",
        "shape",
        21,
        fixed,
        "The shaft's compliance grows over time, by {rate} of its value.",
        "1/EI = (1 + rate*t)/EI_0",
        apply_shape,
        timed=True,
    ),
    Effect(
        "softening",
        "contact",
        25,
        fixed,
        "The tissue's stiffness changes over time, by {rate} of its value.",
        "k = k_0 (1 + rate*t)",
        apply_contact,
        timed=True,
    ),
    Effect(
        "softening",
        "motion",
        20,
        parameters,
        "The gain changes over time, by {rate} of its value.",
        "y = x*(1 + rate*t)",
        apply,
        timed=True,
    ),
    Effect(
        "softening",
        "motion",
        20,
        parameters,
        "The gain changes with the distance travelled (wear), by {rate} of its value.",
        "y = x*(1 + rate*s),  ds = |dx|",
        apply,
        forms=("travel",),
    ),
    Effect(
        "softening",
        "motion",
        20,
        parameters,
        "The gain changes by {change} of its value with a time constant of {time_constant} (run-in).",
        "y = x*(1 + change*(1 - exp(-t/time_constant)))",
        apply,
        timed=True,
        forms=("run_in",),
    ),
    Effect(
        "softening",
        "force",
        22,
        parameters,
        "The stiffness changes over time, by {rate} of its value.",
        "F = stiffness*rate*t*x",
        slots=slots,
        timed=True,
    ),
)
