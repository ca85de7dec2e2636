"""Field distortion: a position-dependent error of the tracker, as by metal nearby."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale

MIDDLE_M, REACH_M = np.array([0.0, 0.0, 0.03]), 0.03


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Error at the edge of the workspace, along each axis, for each second-order term of place (and orientation in
    proportion).
    """
    return tuple(
        Parameter(f"{a}_{term}", "m", (1e-3,), linear=True) for a in "xyz" for term in ("xx", "yy", "zz", "xy", "xz", "yz")
    )


def bump(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameters of the pull towards a metal part: strength along each axis, place and reach."""
    pull = tuple(Parameter(f"pull_{a}", "m", (1e-3,), linear=True) for a in "xyz")
    return (
        *pull,
        Parameter("place_x", "m", (-0.02, 0.0, 0.02), -0.1, 0.1, step=0.01),
        Parameter("place_y", "m", (-0.03, 0.0, 0.03), -0.1, 0.1, step=0.01),
        Parameter("place_z", "m", (0.02, 0.045), -0.05, 0.15, step=0.01),
        Parameter("reach", "m", (0.015, 0.03), 0.005, 0.2, log=True),
    )


def field(x: Array, p: Array) -> Array:
    """Displacement (3, n) at places x (3, n)."""
    u = (x - MIDDLE_M[:, None]) / REACH_M
    terms = np.vstack([u[0] ** 2, u[1] ** 2, u[2] ** 2, u[0] * u[1], u[0] * u[2], u[1] * u[2]])
    return np.asarray(p.reshape(3, 6) @ terms)


def apply(run: dict, c: Context, p: Array, form: str) -> dict:
    """Both sensors read places displaced by the field."""
    if form == "bump":
        place = np.array(p[3:6])[:, None]

        def shift(x: Array) -> Array:
            return np.asarray(p[:3, None] * np.exp(-0.5 * np.sum((x - place) ** 2, axis=0) / p[6] ** 2))

        return {**run, "tip": run["tip"] + shift(run["tip"]), "shaft": run["shaft"] + shift(run["shaft"])}
    return {**run, "tip": run["tip"] + field(run["tip"], p), "shaft": run["shaft"] + field(run["shaft"], p)}


EFFECTS = (
    Effect(
        "field_distortion",
        "pose",
        84,
        parameters,
        "The tracker's error depends on the position: metal nearby distorts its field.",
        "y = x + B(x)",
        apply,
    ),
    Effect(
        "field_distortion",
        "pose",
        84,
        bump,
        "The tracker's error depends on the position: metal nearby distorts its field.",
        "y = x + pull*exp(-|x - place|^2/(2 reach^2))",
        apply,
        forms=("bump",),
    ),
)
