"""Models of the wall's motion as Kalman filters: local, steady, restless, phased; with rotating harmonics.

In rotating coordinates each harmonic is a pair (p, q), p is its share of the position, and zero is not singular
(Yuen, Novotny and Howe 2008 use polar ones). Rates are states too: an extended filter, whose F has 2 x 2 blocks only.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control.declare import Floats, Matrix
from realtime.control.records import BREATH_HARMONICS, HEART_HARMONICS, TARGET_MODELS, TARGET_N, TargetState

# State of one model (m, m/s, rad/s, 1, m): level, its speed, pairs (p, q) of each harmonic, both rates, the relative
# error of the assumed stiffness of the contact, and by how much half the backlash is below the assumed value.
LEVEL, SPEED, HEART = 0, 1, 2
BREATH = HEART + 2 * HEART_HARMONICS
HEART_RATE = BREATH + 2 * BREATH_HARMONICS
BREATH_RATE = HEART_RATE + 1
STIFFNESS = BREATH_RATE + 1
PLAY = STIFFNESS + 1
N = TARGET_N
PAIRS = HEART_HARMONICS + BREATH_HARMONICS
LOCAL, STEADY, RESTLESS, PHASED = 0, 1, 2, 3
MODELS = TARGET_MODELS

# Process noise, by model: share of the level's acceleration^2, relative strength^2 (1/s), rate^2 (rad2/s3). The phased
# model's beat is in `beat_phase`, its level and breath are here.
_LEVEL_SHARE2 = (0.0, 1.0, 10.0, 10.0)
_STRENGTH2 = (0.0, 1e-5, 0.03, 0.03)
_RATE2 = (0.0, 1e-4, 10.0, 0.0)
_LEAST_GROWTH2 = 1e-13  # m2/s, noise of a harmonic of amplitude zero, so that it can grow
_BREATH_RATE2 = 1e-5
_LEVEL_MEMORY_S = 0.5  # time constant with which a speed of the level decays
_RATE_MEMORY_S = 0.3  # time constant with which a restless beat returns to the mean rate
_SOFTEST, _STIFFEST = -0.6, 1.0


@njit(cache=True)
def position(x: Floats, ahead_s: float) -> float:
    """Return the position (m) of a model's state `x` (N,) `ahead_s` from now (or before)."""
    fade = math.exp(-max(ahead_s, 0.0) / _LEVEL_MEMORY_S)
    value = x[LEVEL] + x[SPEED] * (_LEVEL_MEMORY_S * (1.0 - fade) if ahead_s > 0.0 else ahead_s)
    for group in range(2):
        first, count = (HEART, HEART_HARMONICS) if group == 0 else (BREATH, BREATH_HARMONICS)
        angle = x[HEART_RATE + group] * ahead_s
        c1, s1 = math.cos(angle), math.sin(angle)
        c, s = c1, s1
        for h in range(count):
            i = first + 2 * h
            value += c * x[i] - s * x[i + 1]
            c, s = c * c1 - s * s1, s * c1 + c * s1
    return value


@njit(cache=True)
def propagate_local(x: Floats, P: Matrix, dt_s: float, acceleration2: float) -> None:
    """Advance the local model by `dt_s`; acceleration2 (m2/s3): its noise. Only level and speed of `x`, `P` are used."""
    fade = math.exp(-dt_s / _LEVEL_MEMORY_S)
    reach = _LEVEL_MEMORY_S * (1.0 - fade)
    x[LEVEL] += reach * x[SPEED]
    x[SPEED] *= fade
    p00 = P[0, 0] + reach * (2.0 * P[0, 1] + reach * P[1, 1])
    p01 = fade * (P[0, 1] + reach * P[1, 1])
    P[0, 0] = p00 + acceleration2 * dt_s**3 / 3.0
    P[0, 1] = P[1, 0] = p01 + acceleration2 * dt_s**2 / 2.0
    P[1, 1] = fade * fade * P[1, 1] + acceleration2 * dt_s


@njit(cache=True)
def _turn(x: Floats, angle: Matrix, dt_s: float) -> None:
    """Rotate all pairs of `x` by their angle in `dt_s`, and set `angle` (PAIRS, 2) to its cosine and sine."""
    for group in range(2):
        first, count = (0, HEART_HARMONICS) if group == 0 else (HEART_HARMONICS, BREATH_HARMONICS)
        turn = x[HEART_RATE + group] * dt_s
        c1, s1 = math.cos(turn), math.sin(turn)
        c, s = c1, s1
        for h in range(count):
            angle[first + h, 0], angle[first + h, 1] = c, s
            i = HEART + 2 * (first + h)
            x[i], x[i + 1] = c * x[i] - s * x[i + 1], s * x[i] + c * x[i + 1]
            c, s = c * c1 - s * s1, s * c1 + c * s1


@njit(cache=True)
def _rows(P: Matrix, x: Floats, angle: Matrix, dt_s: float, fade: float, back: float) -> None:
    """Set P to F P, by the blocks of F: level and speed, each rotating pair with its rate, the heart's rate."""
    reach = _LEVEL_MEMORY_S * (1.0 - fade)
    for j in range(N):
        P[LEVEL, j] += reach * P[SPEED, j]
        P[SPEED, j] *= fade
    for k in range(PAIRS):
        i = HEART + 2 * k
        of_heart = k < HEART_HARMONICS
        rate = HEART_RATE if of_heart else BREATH_RATE
        order = k + 1 if of_heart else k - HEART_HARMONICS + 1
        c, s = angle[k, 0], angle[k, 1]
        along_p, along_q = -order * dt_s * x[i + 1], order * dt_s * x[i]
        for j in range(N):
            p, q, w = P[i, j], P[i + 1, j], P[rate, j]
            P[i, j], P[i + 1, j] = c * p - s * q + along_p * w, s * p + c * q + along_q * w
    for j in range(N):
        P[HEART_RATE, j] *= back


