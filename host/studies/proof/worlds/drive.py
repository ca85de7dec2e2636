"""A driven axis integrated by Runge-Kutta steps: mass, damper, spring, dry friction, an actuator, and a digital controller.

m x'' + c x' + k x = u + f0 - (forces of planted effects). The step is at most 0.2 ms and at most a fifth of the sampling
period; `tests/host/proof/test_worlds.py` compares it with scipy's solve_ivp.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

Array = np.ndarray
STEP_S = 2e-4
COULOMB, MAXWELL, STRIBECK, HARDENING, LINE, CREEP, SECOND_MASS, PLACE_DAMPING, PLACE_SPEED, COGGING = range(10)
_STATES = 8  # x, v, actuator, second mass x and v, three Maxwell branches


class Actuator(NamedTuple):
    """Effects on a command: delay, dead zone, limit, lag, and a gain that differs with the sign; 0 for none."""

    delay_s: float = 0.0
    dead_N: float = 0.0
    limit_N: float = 0.0
    lag_s: float = 0.0
    asymmetry: float = 0.0


class Loop(NamedTuple):
    """A position controller that acts at every sample on the noisy reading of `late` samples ago; off if kp is 0."""

    kp: float = 0.0
    ki: float = 0.0
    kd: float = 0.0
    late: int = 1


@njit(cache=True)
def _through(u: float, w: Actuator) -> float:
    """Command after dead zone, limit and asymmetry."""
    if w.dead_N > 0.0:
        u = math.copysign(max(abs(u) - w.dead_N, 0.0), u)
    if w.limit_N > 0.0:
        u = u / (1.0 + abs(u / w.limit_N) ** 8) ** 0.125
    if u > 0.0:
        u *= 1.0 + w.asymmetry
    return u


@njit(cache=True)
def _friction(code: int, q: Array, x: float, v: float, x0: float, memory: Array) -> float:
    """Dry friction; `memory` (5,) holds the elements at the step's begin, when the place was x0."""
    if code == COULOMB:
        return q[0] * math.tanh(v / q[3])
    if code == STRIBECK:
        return (q[1] + (q[0] - q[1]) / (1.0 + (v / q[2]) ** 2)) * math.tanh(v / q[3])
    total = 0.0
    for k in range(5):
        limit = q[1] * (0.2 + 0.4 * k)
        total += 0.2 * min(max(memory[k] + x - x0, -limit), limit) / limit
    return q[0] * total


@njit(cache=True)
def _smooth(code: int, q: Array, x: float, v: float, t: float) -> float:
    """Force of an effect without memory."""
    if code == HARDENING:
        return q[0] * (math.sinh(x / q[1]) - x / q[1])
    if code == LINE:
        return -q[0] * math.sin(2.0 * math.pi * q[1] * t + q[2])
    if code == PLACE_DAMPING:
        return q[0] * x * x * v
    if code == PLACE_SPEED:
        return q[0] * x * abs(v)
    return q[0] * math.sin(2.0 * math.pi * x / q[1] + q[2])  # COGGING


@njit(cache=True)
def _rates(
    p: Array, s: Array, u: float, t: float, effects: tuple[Array, Array], x0: float, memory: Array, out: Array
) -> None:
    """Write the time derivative of s (8,) to out."""
    codes, q = effects
    x, v = s[0], s[1]
    out[:] = 0.0
    against = p[1] * v + p[2] * x
    for j in range(codes.size):
        code = codes[j]
        if code <= STRIBECK:
            against += _friction(code, q[j], x, v, x0, memory[j])
        elif code == CREEP:
            for k in range(3):
                tau = q[j, 1] * (0.3, 1.0, 3.0)[k]
                against += q[j, 0] * p[2] / 3.0 * (x - s[5 + k])
                out[5 + k] = (x - s[5 + k]) / tau
        elif code == SECOND_MASS:
            pull = q[j, 1] * (x - s[3]) + q[j, 2] * (v - s[4])
            against += pull
            out[3], out[4] = s[4], pull / q[j, 0]
        else:
            against += _smooth(code, q[j], x, v, t)
    out[0], out[1] = v, (u + p[3] - against) / p[0]


