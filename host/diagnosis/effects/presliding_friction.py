"""Presliding friction: friction builds up over a distance after each reversal (Dahl; damped bristles of Canudas de Wit et
al., 1995; Maxwell slip; no memory but one).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from host.diagnosis.effects.coulomb_friction import BRISTLES
from host.diagnosis.model.effect import Array, Context, Effect, Parameter, Scale, in_form, spread
from host.diagnosis.model.operators import SLIP_ELEMENTS, dahl, maxwell_slip, wiped_at_reversal

RATIO = {"maxwell": 2.0, "general": 3.0}  # of the distances of neighbouring elements: all alike, or over a decade and more


def build_up(s: Scale, form: str, count: int) -> Parameter:
    """Distance over which lost motion builds up: `count` starts up to what the recorded travel can show."""
    most = farthest(s.span, form)
    return Parameter(
        "distance", s.unit, spread(0.01 * s.span, min(0.6 * s.span, 0.7 * most), count), 1e-3 * s.span, most, log=True
    )


def farthest(span: float, form: str) -> float:
    """Longest distance that travel over `span` can show.

    An element of Maxwell slip that never slides is a spring: a gain, and an offset that each recording begins with. It
    slides from one side to the other within twice its distance. Dahl's friction forgets along the way instead.
    """
    return 0.5 * span / RATIO[form] if form in RATIO else 3.0 * span


def yielding(s: Scale, form: str, count: int, first: float = 3e-3, least: float = 3e-4) -> Parameter:
    """Distance over which a friction force builds up: `count` starts from `first` of the span on, no less than `least`."""
    span = s.motion_span
    most = farthest(span, form)
    grid = spread(first * span, min(0.3 * span, 0.7 * most), count)
    return Parameter("distance", s.motion_unit, grid, least * span, most, log=True)


def lost(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Lost motion when fully built up, and the distance over which that happens; of four elements in form `general`."""
    if form == "general":
        return (*levels("lost_motion", s), build_up(s, form, 4))
    return (
        Parameter("lost_motion", s.unit, (s.need,), 0.0, np.inf, linear=True),
        build_up(s, form, 5),
    )


def levels(name: str, s: Scale) -> tuple[Parameter, ...]:
    """Levels of the elements of generalized Maxwell slip, by growing distance; passive, so none is negative."""
    sizes = (Parameter(f"{name}_{k + 1}", s.unit, (s.need / SLIP_ELEMENTS,), 0.0, np.inf, linear=True) for k in range(4))
    return tuple(sizes)


def force(s: Scale, form: str) -> tuple[Parameter, ...]:
    """Friction force when fully built up, and the distance over which that happens; of four elements in form `general`. Form
    `damped` adds the damping of the bristles while they bend.
    """
    if form == "general":
        return (*levels("force", s), yielding(s, form, 5, 2.0 * BRISTLES, BRISTLES))
    level = Parameter("force", s.unit, (s.need,), 0.0, np.inf, linear=True)
    distance = yielding(s, form, 6, 2.0 * BRISTLES, BRISTLES)
    if form == "damped":
        unit = f"{s.unit} s/{s.motion_unit}"
        return level, distance, Parameter("damping", unit, (s.need / s.speed,), 0.0, np.inf, linear=True)
    return level, distance


def apply(signal: Array, c: Context, p: Array, form: str) -> Array:
    """Lost motion times a friction state that builds up over the last parameter."""
    if form in ("maxwell", "general"):
        each = p[:SLIP_ELEMENTS] if form == "general" else np.full(SLIP_ELEMENTS, p[0] / SLIP_ELEMENTS)
        return np.asarray(signal - maxwell_slip(c.motion, p[-1], RATIO[form], np.ascontiguousarray(each), -c.start))
    start = -c.start / p[0] if p[0] > 0.0 else 0.0
    if form == "reversal":
        return np.asarray(signal - p[0] * wiped_at_reversal(c.motion, p[1], c.tolerance, start))
    return np.asarray(signal - p[0] * dahl(c.motion, p[1], start))


def slots(p: Array, form: str) -> dict[str, float]:
    """Level and distance of the hysteretic force, and the levels of its elements."""
    if form in ("dahl", "damped"):
        return {"presliding": p[0], "presliding_distance": p[1], "bristle_damping": p[2] if form == "damped" else 0.0}
    each = p[:SLIP_ELEMENTS] if form == "general" else np.full(SLIP_ELEMENTS, p[0] / SLIP_ELEMENTS)
    elements = {f"slip_{k + 1}": float(level) for k, level in enumerate(each)}
    return {"presliding": float(np.sum(each)), "presliding_distance": p[-1], "slip_ratio": RATIO[form], **elements}


_LAG = Effect(
    "presliding_friction",
    "motion",
    46,
    lost,
    "The output lags by up to {lost_motion}; the lag builds up over {distance} after each reversal.",
    "y = x - lost_motion*z,  dz = (1 - z*sign(dx))*dx/distance; maxwell: four elements; reversal: "
    "z = sign(dx)*(1 - 2*exp(-s/distance)), s since the last reversal",
    apply,
    forms=("dahl", "maxwell", "reversal"),
    contains=("backlash", "coulomb_friction"),
    family="dry",
    remembers=True,
    dissipates=True,
)
_LAGS = (
    _LAG,
    in_form(
        _LAG,
        "general",
        "The output lags by up to the sum of four elements that slide one after the other after each reversal; "
        "the third after {distance}.",
        "y = x - sum_k z_k,  z_k = clip(z_k + lost_motion_k*dx/d_k, -lost_motion_k, lost_motion_k),  d_k = 3^(k-3)*distance",
    ),
)
_FORCE = Effect(
    "presliding_friction",
    "force",
    11,
    force,
    "Friction of {force} builds up over {distance} after each reversal.",
    "F = force*z,  dz = (1 - z*sign(dx))*dx/distance",
    slots=slots,
    forms=("dahl", "maxwell"),
    contains=("coulomb_friction",),
    family="dry",
    remembers=True,
    dissipates=True,
)
EFFECTS = (
    *_LAGS,
    *(replace(effect, port="load") for effect in _LAGS),
    _FORCE,
    replace(
        in_form(
            _FORCE,
            "damped",
            "Friction of {force} builds up over {distance} after each reversal; until then {damping} times the speed is "
            "added.",
            "F = force*z + damping*distance*dz/dt,  dz = (1 - z*sign(dx))*dx/distance",
        ),
        port="bristle",  # of an axis that is simulated: a measured speed is smoothed over more than the distance
    ),
    in_form(
        _FORCE,
        "general",
        "Friction builds up in four elements that slide one after another after each reversal; the third after {distance}.",
        "F = sum_k z_k,  z_k = clip(z_k + force_k*dx/d_k, -force_k, force_k),  d_k = 3^(k-3)*distance",
    ),
)
