"""Sensor noise from the quiescent parts of a recording: level, colour, wild samples. Never from the residual to explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.rules import RULES, SelectionRules
from host.diagnosis.model.operators import fill, quantum

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
ORDER = 3


class NoiseSource(Enum):
    """What the noise of a channel was estimated from; the value is its name in a report."""

    QUIESCENT = "quiescent parts"
    SHORT_RESTS = "quiescent parts, too short for slow noise"  # its level in them is less than elsewhere
    REPEATS = "differences between repeats"
    RESOLUTION = "resolution"  # at rest, or between repeats, the reading changes by less than one of its steps
    CONSTANT = "constant readings"  # these do not change at all and have no steps: computed, or stuck
    SPECTRUM = "quietest part of the spectrum (no quiescent part)"
    BALANCE = "spectra of motion and force above the motion's band"
    LEARNED = "while learning"  # of the live watch: the scatter of the residual before a change

    @property
    def seen_alone(self) -> bool:
        """Whether samples of noise without any motion were recorded, so that the level is measured and not a guess."""
        return self in (NoiseSource.QUIESCENT, NoiseSource.REPEATS, NoiseSource.RESOLUTION)


@dataclass(frozen=True)
class Noise:
    """Noise of one channel: `sigma` in its unit, `ar` (p,) coefficients of e[t] = sum ar[k] e[t-1-k] + w, and its source."""

    sigma: float
    ar: Array
    source: NoiseSource

    @property
    def correlation_samples(self) -> float:
        """Integrated autocorrelation time in samples (1 for white noise)."""
        gain = 1.0 - float(np.sum(self.ar))
        flat = float(np.sum(autocovariance_of(self.ar)[:1]))
        return float(np.clip(1.0 / (gain * gain * flat), 1.0, 1e4)) if gain > 0 and flat > 0 else 1.0

    def whiten(self, residual: Array) -> Array:
        """Innovations of `residual` (n,) under this noise, in units of their own standard deviation; NaN next to
        missing samples.
        """
        out = residual.copy()
        for k, a in enumerate(self.ar):
            out[k + 1 :] -= a * residual[: -k - 1]
        out[: self.ar.size] = np.nan
        return out / (self.sigma / np.sqrt(autocovariance_of(self.ar)[0]))


def autocovariance_of(ar: Array, length: int = 400) -> Array:
    """Autocovariance at lag 0 of the process with unit innovations, by its impulse response. Shape (1,)."""
    response = np.zeros(length)
    response[0] = 1.0
    for t in range(1, length):
        for k in range(min(ar.size, t)):
            response[t] += ar[k] * response[t - 1 - k]
    return np.array([float(response @ response)])


def quiescent(inputs: list[Array], dt_s: float, timed: bool, rules: SelectionRules = RULES) -> Mask:
    """Samples at which no input has moved (beyond resolution and a small share of range) for half a second around them.

    rules: a nominal model that prepares a recording uses the defaults.
    """
    half = max(5, round(0.25 / dt_s)) if timed else 5
    still = np.ones(inputs[0].size, dtype=bool)
    for values in inputs:
        line = fill(values)
        span = np.ptp(line)
        limit = max(rules.rest_resolution_steps * quantum(values), rules.rest_range_share * span)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(line, half, mode="edge"), 2 * half + 1)
        still &= (windows.max(axis=1) - windows.min(axis=1)) <= limit
    return still


def runs(mask: Mask, shortest: int) -> list[slice]:
    """Stretches of True at least `shortest` long."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= shortest]


