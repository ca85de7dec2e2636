"""Motion of the wall along its normal: heart beat and respiration, regular or not (thesis 7.3.6, eq. 7.5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from sim.random_stream import normal, seeded, uniform


@dataclass(frozen=True)
class HeartConfig:
    """Amplitudes in m, frequencies in Hz. `irregularity` is the relative spread of the beat's length from beat to beat;
    `premature_share` the share of beats that come early, small, and with a pause behind them."""

    beat_m: float = 0.001
    beat_Hz: float = 2.0
    second_harmonic: float = 0.0
    respiration_m: float = 0.0004
    respiration_Hz: float = 0.33
    irregularity: float = 0.0
    premature_share: float = 0.0
    start_s: float = 0.0


HEART_PARAMETERS = np.dtype(
    [
        (name, "f8")
        for name in (
            "beat_m",
            "beat_Hz",
            "second_harmonic",
            "respiration_m",
            "respiration_Hz",
            "irregularity",
            "premature_share",
            "start_s",
        )
    ],
    align=True,
)
HEART_STATE = np.dtype(
    [
        ("beat_phase", "f8"),
        ("respiration_phase", "f8"),
        ("length", "f8"),
        ("strength", "f8"),
        ("pause", "f8"),
        ("beats", "i8"),
        ("random", "i8", (1,)),
        ("displacement_m", "f8"),
    ],
    align=True,
)


def parameters(config: HeartConfig) -> np.record:
    """Return `config` as the kernel's record."""
    p = np.zeros(1, HEART_PARAMETERS).view(np.recarray)[0]
    for name in HEART_PARAMETERS.names or ():
        p[name] = getattr(config, name)
    return p


def start(seed: int) -> np.record:
    """State at the beginning of a beat."""
    s = np.zeros(1, HEART_STATE).view(np.recarray)[0]
    s.length, s.strength = 1.0, 1.0
    s.random[0] = seeded(seed, 1)
    return s


@njit(cache=True)
def _next_beat(p, s) -> None:  # type: ignore[no-untyped-def]
    """Draw length and strength of the beat that begins; the displacement is zero here, so nothing jumps."""
    s.beats += 1
    s.strength = 1.0
    s.length = max(0.4, 1.0 + p.irregularity * normal(s.random)) if p.irregularity > 0.0 else 1.0
    if s.pause > 0.0:
        s.length, s.pause = s.pause, 0.0
    elif p.premature_share > 0.0 and uniform(s.random) < p.premature_share:
        s.length, s.strength, s.pause = 0.65, 0.6, 1.35


@njit(cache=True)
def advance(p, s, time_s: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Displacement of the wall along its normal (m) after `dt_s` more; zero before `start_s`."""
    if time_s < p.start_s:
        s.displacement_m = 0.0
        return 0.0
    s.beat_phase += 2.0 * math.pi * p.beat_Hz / s.length * dt_s
    s.respiration_phase = (s.respiration_phase + 2.0 * math.pi * p.respiration_Hz * dt_s) % (2.0 * math.pi)
    if s.beat_phase >= 2.0 * math.pi:
        s.beat_phase %= 2.0 * math.pi
        _next_beat(p, s)
    beat = math.sin(s.beat_phase) + p.second_harmonic * math.sin(2.0 * s.beat_phase)
    s.displacement_m = p.beat_m * s.strength * beat + p.respiration_m * math.sin(s.respiration_phase)
    return s.displacement_m
