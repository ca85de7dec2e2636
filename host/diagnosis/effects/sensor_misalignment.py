"""Sensor misalignment: axes of a sensor turned against the base frame."""

from __future__ import annotations

import numpy as np

from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Small turn about the base axes."""
    return tuple(Parameter(f"turn_{a}", "rad", (0.02,), -1.0, 1.0, step=0.02, linear=True) for a in "xyz")


def matrix(p: Array) -> Array:
    """Rotation by the vector p (3,)."""
    angle = float(np.sqrt(p @ p))
    K = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    a = np.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - np.cos(angle)) / angle**2 if angle > 1e-5 else 0.5
    return np.asarray(np.eye(3) + a * K + b * K @ K)


def apply_pose(run: dict, c: Context, p: Array, form: str) -> dict:
    """All poses turned about the base frame's origin; form `tip`: the tip sensor turned in its own frame."""
    R = matrix(p)
    if form == "tip":
        return {**run, "tip_R": np.einsum("abn,bc->acn", run["tip_R"], R)}
    turned = {name: R @ run[name] for name in ("tip", "shaft")}
    return {**run, **turned, **{f"{name}_R": np.einsum("ab,bcn->acn", R, run[f"{name}_R"]) for name in ("tip", "shaft")}}


def apply_force(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Rotate the force (3, n) by the rotation vector p (3,) in rad."""
    return np.asarray(matrix(p) @ signal)


SAYS = "The sensor's axes are turned by ({turn_x}, {turn_y}, {turn_z})."
_TRACKER = Effect("sensor_misalignment", "pose", 87, parameters, SAYS, "y = R x", apply_pose)
_TIP = "The tip sensor is turned in its own frame by ({turn_x}, {turn_y}, {turn_z})."
EFFECTS = (
    _TRACKER,
    in_form(_TRACKER, "tip", _TIP, "R_tip = R_tip R"),
    Effect("sensor_misalignment", "forces", 87, parameters, SAYS, "y = R x", apply_force),
)
