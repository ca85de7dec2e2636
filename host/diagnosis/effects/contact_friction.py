"""Contact friction: tangential stick and slip on tissue, within a cone."""

from __future__ import annotations

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Coefficient of friction, and the distance of its build-up."""
    return (
        Parameter("coefficient", "", (0.1,), 0.0, 3.0, linear=True),
        Parameter("distance", "m", (2e-4, 1e-3, 4e-3), 1e-5, 0.05, log=True),
    )


def apply(law: dict, c: Context, p: Array, form: str) -> dict:
    """Tangential force up to p[0] times the normal force, dragged along by the tip."""
    return {**law, "friction": float(p[0]), "friction_distance": float(p[1])}


EFFECTS = (
    Effect(
        "contact_friction",
        "contact",
        23,
        parameters,
        "Friction acts between tip and tissue, up to {coefficient} of the normal force.",
        "|F_t| <= coefficient*F_n",
        apply,
        dissipates=True,
    ),
)
