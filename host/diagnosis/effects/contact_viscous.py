"""Viscous contact: tissue force depends on rate or relaxes."""

from __future__ import annotations

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread


def damping(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Damping, constant or growing with depth."""
    unit = "s/m" if form == "crossley" else "N s/m"
    return (Parameter("damping", unit, (3.0, 20.0, 100.0), 1e-2, 1e4, log=True),)


def relaxation(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Share that relaxes, and time constant."""
    return (
        Parameter("relaxing_share", "", (0.2, 0.6), 1e-3, 20.0, log=True),
        Parameter("time_constant", "s", spread(0.1, 0.2 * s.duration_s, 4), 0.02, s.duration_s, log=True),
    )


def apply(law: dict, c: Context, p: Array, form: str) -> dict:
    """Adds damping, or a Maxwell branch."""
    if form == "relaxation":
        return {**law, "relax": float(p[0]), "relax_time": float(p[1])}
    return {**law, ("crossley" if form == "crossley" else "damping"): float(p[0])}


_DAMPED = Effect(
    "contact_viscous",
    "contact",
    21,
    damping,
    "The tissue has viscous damping: {damping}.",
    "F = k*depth + damping*rate",
    apply,
    timed=True,
)
EFFECTS = (
    _DAMPED,
    in_form(
        _DAMPED,
        "crossley",
        "The tissue has viscous damping that grows with depth: {damping}.",
        "F = k*depth*(1 + damping*rate)",
    ),
    Effect(
        "contact_viscous",
        "contact",
        22,
        relaxation,
        "The tissue's force relaxes with a time constant of {time_constant}.",
        "F = k*depth + branch that relaxes",
        apply,
        timed=True,
        forms=("relaxation",),
    ),
)