@njit(cache=True)
def _transpose(P: Matrix) -> None:
    for i in range(N):
        for j in range(i):
            P[i, j], P[j, i] = P[j, i], P[i, j]


@njit(cache=True)
def propagate(x: Floats, P: Matrix, angle: Matrix, model: int, dt_s: float, mean_rate: float, level2: float) -> None:
    """Advance a model with harmonics by `dt_s`: x <- F x, P <- F P F^T + Q.

    angle (PAIRS, 2): scratch; mean_rate (rad/s): rate to which a restless beat returns; level2: the level's squared
    acceleration (m2/s3) of the steady model.
    """
    fade = math.exp(-dt_s / _LEVEL_MEMORY_S)
    back = math.exp(-dt_s / _RATE_MEMORY_S) if model == RESTLESS else 1.0
    _turn(x, angle, dt_s)
    x[LEVEL] += _LEVEL_MEMORY_S * (1.0 - fade) * x[SPEED]
    x[SPEED] *= fade
    _rows(P, x, angle, dt_s, fade, back)
    _transpose(P)
    _rows(P, x, angle, dt_s, fade, back)
    x[HEART_RATE] = mean_rate + back * (x[HEART_RATE] - mean_rate)
    _add_noise(x, P, model, dt_s, _LEVEL_SHARE2[model] * level2)


@njit(cache=True)
def _add_noise(x: Floats, P: Matrix, model: int, dt_s: float, q: float) -> None:
    P[LEVEL, LEVEL] += q * dt_s**3 / 3.0
    P[LEVEL, SPEED] += q * dt_s**2 / 2.0
    P[SPEED, LEVEL] += q * dt_s**2 / 2.0
    P[SPEED, SPEED] += q * dt_s
    for k in range(PAIRS):
        i = HEART + 2 * k
        known = P[HEART_RATE, HEART_RATE] > 0.0 if k < HEART_HARMONICS else P[BREATH_RATE, BREATH_RATE] > 0.0
        if known:
            strength = 1.0 if k < HEART_HARMONICS else 0.1
            noise = (_LEAST_GROWTH2 + strength * _STRENGTH2[model] * (x[i] ** 2 + x[i + 1] ** 2)) * dt_s
            P[i, i] += noise
            P[i + 1, i + 1] += noise
    if P[HEART_RATE, HEART_RATE] > 0.0:
        P[HEART_RATE, HEART_RATE] += _RATE2[model] * dt_s
    if P[BREATH_RATE, BREATH_RATE] > 0.0:
        P[BREATH_RATE, BREATH_RATE] += _BREATH_RATE2 * dt_s


@njit(cache=True)
def _set_row(state: TargetState, m: int, travel_m: float, flank: float, ago_s: float) -> None:
    """Set the row of a measurement `ago_s` before the state's time: value = wall - stiffer * travel - play * flank."""
    x, row = state.x[m], state.row
    row[LEVEL], row[SPEED] = 1.0, -ago_s
    for group in range(2):
        first, count = (HEART, HEART_HARMONICS) if group == 0 else (BREATH, BREATH_HARMONICS)
        for h in range(count):
            turn = (h + 1) * x[HEART_RATE + group] * ago_s
            c, s = (1.0, 0.0) if ago_s == 0.0 else (math.cos(turn), math.sin(turn))
            row[first + 2 * h], row[first + 2 * h + 1] = c, s
    row[HEART_RATE] = row[BREATH_RATE] = 0.0
    row[STIFFNESS], row[PLAY] = -travel_m, -flank


@njit(cache=True)
def innovation_variance(state: TargetState, m: int, noise_m2: float, travel_m: float, flank: float, ago_s: float) -> float:
    """Return the innovation variance (m2) of model `m`; set state.cross to P row^T."""
    P, row, cross = state.P[m], state.row, state.cross
    if m == LOCAL:
        cross[LEVEL], cross[SPEED] = P[0, 0] - ago_s * P[0, 1], P[1, 0] - ago_s * P[1, 1]
        return cross[LEVEL] - ago_s * cross[SPEED] + noise_m2
    _set_row(state, m, travel_m, flank, ago_s)
    total = noise_m2
    for i in range(N):
        value = 0.0
        for j in range(N):
            value += P[i, j] * row[j]
        cross[i] = value
        total += row[i] * value
    return total


@njit(cache=True)
def correct(state: TargetState, m: int, innovation: float, spread: float) -> None:
    """Correct model `m` by an innovation (m) of variance `spread` (m2): gain, state and covariance of the Kalman filter."""
    x, P, cross = state.x[m], state.P[m], state.cross
    n = 2 if m == LOCAL else N
    for i in range(n):
        gain = cross[i] / spread
        x[i] += gain * innovation
        for j in range(n):
            P[i, j] -= gain * cross[j]
    if m != LOCAL:
        x[STIFFNESS] = min(max(x[STIFFNESS], _SOFTEST), _STIFFEST)
        for i in range(n):
            P[i, i] = max(P[i, i], 0.0)
