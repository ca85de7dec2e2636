"""Second contact: the shaft touches something away from the tip."""

from __future__ import annotations

import numpy as np

from host.diagnosis.effect import Array, Context, Effect, Parameter, Scale


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Stiffness of the obstacle as felt at the tip, its clearance and direction across the axis."""
    return (
        Parameter("stiffness", "N/m", (20.0,), 0.0, 1e5, linear=True),
        Parameter("clearance", "m", (0.0, 0.004, 0.008, 0.012, 0.02), -0.05, 0.1, step=2e-3),
        Parameter("direction", "rad", tuple(np.arange(8) * np.pi / 4), -10.0, 10.0, step=0.2),
    )


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """Tip force back from an obstacle that the free tip would enter."""
    length = np.maximum(state["distal"] + state["insertion"], 1e-3)
    kappa = np.where(np.abs(state["kappa"]) < 1e-6, 1e-6, state["kappa"])
    side = (1.0 - np.cos(kappa * length)) / kappa
    across = np.vstack([side * np.sin(state["roll"]), -side * np.cos(state["roll"]), np.zeros_like(side)])
    way = np.array([np.cos(p[2]), np.sin(p[2]), 0.0])
    depth = np.maximum(way @ across - p[1], 0.0)
    return {**state, "extra": state["extra"] - p[0] * way[:, None] * depth}


EFFECTS = (
    Effect(
        "second_contact",
        "shape",
        32,
        parameters,
        "The shaft touches something away from the tip, beyond {clearance} sideways.",
        "F = -stiffness*max(0, n.x - clearance)*n",
        apply,
    ),
)
