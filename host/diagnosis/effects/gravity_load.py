"""Gravity: weight of the shaft, a sensor or an arm; follows orientation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from host.diagnosis.effects.sensor_bias import apply as shifted
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form


def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Weight per exposed length along the base axes, and the further length whose weight the tip carries."""
    weights = tuple(Parameter(f"weight_{a}", "N/m", (0.05,), linear=True) for a in "xyz")
    return (*weights, Parameter("tip_length", "m", (0.0, 0.03), 0.0, 0.5, step=0.01))


def apply(state: dict, c: Context, p: Array, form: str) -> dict:
    """An even load on the exposed shaft, and a part of it at the tip."""
    even = np.ones(c.time_s.size) * p[:3, None]
    return {**state, "load": state["load"] + even, "extra": state["extra"] + p[3] * even}


def on_an_angle(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Moments of the weight at angles of a quarter turn and of zero; only where the motion is an angle.

    Form `constant`: the force itself, as of a weight on a slope.
    """
    if form == "constant":
        return (Parameter("force", s.unit, (s.need,), linear=True),)
    if s.motion_unit != "rad":
        return ()
    return tuple(Parameter(f"moment_{part}", s.unit, (s.need,), linear=True) for part in ("sine", "cosine"))


def slots(p: Array, form: str) -> dict[str, float]:
    """Moment of a weight that turns with the angle; form `constant`: a force that does not change."""
    if form == "constant":
        return {"constant": p[0]}
    return {"moment_sine": p[0], "moment_cosine": p[1]}


ADDED = (
    "A constant force of {} acts in addition to the recorded one, as of a weight. "
    "An offset of the force sensor does the same."
)


def added(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Return the parameter `force`, in the direction of one recorded component."""
    return (Parameter("force", s.unit, (s.need,), linear=True),)


LENGTHS_M = (0.1, 0.4)  # of links, tried first: those of arms on a bench
SHORTEST_M, LONGEST_M = 5e-3, 5.0
GRAVITY_M_PER_S2 = 9.81


def payload(links: int) -> Effect:
    """Return the effect of a mass at the end of a chain of `links` revolute joints with parallel axes.

    Each joint's angle is relative to the link before. The torques that the mass adds are those of its weight and its
    inertia (Lagrange's equations of a point mass).
    """

    def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
        size = s.need / (GRAVITY_M_PER_S2 * LENGTHS_M[-1])
        lengths = (Parameter(f"length_{k + 1}", "m", LENGTHS_M, SHORTEST_M, LONGEST_M, log=True) for k in range(links))
        quarters = tuple(0.5 * np.pi * k for k in range(4))
        zero = Parameter("zero_angle", "rad", quarters, -2.0 * np.pi, 2.0 * np.pi, step=0.1)
        return (Parameter("mass", "kg", (size,), 0.0, np.inf, linear=True, step=size), *lengths, zero)

    return Effect(
        "gravity_load",
        "chain",
        16,
        parameters,
        "An additional mass of {mass} is at the last link; its weight and inertia add to every joint's torque.",
        "torque_j = d/dt(dT/dq_j') - dT/dq_j + dV/dq_j of a point mass at the last link's end",
        payload_torques,
    )


def constant_load(loads: dict[str, str]) -> Effect:
    """Return the effect of a force that acts in addition to recorded ones and does not change: `COMPONENT` at each of them.

    loads: channel of each component -> its unit.
    """
    units = {f"added_{name.removesuffix('_' + unit.replace(' ', '_'))}": unit for name, unit in loads.items()}

    def parameters(s: Scale, form: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, unit, (s.need,), linear=True) for name, unit in units.items())

    vector = ", ".join(f"{{{name}}}" for name in units)
    return Effect(
        "gravity_load",
        "weight",
        26,
        parameters,
        ADDED.format(f"({vector})"),
        "F = recorded force + constant",
        at_rest=True,
    )


def payload_torques(moved: Array, c: Context | None, p: Array, form: str) -> Array:
    """Return the torques (links, n) that a mass at the chain's end needs.

    moved: (links, 3, n) angle, rate and acceleration of every joint, relative to the link before. p: mass, length of each
    link, and the absolute angle at which the first joint reads zero, from hanging down. Equation: with absolute angles th,
    tau_j = m sum_{k>=j} l_k (g sin th_k + sum_i l_i (cos(th_k - th_i) th_i'' + sin(th_k - th_i) th_i'^2)).
    """
    return _payload(np.ascontiguousarray(moved), p)


@njit(cache=True)
def _payload(moved: Array, p: Array) -> Array:
    """`payload_torques`; sines of the differences of two angles are made of those of the angles."""
    links, n = moved.shape[0], moved.shape[2]
    out = np.zeros((links, n))
    sine, cosine, rate, acceleration = np.empty(links), np.empty(links), np.empty(links), np.empty(links)
    for s in range(n):
        angle, first, second = p[1 + links], 0.0, 0.0
        for k in range(links):
            angle, first, second = angle + moved[k, 0, s], first + moved[k, 1, s], second + moved[k, 2, s]
            sine[k], cosine[k], rate[k], acceleration[k] = math.sin(angle), math.cos(angle), first, second
        total = 0.0
        for k in range(links - 1, -1, -1):
            pull = GRAVITY_M_PER_S2 * sine[k]
            for i in range(links):
                along = cosine[k] * cosine[i] + sine[k] * sine[i]
                across = sine[k] * cosine[i] - cosine[k] * sine[i]
                pull += p[1 + i] * (along * acceleration[i] + across * rate[i] * rate[i])
            total += p[0] * p[1 + k] * pull
            out[k, s] = total
    return out


_TURNING = Effect(
    "gravity_load",
    "force",
    15,
    on_an_angle,
    "A weight on an arm exerts a moment of {moment_sine} at a quarter turn and {moment_cosine} at zero.",
    "M = moment_sine*sin(x) + moment_cosine*cos(x)",
    slots=slots,
)
COMPONENT = Effect(
    "gravity_load",
    "added",
    26,
    added,
    ADDED.format("{force}"),
    "F = recorded force + force",
    shifted,
    forms=("added",),
    at_rest=True,
)
EFFECTS = (
    Effect(
        "gravity_load",
        "shape",
        30,
        parameters,
        "The shaft sags under its weight.",
        "dF/ds = weight,  F_tip = weight*tip_length",
        apply,
    ),
    _TURNING,
    replace(
        in_form(
            _TURNING,
            "constant",
            "A constant force of {force} acts against the positive direction, as of a weight or an offset of the input.",
            "F = force",
        ),
        of_law=True,
        order=80,  # after an offset of the reading, which does the same where a spring holds the axis
    ),
    COMPONENT,
)