def repeated(inputs: list[list[Array]], rules: SelectionRules) -> list[tuple[int, slice, int, slice]]:
    """Stretches in which all inputs of one recording repeat those of another, or its own of a period before.

    inputs: of each recording, its channels (n_i,). Returns (recording, samples, recording, samples) of each pair.
    """
    found = []
    for a in range(len(inputs)):
        for b in range(a, len(inputs)):
            lag = _lag(inputs[a][0], inputs[b][0], rules, own=a == b)
            if lag is None:
                continue
            first = slice(max(lag, 0), min(inputs[a][0].size, inputs[b][0].size + lag))
            second = slice(first.start - lag, first.stop - lag)
            alike = first.stop - first.start >= rules.input_repeat_samples and all(
                _same(x[first], y[second], rules) for x, y in zip(inputs[a], inputs[b], strict=True)
            )
            if alike:
                found.append((a, first, b, second))
    return found


def _lag(x: Array, y: Array, rules: SelectionRules, own: bool) -> int | None:
    """Samples by which `x` (n,) comes after `y` (m,) where both run alike best; of one channel with itself, its period."""
    x, y = fill(x) - np.mean(fill(x)), fill(y) - np.mean(fill(y))
    if not np.any(x) or not np.any(y):
        return None
    size = 1 << int(np.ceil(np.log2(x.size + y.size)))
    across = np.fft.irfft(np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size)), size)
    most = min(x.size, y.size) // 2
    if not own:
        order = np.concatenate((np.arange(most), np.arange(-most, 0)))
        return int(order[np.argmax(across[order])])
    below = np.flatnonzero(across[:most] < 0.5 * across[0])
    if not below.size:
        return None
    mean = across[:most] / (x.size - np.arange(most)) * x.size / across[0]
    high = mean[1:-1] > rules.input_period_correlation
    peaks = np.flatnonzero((mean[1:-1] >= mean[:-2]) & (mean[1:-1] >= mean[2:]) & high) + 1
    near = [lag for peak in peaks[peaks > below[0]] for lag in range(peak - 2, peak + 3)]
    return next((int(lag) for lag in near if _same(x[lag:], x[:-lag], rules)), None)


def _same(x: Array, y: Array, rules: SelectionRules) -> bool:
    x, y = fill(x), fill(y)
    return float(np.std(x - y)) <= rules.input_repeat_deviation * float(np.std(x)) and float(np.std(x)) > 0.0


def estimate(
    outputs: list[Array],
    still: list[Mask],
    repeats: Sequence[tuple[int, slice, int, slice]] = (),
    simulated: bool = False,
    rules: SelectionRules = RULES,
) -> Noise:
    """Noise of one channel from several recordings: of its quiescent parts, else of what does not repeat.

    outputs: (n_i,) of each recording; still: its quiescent samples; repeats: stretches that repeat others (`repeated`).
    simulated: whether the output is that of a simulator, which may be slow. rules: a nominal model that prepares a
    recording uses the defaults.
    """
    stretches = [
        values[part]
        for values, mask in zip(outputs, still, strict=True)
        for part in runs(mask & np.isfinite(values), rules.rest_shortest_samples)
    ]
    segments = []
    for segment in _settled(stretches, rules):
        line = np.polynomial.polynomial.polyfit(np.arange(segment.size), segment, 1)
        segments.append(segment - np.polynomial.polynomial.polyval(np.arange(segment.size), line))
    step = max((quantum(values) for values in outputs), default=0.0)
    noise_sd = step / np.sqrt(12.0)
    source = NoiseSource.QUIESCENT
    if sum(segment.size for segment in segments) < rules.rest_fewest_samples:
        differences = [(outputs[a][p] - outputs[b][q]) / np.sqrt(2.0) for a, p, b, q in repeats]
        segments = [
            d[part] - np.mean(d[part]) for d in differences for part in runs(np.isfinite(d), rules.input_repeat_samples)
        ]
        source = NoiseSource.REPEATS
    if not segments:
        return _of_spectrum(outputs, noise_sd, rules)
    table = []
    for segment in segments:
        spread = 1.4826 * np.median(np.abs(segment - np.median(segment))) + 1e-300
        tame = np.clip(segment, -5 * spread, 5 * spread) if spread > 1e-200 else segment
        table.append([tame[: tame.size - k] @ tame[k:] / (tame.size - 2.0) for k in range(ORDER + 1)])
    lags = _typical(np.array(table), np.array([segment.size for segment in segments]))
    sigma = float(np.sqrt(max(lags[0], 0.0)))
    # A slow plant is on its way while its input rests: what remains of a straight line is smooth and far above white noise.
    smooth = lags[1] > rules.under_way_correlation * lags[0]
    if (
        simulated
        and source is NoiseSource.QUIESCENT
        and smooth
        and sigma > rules.under_way_over_noise * _high_frequency(outputs, rules)
    ):
        return _of_spectrum(outputs, noise_sd, rules)
    if sigma <= noise_sd:
        source = NoiseSource.RESOLUTION if noise_sd > 0.0 else NoiseSource.CONSTANT
        return Noise(max(noise_sd, 1e-300), np.zeros(0), source)
    if source is NoiseSource.QUIESCENT and _slow_for(segments, rules):
        source = NoiseSource.SHORT_RESTS
    return Noise(sigma, autoregression(lags), source)


