"""Friction that grows with a load (capstan): hysteresis whose height follows |load|."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.effects.coulomb_friction import held, rising
from host.diagnosis.effects.presliding_friction import build_up, yielding
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form
from host.diagnosis.model.operators import capstan, dahl, pressed

LARGEST_SHARE = 0.7  # of the force of a spring that the friction it presses takes


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Lost motion per load, and the distance of its build-up."""
    return (
        Parameter("coefficient", f"{s.unit}/{s.source_unit}", (s.need / s.source_rms,), 0.0, np.inf, linear=True),
        replace(build_up(s, form, 4), vanishes=True),
    )


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction per load, and the distance of its build-up; second form: the speed below which it grows with speed."""
    unit = "" if s.unit == s.source_unit else f"{s.unit}/{s.source_unit}"
    coefficient = Parameter("coefficient", unit, (s.need / s.source_rms,), 0.0, np.inf, linear=True)
    return coefficient, rising(s) if form == "smooth" else replace(yielding(s, form, 5), vanishes=True)


def by_spring(s: Scale, form: str) -> tuple[Parameter, ...]:
    """The same with the force of the spring, which is not recorded, and the force of which it is counted.

    A spring that presses what rubs pushes back against the friction too: near a coefficient of 1 it would hold itself, so
    the coefficient stays below LARGEST_SHARE and has the sign of the stiffness. It is relaxed within its recorded travel or
    one travel outside; farther outside its force hardly changes, and the friction is Coulomb's.
    """
    coefficient, builds_up = force(s, form)
    span = s.source_span
    zero = Parameter("zero", s.source_unit, (-0.4 * span, 0.0, 0.4 * span), -span, span, step=0.01 * span)
    return replace(coefficient, high=LARGEST_SHARE, follows="stiffness"), builds_up, zero


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Lost motion p[0] |load| times a friction state that builds up over p[1]."""
    level = p[0] * abs(float(c.load[0]))
    return np.asarray(signal - p[0] * np.abs(c.load) * dahl(c.motion, p[1], -c.start / level if level > 0.0 else 0.0))


def wrapped(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction coefficient times wrap angle; only where a pull is handed on."""
    return (Parameter("exponent", "", (0.05, 0.15, 0.4, 1.0), 0.0, 5.0, step=0.05),) if s.unit in ("N", "N m") else ()


def apply_wrapped(signal: Array, c: Context, p: Array, form: str) -> Array:
    """The pull behind the wrap, between signal exp(-p[0]) and signal exp(p[0])."""
    return capstan(signal, p[0], c.start)


def in_mechanism(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction without load, and the friction coefficient of what the load presses together."""
    return (*held(s, form), Parameter("coefficient", "", (0.05, 0.15, 0.4), 0.0, 0.95, step=0.05))


def apply_in_mechanism(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Load behind friction that grows with it: p[0] + p[1] |load behind|."""
    return pressed(signal, p[0], p[1], c.start)


def slots(p: Array, form: str) -> dict[str, float]:
    """Coefficient of the force that follows the load, and the distance or the speed over which it builds up."""
    if form == "smooth":
        return {"load_smooth": p[0], "load_smooth_speed": p[1]}
    return {"load_friction": p[0], "load_friction_distance": p[1]}


def slots_of_spring(p: Array, form: str) -> dict[str, float]:
    """The same, and the force from which the load is counted."""
    return {**slots(p, form), "load_zero": p[2]}


_CAPSTAN = Effect(
    "load_dependent_friction",
    "motion",
    47,
    wrapped,
    "Friction grows with the tension itself (capstan): coefficient times wrap angle is {exponent}.",
    "x*exp(-exponent) <= y <= x*exp(exponent), y standing between",
    apply_wrapped,
    contains=("backlash", "coulomb_friction"),
    family="dry",
    remembers=True,
    dissipates=True,
)
_FORCE = Effect(
    "load_dependent_friction",
    "force",
    12,
    force,
    "Friction grows with {source}: it is {coefficient} of its magnitude and builds up over {distance}.",
    "F = coefficient*|load|*z,  dz = (1 - z*sign(dx))*dx/distance",
    slots=slots,
    source="drag",
    remembers=True,
    dissipates=True,
)
_RISING = in_form(
    _FORCE,
    "smooth",
    "Friction grows with {source}: it is {coefficient} of its magnitude; below a speed of about {speed} it is smaller.",
    "F = coefficient*|load|*tanh(v/speed)",
)
_SPRING = replace(
    _FORCE,
    order=13,
    parameters=by_spring,
    says="Friction grows with the force of the spring, counted from {zero}: it is {coefficient} of its magnitude and builds "
    "up over {distance}.",
    equation="F = coefficient*|k x - zero|*z,  dz = (1 - z*sign(dx))*dx/distance",
    slots=slots_of_spring,
    source="spring",
)
EFFECTS = (
    _CAPSTAN,
    replace(_CAPSTAN, port="load"),
    replace(_CAPSTAN, port="wrap", contains=(), family=""),
    Effect(
        "load_dependent_friction",
        "motion",
        47,
        lost,
        "Friction grows with {source}: the output lags by {coefficient} times its magnitude.",
        "y = x - coefficient*|load|*z,  dz = (1 - z*sign(dx))*dx/distance",
        apply,
        source="drag",
        remembers=True,
        dissipates=True,
    ),
    Effect(
        "load_dependent_friction",
        "load",
        47,
        in_mechanism,
        "Dry friction takes {friction} of the load and {coefficient} of what is behind it: after each reversal nothing "
        "deflects until the load has changed by twice as much.",
        "|F - x| <= friction + coefficient*|F|,  F standing between",
        apply_in_mechanism,
        forms=("held",),
        contains=("coulomb_friction",),
        family="dry",
        remembers=True,
        dissipates=True,
    ),
    _FORCE,
    replace(_RISING, timed=True, remembers=False, rounded=True),
    _SPRING,
    replace(
        in_form(
            _SPRING,
            "smooth",
            "Friction grows with the force of the spring, counted from {zero}: it is {coefficient} of its magnitude; below "
            "a speed of about {speed} it is smaller.",
            "F = coefficient*|k x - zero|*tanh(v/speed)",
        ),
        timed=True,
        remembers=False,
        rounded=True,
    ),
)
