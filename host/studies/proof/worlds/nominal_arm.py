"""Nominal model of a two-link arm as a laboratory would write it: torques from angles, link data from the drawing."""

from __future__ import annotations

import numpy as np

Array = np.ndarray
G_m_per_s2 = 9.81


def _second(q: Array, dt_s: float) -> Array:
    """Return the second derivative (n,) by second differences; the end values stand for their neighbours."""
    inner = np.diff(q, 2) / dt_s**2
    return np.concatenate((inner[:1], inner, inner[-1:]))


def torques(inputs: dict[str, Array], parameters: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Return shoulder and elbow torque (n,) N m of a planar arm that hangs down at zero.

    Args:
        inputs: `shoulder_rad`, `elbow_rad`, (n,) each; the elbow's relative to the upper arm.
        parameters: mass_1, mass_2 (kg), inertia_1, inertia_2 about the centres (kg m2), length_1, centre_1, centre_2 (m),
            damping_1, damping_2 (N m s/rad).
        time_s: (n,) s, even.

    Source: Lagrange's equations of the double pendulum with a torque at each joint.
    """
    q1, q2 = inputs["shoulder_rad"], inputs["elbow_rad"]
    v1, v2 = (np.gradient(q, time_s, edge_order=2) for q in (q1, q2))
    a1, a2 = (_second(q, float(time_s[1] - time_s[0])) for q in (q1, q2))
    p = parameters
    h = p["mass_2"] * p["length_1"] * p["centre_2"]
    upper = p["inertia_1"] + p["mass_1"] * p["centre_1"] ** 2 + p["mass_2"] * p["length_1"] ** 2
    fore = p["inertia_2"] + p["mass_2"] * p["centre_2"] ** 2
    c, s = np.cos(q2), np.sin(q2)
    weight_2 = p["mass_2"] * p["centre_2"] * G_m_per_s2 * np.sin(q1 + q2)
    weight_1 = (p["mass_1"] * p["centre_1"] + p["mass_2"] * p["length_1"]) * G_m_per_s2 * np.sin(q1)
    elbow = (fore + h * c) * a1 + fore * a2 + h * s * v1**2 + weight_2 + p["damping_2"] * v2
    shoulder = (upper + fore + 2.0 * h * c) * a1 + (fore + h * c) * a2 - h * s * (2.0 * v1 * v2 + v2**2)
    shoulder = shoulder + weight_1 + weight_2 + p["damping_1"] * v1
    return {"shoulder_Nm": shoulder, "elbow_Nm": elbow}
