"""Planted dry and viscous friction on a motion that a spring drags: LuGre, Bouc-Wen, capstan, stick-slip."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim import effect_codes as code

Array = np.ndarray
_SLIP_TIME_S = 0.008


@njit(cache=True)
def on_axis(e, x: float, load: float, curvature: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """x less the stretch that friction leaves in the spring before it. State 0 is the last x, 1 the friction's share of full."""
    if not e.began:
        e.s[0], e.s[1], e.s[2] = x, 0.0, x
    moved = x - e.s[0]
    e.s[0] = x
    if e.code == code.COULOMB_FRICTION:
        full = e.p[0] / e.p[1]
        e.s[1] = lugre(e.s[1], moved / (0.02 * full + 1e-12))
        return x - full * e.s[1]
    if e.code == code.PRESLIDING_FRICTION:
        e.s[1] = bouc_wen(e.s[1], moved / e.p[1])
        return x - e.p[0] / e.p[2] * e.s[1]
    if e.code == code.LOAD_DEPENDENT_FRICTION:
        return x - _capstan(e, x, moved, load, curvature, dt_s)
    if e.code == code.STRIBECK_FRICTION:
        return _stick_slip(e, x, dt_s)
    if e.code == code.VISCOUS_FRICTION:
        e.s[1] += (moved / dt_s - e.s[1]) * (1.0 - math.exp(-dt_s / 0.002))
        return x - e.p[0] / e.p[1] * e.s[1]
    return x


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
def _capstan(e, x: float, moved: float, load: float, curvature: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Stretch by friction that the load brings about. A wire wrapped over the bend loses exp(mu * angle); other axes rub."""
    e.s[3] += (load - e.s[3]) * (1.0 - math.exp(-dt_s / 0.01))
    if e.port == code.KNOB:
        e.s[1] = lugre(e.s[1], moved / 0.01)
        wrap = abs(curvature) * 0.1
        return (1.0 - math.exp(-e.p[0] * wrap)) * abs(e.s[3]) / e.p[1] * e.s[1]
    e.s[1] = lugre(e.s[1], moved / (2e-4 if e.port == code.INSERTION else 0.02))
    return e.p[0] * abs(e.s[3]) / e.p[1] * e.s[1]


@njit(cache=True)
def _stick_slip(e, x: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """A slider behind the spring: sticks until the static force, slips at the kinetic one, sticks again below the Stribeck speed."""
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
