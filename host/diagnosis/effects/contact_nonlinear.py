"""Nonlinear contact: tissue force not linear in depth."""

from __future__ import annotations

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `exponent` of the depth."""
    return (Parameter("exponent", "", (0.7, 0.93, 1.07, 1.3, 1.7, 2.2), 0.3, 5.0, log=True),)


def apply(law: dict, c: Context, p: Array, form: str) -> dict:
    """Force k r (depth/r)^exponent, r = 1 mm."""
    return {**law, "exponent": float(p[0])}


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """One-sided spring: place, stiffness and exponent."""
    return (
        Parameter("stiffness", f"{s.unit}/{s.motion_unit}", (s.need / s.motion_span,), 0.0, float("inf"), linear=True),
        Parameter(
            "place",
            s.motion_unit,
            tuple(s.low + f * s.motion_span for f in (0.2, 0.4, 0.6, 0.8)),
            s.low,
            s.high,
            step=0.1 * s.motion_span,
        ),
        Parameter("exponent", "", (1.0, 1.5, 2.2), 0.5, 5.0, log=True),
    )


def slots(p: Array, form: str) -> dict[str, float]:
    """Return a one-sided power law for the force kernel."""
    return {"contact_stiffness": p[0], "contact_place": p[1], "contact_exponent": p[2]}


EFFECTS = (
    Effect(
        "contact_nonlinear",
        "contact",
        20,
        parameters,
        "The tissue's force grows with depth to the power {exponent}.",
        "F = k*r*(depth/r)^exponent, r = 1 mm",
        apply,
    ),
    Effect(
        "contact_nonlinear",
        "force",
        24,
        force,
        "A one-sided spring acts beyond {place}, with deflection to the power {exponent}.",
        "F = stiffness*max(0, x - place)^exponent",
        slots=slots,
    ),
)
