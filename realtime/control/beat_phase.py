"""Phase of an irregular heart beat: a Bayes filter on a grid of phases and rates, with a learned waveform.

A beat that comes early or lasts long shifts the phase by more than a linearized filter can follow. Here the waveform is
one curve over the phase (harmonics, learned slowly), and the probability of phase and rate is kept on a grid. Each grid
cell advances at its rate, the rate changes about once a beat, and each sample corrects the probabilities.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from realtime.control.declare import Tensor
from realtime.control.records import BEAT_HARMONICS, BEAT_PHASES, BEAT_RATES, Beat

PARTS = 2 * BEAT_HARMONICS
# Rates on the grid, relative to the mean rate, and their probabilities: a bell around the mean, and a uniform share.
RATIO = np.linspace(0.55, 1.60, BEAT_RATES)
_NEAR, _ANY = 0.12, 0.15
_BELL = np.exp(-0.5 * ((RATIO - 1.0) / _NEAR) ** 2)
LIKELY = (1.0 - _ANY) * _BELL / _BELL.sum() + _ANY / BEAT_RATES
_ANGLE = 2.0 * np.pi / BEAT_PHASES * np.outer(np.arange(BEAT_PHASES), np.arange(1, BEAT_HARMONICS + 1))
# cos and sin of each harmonic at each phase of the grid: (phases, 2 harmonics).
WAVE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=2).reshape(BEAT_PHASES, PARTS)

_CHANGES_PER_BEAT = 1.0
_MEMORY_S = 15.0  # of the wave
_FIRST_SAMPLES = 20.0  # weight of the first guess of the wave, in samples; the zero of higher harmonics weighs more
_FIRST_SPREAD_rad = 0.5
_MODEL_m = 1e-4  # model error of the wave, standard deviation
_WILD = 1e-4  # likelihood that any sample has at any phase, so that an outlier excludes no phase


@njit(cache=True)
def start(state: Beat, cosine_m: float, sine_m: float) -> None:
    """Start with one harmonic; `cosine_m`, `sine_m` (m): its pair (p, q) now, from `frequency_bank.pair`."""
    size_m, phase = math.hypot(cosine_m, sine_m), math.atan2(sine_m, cosine_m)
    for a in range(PARTS):
        state.wave_m[a] = size_m if a == 0 else 0.0
        for b in range(PARTS):
            state.information[a, b] = 0.0
        state.information[a, a] = _FIRST_SAMPLES * (1.0 if a < 2 else 4.0)
        state.projected_m[a] = state.information[a, a] * state.wave_m[a]
    total = 0.0
    for i in range(BEAT_PHASES):
        off = (2.0 * math.pi / BEAT_PHASES * i - phase + math.pi) % (2.0 * math.pi) - math.pi
        for j in range(BEAT_RATES):
            state.share[i, j] = math.exp(-0.5 * (off / _FIRST_SPREAD_rad) ** 2) * LIKELY[j]
            total += state.share[i, j]
    for i in range(BEAT_PHASES):
        for j in range(BEAT_RATES):
            state.share[i, j] /= total
    _set_moments(state)


@njit(cache=True)
def ahead(moment_m: Tensor, mean_rate: float, ahead_s: float) -> float:
    """Return the beat's share of the position (m) `ahead_s` from now (or before), from `moment_m` (rates, harmonics, 2)."""
    value = 0.0
    for j in range(BEAT_RATES):
        turn = mean_rate * RATIO[j] * ahead_s
        c1, s1 = math.cos(turn), math.sin(turn)
        c, s = c1, s1
        for h in range(BEAT_HARMONICS):
            value += c * moment_m[j, h, 0] - s * moment_m[j, h, 1]
            c, s = c * c1 - s * s1, s * c1 + c * s1
    return value


@njit(cache=True)
def variance(state: Beat) -> float:
    """Return the variance (m2) of the beat's share of the position now, over the grid."""
    mean = square = 0.0
    for i in range(BEAT_PHASES):
        share, wave_m = 0.0, 0.0
        for j in range(BEAT_RATES):
            share += state.share[i, j]
        for a in range(PARTS):
            wave_m += WAVE[i, a] * state.wave_m[a]
        mean += share * wave_m
        square += share * wave_m * wave_m
    return max(square - mean * mean, 0.0)