@njit(cache=True)
def _slipped(codes: Array, q: Array, memory: Array, moved: float) -> None:
    """Carry the friction elements along by `moved` (m)."""
    for j in range(codes.size):
        if codes[j] == MAXWELL:
            for k in range(5):
                limit = q[j, 1] * (0.2 + 0.4 * k)
                memory[j, k] = min(max(memory[j, k] + moved, -limit), limit)


@njit(cache=True)
def _command(time_s: Array, u: Array, held: bool, t: float, i: int) -> float:
    """Command at time t, which lies in interval i or before it."""
    while i > 0 and time_s[i] > t:
        i -= 1
    if held or t <= time_s[0]:
        return u[i]
    share = (t - time_s[i]) / (time_s[i + 1] - time_s[i])
    return u[i] + share * (u[i + 1] - u[i])


@njit(cache=True)
def run(
    p: Array, time_s: Array, wanted: Array, held: bool, w: Actuator, effects: tuple[Array, Array], loop: Loop, noise: Array
) -> tuple[Array, Array]:
    """Return ((n, 3) position, speed, acceleration; (n,) force commanded) at time_s (n,).

    p: m, c, k, f0. wanted: the force (n,), or with a loop the position. held: the force is constant between samples, else
    straight. effects: codes (j,), parameters (j, 4). noise (n,): of the reading that the controller gets.
    """
    codes, q = effects
    n = time_s.size
    out, used = np.zeros((n, 3)), wanted.copy()
    s, d, stage = np.zeros(_STATES), np.zeros((4, _STATES)), np.zeros(_STATES)
    memory = np.zeros((codes.size, 5))
    total, before = 0.0, 0.0
    if p[2] > 0.0 and loop.kp == 0.0:
        s[0] = (wanted[0] + p[3]) / p[2]
    s[2], s[3] = wanted[0] if loop.kp == 0.0 else 0.0, s[0]
    s[5:8] = s[0]
    for i in range(n):
        if loop.kp > 0.0:
            at = max(i - loop.late, 0)
            error = wanted[at] - (out[at, 0] + noise[at])
            dt = time_s[i] - time_s[max(i - 1, 0)]
            total += error * dt
            slope = (error - before) / dt if dt > 0.0 and i > 1 else 0.0
            before = error
            used[i] = p[2] * wanted[i] + loop.kp * error + loop.ki * total + loop.kd * slope
        span = time_s[min(i + 1, n - 1)] - time_s[i]
        steps = max(5, math.ceil(span / STEP_S))
        h = span / steps
        for step in range(steps if span > 0.0 else 0):
            t0, x0 = time_s[i] + step * h, s[0]
            for r in range(4):
                share = (0.0, 0.5, 0.5, 1.0)[r]
                t = min(t0 + share * h, time_s[i] + span * (1.0 - 1e-12))
                u = _through(_command(time_s, used, held, t - w.delay_s, i), w)
                for k in range(_STATES):
                    stage[k] = s[k] + (share * h * d[r - 1, k] if r > 0 else 0.0)
                acting = stage[2] if w.lag_s > 0.0 else u
                _rates(p, stage, acting, t, effects, x0, memory, d[r])
                d[r, 2] = (u - stage[2]) / w.lag_s if w.lag_s > 0.0 else 0.0
            if step == 0:
                out[i, 0], out[i, 1], out[i, 2] = s[0], s[1], d[0, 1]
            for k in range(_STATES):
                s[k] += h / 6.0 * (d[0, k] + 2.0 * d[1, k] + 2.0 * d[2, k] + d[3, k])
            _slipped(codes, q, memory, s[0] - x0)
        if not abs(s[0]) < 1e6:
            break
    out[n - 1, 0], out[n - 1, 1], out[n - 1, 2] = s[0], s[1], out[n - 2, 2]
    return out, used