def _slow_for(rests: list[Array], rules: SelectionRules) -> bool:
    """Whether noise at rest, stretches (n_i,) less a straight line each, is so slow that the line took a part of it."""
    independent = sum(rest.size for rest in rests) / sum(correlation_time(rest) for rest in rests)
    return independent < rules.rest_independent_samples


def _of_spectrum(outputs: list[Array], resolution: float, rules: SelectionRules) -> Noise:
    """Noise of which no sample was seen alone."""
    level = max(_high_frequency(outputs, rules), resolution, 1e-300)
    return Noise(level, np.zeros(0), NoiseSource.SPECTRUM)


def _settled(stretches: list[Array], rules: SelectionRules) -> list[Array]:
    """Without their first halves as long as these vary far more than the second ones, as they do where the inputs stand
    but the output is still on its way; too few to judge by are left as they are.
    """
    while len(stretches) >= 4:
        halves = [(segment[: segment.size // 2], segment[segment.size // 2 :]) for segment in stretches]
        ratios = [np.var(first) / (np.var(second) + 1e-300) for first, second in halves]
        if np.median(ratios) < rules.settling_variance_ratio:
            break
        stretches = [second for _, second in halves if second.size >= rules.rest_shortest_samples]
    return stretches


def _typical(table: Array, sizes: Array) -> Array:
    """Mean of the autocovariances (segments, lags), by size, over the segments of middling level: one that holds a jump
    does not count.
    """
    order = np.argsort(table[:, 0])
    place = (np.cumsum(sizes[order]) - 0.5 * sizes[order]) / sizes.sum()
    middle = order[(place > 0.15) & (place < 0.85)] if order.size > 3 else order[: max(1, order.size - 1)]
    middle = middle if middle.size else order
    return np.asarray(np.average(table[middle], axis=0, weights=sizes[middle]))


def autoregression(lags: Array) -> Array:
    """Coefficients (p,) of the autoregressive process with the autocovariances `lags` (p + 1,)."""
    from scipy.linalg import solve_toeplitz

    damped = lags.copy()
    damped[0] *= 1.0 + 1e-6
    return np.asarray(solve_toeplitz(damped[:-1], damped[1:]))


def innovations(lines: list[Array], order: int) -> list[Array]:
    """Innovations (n_i - order,) of one autoregression of all recordings, in robust standard deviations."""
    a = predictor(lines, order)
    new = [prediction_error(r, a)[order:] for r in lines]
    together = np.concatenate(new)
    spread = 1.4826 * float(np.median(np.abs(together - np.median(together)))) + 1e-300
    return [e / spread for e in new]


def predictor(lines: list[Array], order: int) -> Array:
    """Coefficients (order,) of one autoregression of all `lines` (n_i,)."""
    return autoregression(np.array([sum(float(r[: r.size - k] @ r[k:]) for r in lines) for k in range(order + 1)]))


def prediction_error(x: Array, weights: Array) -> Array:
    """What the p samples before each of `x` (n,) do not predict of it: (n,), of which the first p are zero.

    weights: (p,), of the nearest sample first.
    """
    error = x - np.convolve(x, np.concatenate(([0.0], weights)))[: x.size]
    error[: weights.size] = 0.0
    return np.asarray(error)


def correlation_time(r: Array, longest: int | None = None) -> float:
    """Integrated autocorrelation time (samples) of `r` (n,), NaN where not used; summed while pairs of lags stay
    positive (Geyer 1992).
    """
    good = np.isfinite(r)
    n = int(good.sum())
    if n < 20:
        return 1.0
    x = np.where(good, r, 0.0)
    size = 1 << int(np.ceil(np.log2(2 * x.size)))
    power = np.abs(np.fft.rfft(x, size)) ** 2
    count = np.fft.irfft(np.abs(np.fft.rfft(good.astype(float), size)) ** 2, size)[: x.size]
    covariance = np.fft.irfft(power, size)[: x.size] / np.maximum(count, 1.0)
    if covariance[0] <= 0.0:
        return 1.0
    rho = covariance / covariance[0]
    limit = min(longest or x.size // 3, x.size // 3)
    total = 1.0
    for k in range(1, limit, 2):
        pair = rho[k] + (rho[k + 1] if k + 1 < limit else 0.0)
        if pair <= 0.03:
            break
        total += 2.0 * pair
    return float(np.clip(total, 1.0, n / 4.0))


def _high_frequency(outputs: list[Array], rules: SelectionRules) -> float:
    """Standard deviation of white noise as strong as the quietest twentieth of the spectrum, or as the middling third
    difference, whichever is less.

    A mean of few periodograms scatters, and its quietest twentieth lies below the noise even if that is white: it is
    put where a twentieth of chi-squared is (Welch 1967). Jumps, such as those of dry friction, raise the whole spectrum;
    they leave the median of the differences as it is.
    """
    from scipy.signal import welch
    from scipy.stats import chi2

    spread = []
    for values in outputs:
        if np.count_nonzero(np.isfinite(values)) > 64:
            line = fill(values)
            size = min(256, line.size // 4)
            freedom = 2.0 * (1 + (line.size - size) // (size - size // 2))
            _, power = welch(line, fs=1.0, nperseg=size, window="blackman")
            low = chi2.ppf(rules.quietest_share, freedom) / freedom
            level = float(np.sqrt(0.5 * np.quantile(power[1:-1], rules.quietest_share) / low))
            steps = np.diff(line, 3)
            if np.mean(steps == 0.0) < rules.held_reading_share:
                level = min(level, 1.4826 * float(np.median(np.abs(steps))) / np.sqrt(20.0))
            spread.append(level)
        elif np.count_nonzero(np.isfinite(values)) > 8:  # too short for a spectrum: third differences of what is smooth
            steps = np.diff(fill(values), 3)
            spread.append(1.4826 * np.median(np.abs(steps)) / np.sqrt(20.0))
    return float(np.median(spread)) if spread else 0.0


def by_steps(x: Array, sigma: float, correlation: float, longest: int = 8) -> tuple[float, float]:
    """Noise of `x` (n,) by its steps over 1 ... `longest` samples: standard deviation and correlation time (samples), no
    less than given.

    Half the mean square of a step over k samples is sigma^2 (1 - rho_k); medians, so that the few large steps of a
    mismatch do not count.
    """
    good = x[np.isfinite(x)]
    if good.size < 10 * longest:
        return sigma, correlation
    size = np.array([np.median(np.abs(good[k:] - good[:-k])) for k in range(1, longest + 1)]) * 1.4826 / np.sqrt(2.0)
    level = float(np.max(size))
    if level <= sigma:
        return sigma, correlation
    rho = 1.0 - (size / level) ** 2
    first = int(np.argmax(rho < 0.05)) if np.any(rho < 0.05) else longest
    return level, max(correlation, 1.0 + 2.0 * float(np.sum(rho[:first])))
