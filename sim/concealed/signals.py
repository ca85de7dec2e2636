"""Command signals and noise of concealed cases: sweeps, multisines, steps, presses; coloured noise, drop-outs."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

Array = np.ndarray
KINDS = ("sweep", "multisine", "steps", "sine", "walk")
QUIET_S = 2.5  # stillness at the start of every recording, from which noise is estimated


def signal(rng: np.random.Generator, kind: str, time_s: Array, fastest_Hz: float = 0.6) -> Array:
    """A command of `kind` within about -1..1 over time_s (n,), still for the first QUIET_S and the last second."""
    t = np.maximum(time_s - time_s[0] - QUIET_S, 0.0)
    if kind == "multisine":
        x = _multisine(rng, t, fastest_Hz)
    elif kind == "sweep":
        x = _sweep(rng, t, fastest_Hz)
    elif kind == "steps":
        x = _steps(rng, t)
    elif kind == "sine":
        x = np.sin(2.0 * np.pi * rng.uniform(0.1, 0.25) * t)
    elif kind == "walk":
        x = _walk(rng, t)
    else:
        raise ValueError(f"kind: found {kind!r}, wanted one of {', '.join(KINDS)}")
    end = np.clip((time_s[-1] - 1.0 - time_s) / 1.5, 0.0, 1.0)
    begin = np.clip(t / 0.5, 0.0, 1.0)
    return np.asarray(x * begin * begin * (3.0 - 2.0 * begin) * end * end * (3.0 - 2.0 * end))


def _multisine(rng: np.random.Generator, t: Array, fastest_Hz: float) -> Array:
    """Six sines of random phase, frequencies in proportion apart."""
    tones = np.geomspace(0.07, fastest_Hz, 6) * rng.uniform(0.9, 1.1, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    x = np.sum(np.sin(2.0 * np.pi * np.outer(t, tones) + phase) / np.sqrt(1.0 + np.arange(6)), axis=1)
    return np.asarray(x / np.max(np.abs(x)))


def _sweep(rng: np.random.Generator, t: Array, fastest_Hz: float) -> Array:
    """Ramps between turning points of changing amplitude: nested loops, no two alike."""
    turns, at, side = [0.0], [0.0], 1.0
    while at[-1] < t[-1]:
        amplitude = rng.uniform(0.25, 1.0)
        at.append(at[-1] + abs(side * amplitude - turns[-1]) / rng.uniform(0.6, 4.0 * fastest_Hz))
        turns.append(side * amplitude)
        side = -side
    return np.interp(t, at, turns)


def _steps(rng: np.random.Generator, t: Array) -> Array:
    """Levels held for one to three seconds, reached within a fifth of a second."""
    x, at = np.zeros_like(t), 0.0
    level = 0.0
    while at < t[-1]:
        new = rng.uniform(-1.0, 1.0)
        share = np.clip((t - at) / 0.2, 0.0, 1.0)
        x = x + (new - level) * share * share * (3.0 - 2.0 * share)
        level, at = new, at + rng.uniform(1.0, 3.0)
    return x


def _walk(rng: np.random.Generator, t: Array) -> Array:
    """Random motion of a hand: noise through two slow filters."""
    dt = float(np.median(np.diff(t[t > 0.0]))) if np.count_nonzero(t > 0.0) > 2 else 0.025
    a = np.exp(-dt / 0.5)
    x = rng.standard_normal(t.size)
    for _ in range(2):
        x = lfilter([1.0 - a], [1.0, -a], x)
    x -= x[0]
    return np.asarray(np.tanh(x / (np.std(x) * 1.8)))


def presses(rng: np.random.Generator, time_s: Array) -> Array:
    """0 off, 1 deepest: pushes of varied depth and speed with holds, still at both ends."""
    t = time_s - time_s[0]
    at, level = [0.0, QUIET_S], [0.0, 0.0]
    while at[-1] < t[-1] - 6.0:
        depth, rise, hold, rest = rng.uniform(0.35, 1.0), rng.uniform(0.4, 1.5), rng.uniform(0.5, 2.5), rng.uniform(0.2, 0.6)
        for span, value in ((rise, depth), (hold, depth), (rng.uniform(0.4, 1.5), 0.0), (rest, 0.0)):
            at.append(at[-1] + span)
            level.append(value)
    x = np.interp(t, at, level)
    width = max(1, round(0.15 / float(t[1] - t[0])))
    return np.convolve(np.pad(x, width, mode="edge"), np.ones(width) / width, mode="same")[width:-width]


def coloured(
    rng: np.random.Generator, shape: tuple[int, int], sigma: Array, share: float, correlation_s: float, dt_s: float
) -> Array:
    """Noise (n, m) of standard deviation sigma (m,): a `share` of its energy first-order Markov, the remainder white."""
    a = np.exp(-dt_s / correlation_s)
    slow = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal((shape[0] + 400, shape[1])), axis=0)[400:]
    return np.asarray((np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.standard_normal(shape)) * sigma)


def lost(rng: np.random.Generator, n: int, share: float, burst: float) -> Array:
    """Which of n samples are lost: bursts of `burst` on average, `share` of all."""
    out, gone = np.zeros(n, bool), False
    enter = share / max(1e-9, 1.0 - share) / burst
    for i, draw in enumerate(rng.random(n)):
        gone = draw >= 1.0 / burst if gone else draw < enter
        out[i] = gone
    return out


def windows(mismatch: Array, time_s: Array) -> list[list[float]]:
    """Where the moving RMS (0.5 s) of one channel's mismatch (n,) exceeds half of its own 95th percentile.

    Gaps below 0.5 s are closed, windows below 0.3 s dropped, as docs/diagnosis.md defines windows. Times are time_s's.
    """
    dt = float(np.median(np.diff(time_s)))
    width = max(1, round(0.5 / dt))
    square = np.convolve(np.pad(np.square(mismatch), width, mode="edge"), np.ones(width) / width, mode="same")[width:-width]
    rms = np.sqrt(np.maximum(square, 0.0))
    limit = 0.5 * float(np.quantile(rms, 0.95))
    if limit <= 0.0:
        return []
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (rms > limit).astype(int), [0]))))
    found = [[float(time_s[i]), float(time_s[min(j, time_s.size - 1)])] for i, j in edges.reshape(-1, 2)]
    return tidy(found)


def tidy(spans: list[list[float]], gap_s: float = 0.5, least_s: float = 0.3) -> list[list[float]]:
    """Windows sorted, those nearer than `gap_s` joined, those shorter than `least_s` dropped."""
    joined: list[list[float]] = []
    for begin, end in sorted(spans):
        if joined and begin - joined[-1][1] < gap_s:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return [[round(b, 4), round(e, 4)] for b, e in joined if e - b >= least_s]
