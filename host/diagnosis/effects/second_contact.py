"""Second contact: the shaft touches something away from the tip."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Stiffness of the obstacle, how far from the exit it stands along the axis, its clearance and direction across."""
    return (
        Parameter("stiffness", "N/m", (300.0,), 1.0, 1e5, log=True),
        Parameter("place", "m", (0.012, 0.024), 0.0, 0.2, step=2e-3),
        Parameter("clearance", "m", (0.0, 0.002, 0.005), -0.05, 0.1, step=1e-3),
        Parameter("direction", "rad", tuple(np.arange(8) * np.pi / 4), -10.0, 10.0, step=0.2),
    )


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """Force back from an obstacle that stands at the side of the axis, where the free shaft would enter it."""
    straight = np.maximum(state["insertion"], 0.0)
    length = np.maximum(state["distal"] + np.minimum(state["insertion"], 0.0), 1e-3)
    kappa = np.where(np.abs(state["kappa"]) < 1e-6, 1e-6, state["kappa"])
    beyond = np.maximum(p[1] - straight, 0.0)
    arc = np.arcsin(np.clip(kappa * beyond, -1.0, 1.0)) / kappa
    side = (1.0 - np.cos(kappa * arc)) / kappa
    way = np.array([np.cos(p[3]), np.sin(p[3]), 0.0])
    depth = side * (way[0] * np.sin(state["roll"]) - way[1] * np.cos(state["roll"])) - p[2]
    reached = (arc <= length) & (np.abs(kappa * beyond) < 1.0)
    at = straight + arc
    size = np.where(reached, np.maximum(depth, 0.0), 0.0) / (1.0 / p[0] + state["flex"] * at**3 / 3.0)
    return {**state, "point": state["point"] - way[:, None] * size, "point_at": at}


EFFECTS = (
    Effect(
        "second_contact",
        "shape",
        32,
        parameters,
        "The shaft touches something {place} from its exit, beyond {clearance} sideways.",
        "F(place) = -max(0, n.x(place) - clearance)/(1/stiffness + s^3/(3 EI))*n",
        apply,
    ),
)
