"""Time stamps, excitation and noise of the worlds: windows cut from motion, jitter, drop-outs, analytic commands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

Array = np.ndarray
Command = Callable[[Array], Array]  # time (n,) s -> value (n,), within about -1..1
KINDS = ("multisine", "turns", "holds")


def stamps(rng: np.random.Generator, rate_hz: float, duration_s: float, jitter: float) -> Array:
    """Return the sample times (n,) of one window, s from its first sample.

    Args:
        rng: stream of chance.
        rate_hz: mean rate, 1/s.
        duration_s: length of the window, s.
        jitter: largest deviation of a stamp from the even grid, as a share of the period (below 0.5).
    """
    n = max(60, round(duration_s * rate_hz))
    even = np.arange(n) / rate_hz
    moved = even + rng.uniform(-jitter, jitter, n) / rate_hz
    return np.asarray(moved - moved[0])


def command(
    rng: np.random.Generator, kind: str, slowest_hz: float, fastest_hz: float, span_s: tuple[float, float]
) -> Command:
    """Return a smooth command of `kind`, in motion all the time, over span_s (first, last) s.

    Args:
        rng: stream of chance.
        kind: one of KINDS.
        slowest_hz: lowest frequency with energy, Hz.
        fastest_hz: highest, Hz.
        span_s: times over which the command is used.

    Raises:
        ValueError: the kind is not known.
    """
    if kind == "multisine":
        return _multisine(rng, slowest_hz, fastest_hz)
    if kind not in KINDS:
        raise ValueError(f"kind: found {kind!r}, wanted one of {', '.join(KINDS)}")
    at, value, side = [span_s[0] - 1.0 / slowest_hz], [0.0], 1.0
    while at[-1] < span_s[1] + 1.0 / slowest_hz:
        wait = 0.5 / float(np.exp(rng.uniform(np.log(slowest_hz), np.log(fastest_hz))))
        at.append(at[-1] + wait)
        value.append(side * rng.uniform(0.2, 1.0))
        side = -side
        if kind == "holds":
            at.append(at[-1] + rng.uniform(0.5, 2.0) / fastest_hz)
            value.append(value[-1])
    return PchipInterpolator(at, value)


def _multisine(rng: np.random.Generator, slowest_hz: float, fastest_hz: float) -> Command:
    """Return eight sines in geometric spacing, random phases, amplitudes falling with the frequency's root."""
    tones = np.geomspace(slowest_hz, fastest_hz, 8) * rng.uniform(0.93, 1.07, 8)
    phase = rng.uniform(0.0, 2.0 * np.pi, 8)
    size = (slowest_hz / tones) ** 0.5
    size /= 2.0 * float(np.sqrt(0.5 * np.sum(size**2)))  # RMS 0.5

    def at(time_s: Array) -> Array:
        return np.asarray(np.sin(2.0 * np.pi * np.multiply.outer(time_s, tones) + phase) @ size)

    return at


def noise(rng: np.random.Generator, n: int, sigma: float, share: float) -> Array:
    """Return noise (n,) of standard deviation sigma: `share` of its energy Markov over ten samples, the remainder white."""
    a = float(np.exp(-0.1))
    slow = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal(n + 100))[100:]
    return np.asarray(sigma * (np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.standard_normal(n)))


def lost(rng: np.random.Generator, n: int, share: float) -> Array:
    """Return which (n,) samples are lost: bursts of one to eight, `share` of all."""
    out = np.zeros(n, bool)
    for at in np.flatnonzero(rng.random(n) < share / 4.5):
        out[at : at + int(rng.integers(1, 9))] = True
    out[:3] = out[-3:] = False
    return out
