"""Planted dry and viscous friction on a motion that a spring drags: LuGre, Bouc-Wen, capstan, stick-slip."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim import effect_codes as code

Array = np.ndarray
_SLIP_TIME_S = 0.008
_BENT_M = 0.1  # shaft that the wire runs along


@njit(cache=True)
def on_axis(e, x: float, load: float, curvature: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Motion behind a spring that x drags against friction. State 0: that motion; 1: the friction's share of full; 2: x."""
    if not e.began:
        e.s[0], e.s[1], e.s[2], e.s[3] = x, 0.0, x, load
    if e.code == code.COULOMB_FRICTION:
        full = e.p[0] / e.p[1]
        return _drag(e, x, full, 0.02 * full + 1e-12)
    if e.code == code.PRESLIDING_FRICTION:
        return _drag(e, x, e.p[0] / e.p[2], e.p[1])
    if e.code == code.LOAD_DEPENDENT_FRICTION:
        return _held_by_load(e, x, load, curvature, dt_s)
    if e.code == code.STRIBECK_FRICTION:
        return _stick_slip(e, x, dt_s)
    if e.code == code.VISCOUS_FRICTION:
        e.s[1] += ((x - e.s[2]) / dt_s - e.s[1]) * (1.0 - math.exp(-dt_s / 0.002))
        e.s[2] = x
        return x - e.p[0] / e.p[1] * e.s[1]
    return x


@njit(cache=True)
def _share(e, moved: float) -> float:  # type: ignore[no-untyped-def]
    """Return the share of full friction after `moved` distances: Bouc-Wen for presliding, LuGre for Coulomb."""
    return bouc_wen(e.s[1], moved) if e.code == code.PRESLIDING_FRICTION else lugre(e.s[1], moved)


@njit(cache=True)
def _drag(e, x: float, full: float, distance: float) -> float:  # type: ignore[no-untyped-def]
    """Spring and friction in balance, x - y = full * share(y): y lies between its last value and where no friction
    would add up, found by regula falsi (Illinois)."""
    start = x - e.s[0] - full * e.s[1]
    near, far = 0.0, start
    at_near, at_far = start, start - far - full * (_share(e, far / distance) - e.s[1])
    moved = far
    for _ in range(60):
        if abs(at_near - at_far) < 1e-300:
            break
        moved = (near * at_far - far * at_near) / (at_far - at_near)
        value = start - moved - full * (_share(e, moved / distance) - e.s[1])
        if abs(value) <= 1e-12 * (abs(start) + full):
            break
        if value * start > 0.0:
            near, at_near = moved, value
            at_far *= 0.5
        else:
            far, at_far = moved, value
            at_near *= 0.5
    e.s[1] = _share(e, moved / distance)
    e.s[0] += moved
    return e.s[0]


@njit(cache=True)
def lugre(share: float, moved: float) -> float:
    """Bristle deflection over its greatest after `moved` bristle lengths (Canudas de Wit 1995, slow motion; implicit)."""
    return (share + moved) / (1.0 + abs(moved))


@njit(cache=True)
def bouc_wen(share: float, moved: float) -> float:
    """Hysteretic share in -1..1 after `moved` distances: d(share) = d(moved) (1 - share^2) on loading, d(moved) on
    unloading (Bouc-Wen, n = 2, beta = gamma = 1/2), integrated exactly."""
    if share * moved < 0.0:
        if abs(moved) <= abs(share):
            return share + moved
        moved += share
        share = 0.0
    t = math.tanh(moved)
    return (share + t) / (1.0 + share * t)


@njit(cache=True)
def _held_by_load(e, x: float, load: float, curvature: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Motion that friction holds as far as the load presses: a wire over a bend keeps its far end between exp(-mu * angle)
    and exp(mu * angle) of the near one (capstan); other axes rub with mu times the load."""
    e.s[3] += (load - e.s[3]) * (1.0 - math.exp(-dt_s / 0.01))
    if e.port == code.KNOB:
        keep = math.exp(-e.p[0] * abs(curvature) * _BENT_M)
        low, high = min(x * keep, x / keep), max(x * keep, x / keep)
    else:
        low, high = x - e.p[0] * abs(e.s[3]) / e.p[1], x + e.p[0] * abs(e.s[3]) / e.p[1]
    e.s[0] = min(max(e.s[0], low), high)
    return e.s[0]


@njit(cache=True)
def _stick_slip(e, x: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """A slider behind the spring: sticks up to the static force, slips at the kinetic one, sticks again when slow."""
    stretch = x - e.s[2]
    static, kinetic = e.p[0] / e.p[3], e.p[1] / e.p[3]
    if e.s[4] == 0.0 and abs(stretch) > static:
        e.s[4] = 1.0
    if e.s[4] != 0.0:
        excess = abs(stretch) - min(kinetic, static)
        if excess > 0.0:
            step = excess * (1.0 - math.exp(-dt_s / _SLIP_TIME_S))
            e.s[2] += math.copysign(step, stretch)
            if step < 0.3 * e.p[2] * dt_s:
                e.s[4] = 0.0
        else:
            e.s[4] = 0.0
    return e.s[2]