@njit(cache=True)
def propagate(state: Beat, mean_rate: float, dt_s: float) -> None:
    """Advance the probabilities by `dt_s`: each cell moves at its rate, a share of it changes the rate. mean_rate: rad/s."""
    stay = math.exp(-_CHANGES_PER_BEAT * dt_s * mean_rate / (2.0 * math.pi))
    for j in range(BEAT_RATES):
        cells = mean_rate * RATIO[j] * dt_s * BEAT_PHASES / (2.0 * math.pi)
        whole = math.floor(cells)
        part = cells - whole
        first = int(whole) % BEAT_PHASES
        for i in range(BEAT_PHASES):
            k = (i - first) % BEAT_PHASES
            state.moved[i, j] = (1.0 - part) * state.share[k, j] + part * state.share[(k - 1) % BEAT_PHASES, j]
    for i in range(BEAT_PHASES):
        total = 0.0
        for j in range(BEAT_RATES):
            total += state.moved[i, j]
        for j in range(BEAT_RATES):
            state.share[i, j] = stay * state.moved[i, j] + (1.0 - stay) * total * LIKELY[j]
    _set_moments(state)


@njit(cache=True)
def correct(state: Beat, value_m: float, noise_m2: float, dt_s: float) -> None:
    """Correct the probabilities by a sample of the beat's share, `value_m` of variance `noise_m2`, and learn the wave."""
    total, keep = 0.0, math.exp(-dt_s / _MEMORY_S)
    for i in range(BEAT_PHASES):
        off_m = value_m
        for a in range(PARTS):
            off_m -= WAVE[i, a] * state.wave_m[a]
        likelihood = math.exp(-0.5 * off_m * off_m / (noise_m2 + _MODEL_m**2)) + _WILD
        for j in range(BEAT_RATES):
            state.share[i, j] *= likelihood
            total += state.share[i, j]
    for a in range(PARTS):
        state.projected_m[a] *= keep
        for b in range(PARTS):
            state.information[a, b] *= keep
    for i in range(BEAT_PHASES):
        share = 0.0
        for j in range(BEAT_RATES):
            state.share[i, j] /= total
            share += state.share[i, j]
        for a in range(PARTS):
            state.projected_m[a] += share * WAVE[i, a] * value_m
            for b in range(a + 1):
                state.information[a, b] += share * WAVE[i, a] * WAVE[i, b]
    for a in range(PARTS):
        state.information[a, a] += 1e-3 * dt_s
    _solve(state)
    _set_moments(state)


@njit(cache=True)
def _solve(state: Beat) -> None:
    """Solve information wave_m = projected_m for wave_m, by Cholesky factors of the lower half of `information`."""
    L, x = state.factor, state.wave_m
    for a in range(PARTS):
        for b in range(a + 1):
            value = state.information[a, b]
            for c in range(b):
                value -= L[a, c] * L[b, c]
            L[a, b] = math.sqrt(max(value, 1e-12)) if a == b else value / L[b, b]
    for a in range(PARTS):
        value = state.projected_m[a]
        for b in range(a):
            value -= L[a, b] * x[b]
        x[a] = value / L[a, a]
    for a in range(PARTS - 1, -1, -1):
        value = x[a]
        for b in range(a + 1, PARTS):
            value -= L[b, a] * x[b]
        x[a] = value / L[a, a]


@njit(cache=True)
def _set_moments(state: Beat) -> None:
    """Set the moments (rates, harmonics, cosine and sine) from which `ahead` predicts."""
    for j in range(BEAT_RATES):
        for h in range(BEAT_HARMONICS):
            c = s = 0.0
            for i in range(BEAT_PHASES):
                c += state.share[i, j] * WAVE[i, 2 * h]
                s += state.share[i, j] * WAVE[i, 2 * h + 1]
            p, q = state.wave_m[2 * h], state.wave_m[2 * h + 1]
            state.moment_m[j, h, 0], state.moment_m[j, h, 1] = p * c + q * s, p * s - q * c
