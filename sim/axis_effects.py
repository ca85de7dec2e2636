"""Planted effects on one motion: a stage's way to the catheter, or the curvature that the wires ask for."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim import effect_codes as code
from sim import friction_effects as friction

Array = np.ndarray
_PLAYS = 8
_TWO_PI = 2.0 * math.pi


@njit(cache=True)
def apply(
    effects: Array, port: int, x: float, load: float, stage: Array, curvature: float, time_s: float, dt_s: float
) -> float:
    """The motion x of `port` (m, rad, rad, 1/m) after all effects planted there, in their order.

    load: what the port carries (N, Nm, N wire tension, N at the tip); stage: all three stage positions;
    curvature: of the last step (1/m). An effect takes its rest position from x at its start.
    """
    for k in range(effects.shape[0]):
        e = effects[k]
        if e.port != port or time_s < e.start_s:
            continue
        if e.code <= code.LATENCY or e.code == code.CLOCK_DRIFT:
            x = _with_memory(e, x, load, curvature, time_s, dt_s)
        else:
            x = _elastic(e, x, load, stage, time_s, dt_s)
        e.began = 1
    return x


@njit(cache=True)
def _with_memory(e, x: float, load: float, curvature: float, time_s: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Apply the effects with memory: backlash, friction, lag and delay."""
    if e.code == code.BACKLASH:
        return _distributed_play(e, x)
    if e.code == code.DEAD_ZONE:
        return _dead_zone(x - e.p[0], e.p[1]) + e.p[0]
    if e.code == code.RATE_LAG:
        return _lag(e, 0, x, e.p[0], dt_s)
    if e.code == code.LATENCY:
        return _delayed(e, x, e.p[0] / dt_s)
    if e.code == code.CLOCK_DRIFT:
        return _delayed(e, x, e.p[0] * (time_s - e.start_s) / dt_s)
    if e.port == code.SHAPE:
        return x
    return friction.on_axis(e, x, load, curvature, dt_s)


@njit(cache=True)
def _elastic(  # type: ignore[no-untyped-def]  # noqa: C901 - one branch for each effect
    e, x: float, load: float, stage: Array, time_s: float, dt_s: float
) -> float:
    """Elastic and static effects, disturbances, resonance."""
    if e.port == code.SHAPE and (
        e.code in (code.NONLINEAR_STIFFNESS, code.CREEP_RELAXATION, code.PLASTIC_SET, code.SOFTENING, code.ASYMMETRY)
        or e.code >= code.GRAVITY_LOAD
    ):
        return x
    if e.code == code.COMPLIANCE or e.code == code.NONLINEAR_STIFFNESS:
        return _yielding(e, x, load, dt_s)
    if e.code == code.CREEP_RELAXATION:
        fast, slow = _lag(e, 0, x, e.p[1], dt_s), _lag(e, 1, x, 6.0 * e.p[1], dt_s)
        return x - e.p[0] * (x - 0.6 * fast - 0.4 * slow)
    if e.code == code.PLASTIC_SET:
        e.s[0] = max(e.s[0], x - e.p[0])
        e.s[1] = max(e.s[1], -x - e.p[0])
        return x + e.p[1] * (e.s[0] - e.s[1])
    if e.code == code.SOFTENING:
        return x / (1.0 + e.p[0] * (time_s - e.start_s))
    if e.code == code.ASYMMETRY:
        return x + 0.5 * (e.p[0] - 1.0) * (x - e.p[1] - abs(x - e.p[1]))
    if e.code == code.STATIC_NONLINEARITY:
        return x + e.p[1] * x * math.sin(x / e.p[0])
    if e.code == code.SATURATION:
        return x / (1.0 + (abs(x) / e.p[0]) ** 8) ** 0.125
    if e.code == code.COUPLING:
        return x + _lag(e, 0, e.p[0] * stage[int(e.p[1])], 0.02, dt_s)
    if e.code == code.WHIP:
        return _whip(e, x, dt_s)
    if e.code == code.PERIODIC_DISTURBANCE:
        angle = e.p[3] + (_TWO_PI * e.p[1] * time_s if e.p[1] > 0.0 else _TWO_PI * x / e.p[2])
        return x + e.p[0] * (math.sin(angle) + 0.25 * math.sin(2.0 * angle))
    if e.code == code.RESONANCE:
        return _resonance(e, x, dt_s)
    return x


