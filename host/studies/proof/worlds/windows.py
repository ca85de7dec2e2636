"""How the recordings of a world are sampled and cut from motion, and what they have in common whatever moves.

Windows of 1 to 60 s are cut from motion, at 25 to 2000 Hz, with jitter and drop-outs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from host.studies.proof.worlds import signals
from host.studies.proof.worlds.case import Scales, Setup

Array = np.ndarray
LEAD_S = 3.0  # longest part of the motion that is cut off before a window, in units of the slowest period
_FINE = 400_000  # most points of a fine grid


def sampling(rng: np.random.Generator, jitter_allowed: bool = True) -> tuple[Scales, tuple[Array, ...], float]:
    """Return (scales with motion and force 1, stamps of two or three recordings, fastest excitation in Hz)."""
    rate = float(np.exp(rng.uniform(np.log(25.0), np.log(2000.0))))
    duration = float(np.exp(rng.uniform(np.log(max(1.0, 500.0 / rate)), np.log(min(60.0, 12000.0 / rate)))))
    fastest = min(rate / 20.0, float(rng.uniform(8.0, 25.0)) / duration, 12.0)
    jitter = float(rng.uniform(0.05, 0.3)) if jitter_allowed and rng.random() < 0.3 else 0.0
    count = 2 if rng.random() < 0.4 else 3
    stamps = tuple(signals.stamps(rng, rate, duration * rng.uniform(0.8, 1.0), jitter) for _ in range(count))
    slow = 1.0 / (2.0 * np.pi * fastest)
    return Scales(1.0, 1.0, 1.0 / slow, slow, duration, 1.0 / rate), stamps, fastest


def command(setup: Setup, recording: int, number: int) -> signals.Command:
    """Return the command of one channel in one recording."""
    rng = setup.stream(recording, number, 3)
    kind = signals.KINDS[int(rng.choice(3, p=[0.5, 0.3, 0.2]))]
    duration, fastest = setup.scales.duration_s, setup.style["fastest_Hz"]
    slowest = min(1.5 / duration, 0.5 * fastest)
    return signals.command(rng, kind, slowest, fastest, (-LEAD_S / slowest, duration + 1.0))


def fine_grid(setup: Setup, recording: int) -> tuple[Array, float]:
    """Return an even grid (n,) s that begins before the window, and its step."""
    last = float(setup.stamps[recording][-1])
    lead = min(6.0 * setup.scales.duration_s, max(0.5 * setup.scales.duration_s, 30.0 * setup.scales.slow_s))
    h = max(min(setup.scales.period_s / 4.0, setup.scales.slow_s / 40.0, 1e-3), (last + lead) / _FINE)
    return np.arange(-lead, last + 2.0 * h, h), h


def without(columns: Array, values: Array, fitted: int) -> Array:
    """Return what least squares on `columns` (n, k) leaves of values (n,), fitted to the first `fitted` rows."""
    size = np.linalg.norm(columns[:fitted], axis=0) + 1e-300
    found = np.linalg.lstsq(columns[:fitted] / size, values[:fitted], rcond=1e-12)[0]
    return np.asarray(values - columns / size @ found)


def split(values: Array, parts: Sequence[Array]) -> list[Array]:
    """Return values (n,) cut into the lengths of `parts`."""
    return np.split(values, np.cumsum([part.size for part in parts])[:-1])


def times(c: Scales) -> tuple[float, float, float]:
    """Return the times of `c`: slowest excitation, duration, period (s)."""
    return c.slow_s, c.duration_s, c.period_s


def channels(*names: str) -> dict[str, dict[str, str]]:
    """Return [channels] whose units are the names' endings."""
    return {name: {"column": name, "unit": name.rpartition("_")[2].replace("Nm", "N m")} for name in names}
