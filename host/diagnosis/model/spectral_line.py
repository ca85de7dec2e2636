"""A line in the spectrum of a residual: a hum, a vibration or a rotating part, of another phase in each recording.

A sine over time with one phase for all recordings is a candidate effect. If each recording starts at another instant of
the disturbance, no such sine fits, and an autoregression predicts a sine as it predicts noise. The line itself shows in
every periodogram, against the level of the bins around it. A frequency at which the simulated output moves more says
nothing: the residual rings there if a parameter or a start of the nominal model is a little off. Where a square, a
cube or a magnitude of it has a line too, a nonlinear law may have made the one from the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from host.diagnosis.model.data_rules import DataRules
from host.diagnosis.model.operators import fill

Array = npt.NDArray[np.float64]
AROUND = 41  # bins of which the median is the level of the noise
FEWEST = 4 * AROUND  # samples


@dataclass(frozen=True)
class Tone:
    """A sine of `amplitude` (unit of the output) at `frequency_Hz` in the residual of every recording."""

    frequency_Hz: float
    amplitude: float


def common_line(
    residuals: Sequence[Array],
    inputs: Sequence[Sequence[Array]],
    simulated: Sequence[Array],
    periods_s: Sequence[float],
    rules: DataRules = DataRules(),
) -> Tone | None:
    """The line at one frequency in all residuals (n_i,) that no input (n_i,) of its recording has; None if there is none.

    simulated: output (n_i,) of each recording; it moves less than the residual at that frequency. rules: an effect that
    reads its start values from a residual uses the defaults.
    """
    if not residuals or min(int(np.isfinite(r).sum()) for r in residuals) < FEWEST:
        return None
    count = sum(r.size // 2 for r in residuals)
    found = []
    for r, own, said, dt_s in zip(residuals, inputs, simulated, periods_s, strict=True):
        x = fill(r)
        over = _over_level(x)
        bin_ = int(np.argmax(over))
        limit = np.log(count / rules.line_significance)
        if over[bin_] < limit or any(np.max(_over_level(fill(u))[max(bin_ - 1, 0) : bin_ + 2]) > limit for u in own):
            return None
        near = slice(max(bin_ - 2, 0), bin_ + 3)
        if np.sum(_periodogram(fill(said))[near]) > np.sum(_periodogram(x)[near]):
            return None
        found.append(_sine(x, bin_, dt_s))
    hertz = np.array([each.frequency_Hz for each in found])
    widest = max(1.0 / (r.size * dt_s) for r, dt_s in zip(residuals, periods_s, strict=True))
    amplitude = float(np.sqrt(np.mean([each.amplitude**2 for each in found])))
    share = 0.5 * amplitude**2 / float(np.nanvar(np.concatenate(residuals)))
    return Tone(float(np.mean(hertz)), amplitude) if np.ptp(hertz) < widest and share > rules.line_variance_share else None


def stands_out(x: Array, frequency_Hz: float, dt_s: float, rules: DataRules = DataRules()) -> bool:
    """Whether the spectrum of `x` (n,) has a line at `frequency_Hz`."""
    bin_ = round(frequency_Hz * x.size * dt_s)
    near = _over_level(x)[max(bin_ - 1, 0) : bin_ + 2]
    limit = float(np.log(x.size / 2 / rules.line_significance))
    return x.size >= FEWEST and near.size > 0 and float(np.max(near)) > limit


def distorted(x: Array) -> list[Array]:
    """Forms of a signal (n,), itself among them, whose lines a nonlinear law makes of those of the signal."""
    centred = fill(x) - np.mean(fill(x))
    speed = np.gradient(centred)
    return [centred, centred**2, centred**3, np.abs(centred), np.sign(speed), speed * np.abs(speed)]


def _over_level(x: Array) -> Array:
    """Periodogram of `x` (n,) over the level around each bin: exponential of mean 1 for noise. Ends say nothing."""
    power = _periodogram(x)
    level = median_filter(power, AROUND, mode="nearest") / np.log(2.0)
    over = power / np.maximum(level, 1e-300)
    over[:3] = over[-2:] = 0.0
    return np.asarray(over)


def _periodogram(x: Array) -> Array:
    return np.asarray(np.abs(np.fft.rfft((x - np.mean(x)) * np.hanning(x.size))) ** 2)


def _sine(x: Array, bin_: int, dt_s: float) -> Tone:
    """The sine near bin `bin_` that takes most of `x` (n,)."""
    t, x = np.arange(x.size) * dt_s, x - np.mean(x)
    tried = (bin_ + np.linspace(-1.0, 1.0, 81)) / (x.size * dt_s)
    sizes = np.array([2.0 / x.size * abs(np.exp(-2j * np.pi * f * t) @ x) for f in tried])
    best = int(np.argmax(sizes))
    return Tone(float(tried[best]), float(sizes[best]))