@njit(cache=True)
def _distributed_play(e, x: float) -> float:  # type: ignore[no-untyped-def]
    """Mean of plays whose widths spread by a fifth around p[0]: flanks round off at their ends."""
    total = 0.0
    for i in range(_PLAYS):
        half = 0.5 * e.p[0] * (0.8 + 0.4 * i / (_PLAYS - 1.0))
        if not e.began:
            e.s[i] = x
        e.s[i] = min(max(e.s[i], x - half), x + half)
        total += e.s[i]
    return total / _PLAYS


@njit(cache=True)
def _dead_zone(x: float, half: float) -> float:
    """Nothing within `half` of zero, edges rounded over a twentieth of it."""
    soft = 0.05 * half
    right = 0.5 * (x - half + math.sqrt((x - half) ** 2 + soft * soft))
    left = 0.5 * (-x - half + math.sqrt((x + half) ** 2 + soft * soft))
    return right - left


@njit(cache=True)
def _lag(e, i: int, x: float, time_constant_s: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """First-order lag of x in state i, exact for an input that runs straight between steps; state i + _PLAYS: that input.

    Held over the step, the newest input would lead by half a step, which a short time constant does not forgive.
    """
    before = e.s[i + _PLAYS] if e.began else x
    behind = (x - before) * time_constant_s / dt_s
    if not e.began:
        e.s[i] = x
    e.s[i] = x - behind + (e.s[i] - before + behind) * math.exp(-dt_s / time_constant_s)
    e.s[i + _PLAYS] = x
    return e.s[i]


@njit(cache=True)
def _delayed(e, x: float, steps: float) -> float:  # type: ignore[no-untyped-def]
    """x as it was `steps` (not a whole number) steps ago, from the delay line."""
    size = e.ring.shape[0]
    if not e.began:
        e.ring[:] = x
        e.s[0] = 0.0
    now = (int(e.s[0]) + 1) % size
    e.s[0] = now
    e.ring[now] = x
    steps = min(max(steps, 0.0), size - 2.0)
    whole = int(steps)
    near, far = e.ring[(now - whole) % size], e.ring[(now - whole - 1) % size]
    return near + (steps - whole) * (far - near)


@njit(cache=True)
def _yielding(e, x: float, load: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """x given way to the load: in proportion, or by a spring that stiffens with the cube (Newton)."""
    force = _lag(e, 0, load, 0.008, dt_s)
    if e.port == code.KNOB or e.port == code.SHAPE:
        force = -force
    if e.code == code.COMPLIANCE:
        return x + e.p[0] * force
    deflection = force / e.p[0]
    for _ in range(20):
        square = e.p[1] * deflection * deflection
        deflection -= (deflection * (1.0 + square) - force / e.p[0]) / (1.0 + 3.0 * square)
    return x + deflection


@njit(cache=True)
def _whip(e, x: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """A pre-curved shaft in a curved vessel: the angle where windup and the vessel's hold balance; it may jump."""
    hold = math.sin(-e.p[1])
    if not e.began:
        e.s[0] = x
    for _ in range(4):
        e.s[0] += 0.25 * dt_s / 0.004 * (x - e.s[0] - e.p[0] * (math.sin(e.s[0] - e.p[1]) - hold))
    return e.s[0]


@njit(cache=True)
def _resonance(e, x: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """A mass on a spring moved by x: implicit midpoint rule."""
    if not e.began:
        e.s[0], e.s[1], e.s[2] = x, 0.0, x
    w = _TWO_PI * e.p[0] * dt_s
    damping, spring = e.p[1] * w, 0.25 * w * w
    middle = 0.5 * (x + e.s[2])
    speed = (e.s[1] * (1.0 - damping - spring) + w * w * (middle - e.s[0])) / (1.0 + damping + spring)
    e.s[0] += 0.5 * (e.s[1] + speed)
    e.s[1], e.s[2] = speed, x
    return e.s[0]
