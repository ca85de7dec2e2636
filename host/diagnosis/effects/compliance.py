"""Compliance: a deflection in proportion to load between two points, in phase with it."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, is_force


def per_load(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the compliance: deflection per load; none where the output is a force, which a spring does not deflect."""
    if is_force(s.unit):
        return ()
    return (Parameter("compliance", f"{s.unit}/{s.source_unit}", (s.need / s.source_rms,), linear=True),)


def spring(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the stiffness: force per deflection."""
    size = s.need / (0.5 * s.motion_span)
    return (Parameter("stiffness", f"{s.unit}/{s.motion_unit}", (size,), 0.0, np.inf, linear=True),)


def slots(p: Array, form: str) -> dict[str, float]:
    """Return what the force kernel takes: the stiffness of a spring between the moving part and a fixed place."""
    return {"spring": p[0]}


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The output gives way by p[0] load."""
    return np.asarray(signal + p[0] * c.load)


SAYS = "There is a spring between input and output: {source} deflects the output by {compliance}."
EFFECTS = (
    Effect("compliance", "motion", 70, per_load, SAYS, "y = x + compliance*load", apply, side="output", source="load"),
    Effect("compliance", "mix", 20, per_load, SAYS, "y = x + compliance*load", apply, source="load"),
    Effect(
        "compliance",
        "force",
        19,
        spring,
        "A spring of {stiffness} pulls towards one place.",
        "F = stiffness*x",
        slots=slots,
        forms=("spring",),
        of_law=True,
    ),
)
