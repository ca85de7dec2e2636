"""Whether a residual is coloured noise: its level alone is no evidence where noise was never seen alone.

The quietest part of a spectrum bounds white noise only. Floor vibration, 1/f noise of a bridge or a sensor with a filter
exceed it by any factor. Such noise is a stationary process with innovations that neither jump, nor repeat, nor depend on
an input. Each is tested on the innovations e of an autoregression of the residual r:

    e[t] = r[t] - sum_k a_k r[t - k],  k = 1..ORDER
    jumps:   |e| in units of its robust standard deviation
    lines:   the periodogram of e over its own level (Fisher's test: exponential under the hypothesis)
    inputs:  the coherence of e with inputs, their squares, magnitudes and directions (Welch; Carter 1987)

A residual with few independent samples is not judged: a slow wander cannot be separated from physics that drifts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import correlation_time
from host.diagnosis.estimation.noise import autoregression
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
ORDER = 20  # of the autoregression
FEWEST = 30.0  # independent samples of all recordings together, from which on a residual is judged
SIGNIFICANCE = 1e-3  # of each test, over all its bins, samples and features
LONGEST = 512  # samples of a part of a recording, of which at least
AVERAGES = 8  # of a recording estimate a coherence: 1 - (p)^(1 / (parts - 1)) is exceeded by chance with p (Carter 1987)


def only_coloured(residuals: Sequence[Array], inputs: Sequence[Sequence[Array]]) -> bool:
    """Whether residuals (n_i,) of recordings are coloured noise that no input (n_i,) of its recording explains."""
    pairs = [(r, u) for r, u in zip(residuals, inputs, strict=True) if np.isfinite(r).sum() >= 20 * ORDER]
    if not pairs:
        return False
    lines = [fill(r) - np.nanmean(r) for r, _ in pairs]
    if sum(r.size / correlation_time(r) for r in lines) < FEWEST:
        return False
    new = _innovations(lines)
    return not (_jump(new) or _repeat(new) or _follow(new, [u for _, u in pairs]))


def _innovations(lines: list[Array]) -> list[Array]:
    """Innovations (n_i - ORDER,) of one autoregression of all recordings, in robust standard deviations."""
    lags = np.array([sum(float(r[: r.size - k] @ r[k:]) for r in lines) for k in range(ORDER + 1)])
    a = autoregression(lags)
    new = [r[ORDER:] - np.column_stack([r[ORDER - k - 1 : r.size - k - 1] for k in range(ORDER)]) @ a for r in lines]
    together = np.concatenate(new)
    spread = 1.4826 * float(np.median(np.abs(together - np.median(together)))) + 1e-300
    return [e / spread for e in new]


def _jump(new: list[Array]) -> bool:
    """Whether an innovation is larger than that of a normal process may be."""
    from scipy.stats import norm

    count = sum(e.size for e in new)
    return max(float(np.max(np.abs(e))) for e in new) > float(norm.isf(0.5 * SIGNIFICANCE / count))


def _repeat(new: list[Array]) -> bool:
    """Whether a line stands out of the spectrum of the innovations."""
    for e in new:
        power = np.abs(np.fft.rfft(e - np.mean(e)))[1:-1] ** 2
        if np.max(power) > np.mean(power) * np.log(power.size * len(new) / SIGNIFICANCE):
            return True
    return False


def _follow(new: list[Array], inputs: Sequence[Sequence[Array]]) -> bool:
    """Whether the innovations are coherent with a feature of an input."""
    from scipy.signal import csd, welch

    channels = min((len(u) for u in inputs), default=0)
    tests = channels * len(_features(new[0]))
    for channel in range(channels):
        tables = [_features(fill(u[channel])[ORDER:]) for u in inputs]
        for feature in range(len(tables[0])):
            by_length: dict[int, list[Array]] = {}
            for e, table in zip(new, tables, strict=True):
                size = min(LONGEST, e.size // AVERAGES)
                x = table[feature]
                if np.ptp(x) == 0.0:
                    continue
                given = {"nperseg": size, "noverlap": 0, "detrend": "constant"}  # parts that overlap are not independent
                sums = np.array([welch(x, **given)[1], welch(e, **given)[1], csd(x, e, **given)[1]])
                by_length.setdefault(size, []).append(sums * (e.size // size))
            for size, sums_ in by_length.items():
                xx, ee, xe = np.sum(sums_, axis=0)
                coherence = np.abs(xe[1:-1]) ** 2 / np.maximum((xx * ee)[1:-1].real, 1e-300)
                parts = sum(e.size // size for e in new if min(LONGEST, e.size // AVERAGES) == size)
                limit = 1.0 - (SIGNIFICANCE / (tests * coherence.size)) ** (1.0 / max(parts - 1, 1))
                if np.max(coherence) > limit:
                    return True
    return False


def _features(u: Array) -> list[Array]:
    """Forms of an input (n,) that a missing effect may follow."""
    x = (u - np.mean(u)) / (np.std(u) + 1e-300)
    return [x, x * x, np.abs(x), x**3, np.sign(np.gradient(x)), np.abs(np.gradient(x))]
