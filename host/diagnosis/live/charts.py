"""Sequential test of a residual against what was usual: cumulative sums of log-likelihood ratios (CUSUM).

For each output four charts run, each S <- max(0, S + l) with the log-likelihood ratio l of a sample between a disturbed
and a usual residual (Page 1954):

- the innovations of the residual, whitened by an autoregression, have a larger scale;
- the residual itself has a larger scale;
- its mean has moved up, or down.

The residual is correlated, so the ratios of the last three count for 1/tau of a sample, tau its correlation time. "Usual" is
not one point: the levels are known from n/tau independent samples only, and they differ between phases of a job. The usual
hypothesis therefore lies at the edge of what is tolerated, `SURE` standard errors of the learned level beyond it, and a
residual within it drives every chart to zero.

An alarm comes at S > h. If the ratios are those of independent samples, the mean time to a false alarm is at least exp(h)
samples (Lorden 1971), so h = log(charts * samples an hour / rate) keeps all charts together below `rate` false alarms an
hour. How many there really are has to be measured: docs/live.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from host.diagnosis.estimation.noise import autoregression, correlation_time

Array = npt.NDArray[np.float64]
ORDER = 3  # of the autoregression
KINDS = 4  # charts for each output
SURE = 2.0  # standard errors by which a learned level may be too small
LEAST_INDEPENDENT = 30.0  # from fewer samples the level of a slow residual is not known: its innovations alone are judged
FARTHEST = 4.0  # levels to which one sample counts: a wild reading is not a mismatch
MEMORY = 1.5  # of the threshold: a chart rises no further, so that it comes down soon after the mismatch has gone


@dataclass(frozen=True)
class ChartSettings:
    """Hypotheses, in units of the usual level. An effect of twice the usual residual is to be reported within seconds."""

    usual_scale: float = 1.15
    disturbed_scale: float = 2.0
    usual_mean: float = 0.5
    disturbed_mean: float = 1.5
    false_alarms_per_hour: float = 0.01


@dataclass(frozen=True)
class Usual:
    """The usual residual of each output: mean, RMS about it, correlation time, autoregression (rows, ORDER), innovations."""

    mean: Array
    rms: Array
    correlation: Array  # samples
    ar: Array
    innovation: Array  # standard deviation
    independent: Array  # samples that this was learned from, their correlation taken out

    @classmethod
    def of(cls, residual: Array, least: float = 1e-9) -> Usual:
        """Estimate from `residual` (rows, n), NaN where nothing was measured."""
        mean = np.nanmean(residual, axis=1)
        r = residual - mean[:, None]
        rms = np.maximum(np.sqrt(np.nanmean(r**2, axis=1)), least)
        ar = np.array([_autoregression(row) for row in r])
        whitened = innovations(r, ar)
        innovation = np.maximum(np.sqrt(np.nanmean(whitened**2, axis=1)), least)
        # A slow residual looks faster than it is in few seconds: the longer of two estimates, by the autoregression too.
        of_model = (innovation / rms / np.maximum(1.0 - np.sum(ar, axis=1), 1e-3)) ** 2
        tau = np.maximum([correlation_time(row) for row in r], of_model)
        return cls(mean, rms, tau, ar, innovation, np.sum(np.isfinite(r), axis=1) / tau)


def _autoregression(r: Array) -> Array:
    good = np.isfinite(r)
    x = np.where(good, r, 0.0)
    lags = np.array([float(x[k:] @ x[: x.size - k]) for k in range(ORDER + 1)]) / max(int(good.sum()), 1)
    return autoregression(lags) if lags[0] > 0.0 else np.zeros(ORDER)


def innovations(r: Array, ar: Array) -> Array:
    """Residual (rows, n) less what the samples before predict; NaN for the first ones and after missing ones."""
    out = r.copy()
    for k in range(ar.shape[1]):
        out[:, k + 1 :] -= ar[:, k, None] * r[:, : -k - 1]
    out[:, : ar.shape[1]] = np.nan
    return out


@njit(cache=True)
def _cumulate(sums: Array, begun: npt.NDArray[np.int64], steps: Array, most: float, first: int) -> None:
    """Add `steps` (KINDS, rows, n) to `sums`, which stay between 0 and `most`; note where each left zero."""
    for i in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            for k in range(steps.shape[2]):
                if sums[i, j] <= 0.0:
                    begun[i, j] = first + k
                sums[i, j] = min(max(sums[i, j] + steps[i, j, k], 0.0), most)


class Charts:
    """State of all charts. `take` moves them on by new samples; `score` above 1 is an alarm."""

    def __init__(self, usual: Usual, period_s: float, settings: ChartSettings | None = None) -> None:
        self.usual, self.settings = usual, settings or ChartSettings()
        charts = KINDS * usual.mean.size
        self.threshold = math.log(charts * 3600.0 / period_s / self.settings.false_alarms_per_hour)
        doubt = np.sqrt(1.0 / np.maximum(usual.independent, 1.0))
        self._scale_doubt = (1.0 + SURE * np.sqrt(0.5) * doubt)[:, None]  # standard error of an RMS, and of a mean
        self._mean_doubt = (SURE * doubt)[:, None]
        self._sums = np.zeros((KINDS, usual.mean.size))
        self._begun = np.full(self._sums.shape, -1, dtype=np.int64)  # sample at which each chart last left zero
        self._last = np.full((usual.mean.size, ORDER), np.nan)
        self.samples = 0

    @property
    def score(self) -> Array:
        """Largest chart of each output (rows,), relative to the threshold."""
        return np.asarray(np.max(self._sums, axis=0) / self.threshold)

    @property
    def since(self) -> int:
        """Sample at which the chart that is highest left zero: the likeliest begin of a change (Page 1954)."""
        return int(self._begun.ravel()[int(np.argmax(self._sums))])

    def take(self, residual: Array) -> None:
        """Move on by `residual` (rows, n), NaN where nothing was measured."""
        r = residual - self.usual.mean[:, None]
        whole = np.hstack((self._last, r))
        steps = self._ratios(r / self.usual.rms[:, None], innovations(whole, self.usual.ar)[:, ORDER:])
        _cumulate(self._sums, self._begun, steps, MEMORY * self.threshold, self.samples)
        self.samples += r.shape[1]
        self._last = whole[:, -ORDER:]

    def _ratios(self, z: Array, e: Array) -> Array:
        """Log-likelihood ratios (KINDS, rows, n) of standardized residuals and innovations; 0 where one is missing."""
        s = self.settings
        white = np.clip(e / self.usual.innovation[:, None], -FARTHEST, FARTHEST)
        z = np.clip(z / self._scale_doubt, -FARTHEST, FARTHEST)
        step, middle = s.disturbed_mean - s.usual_mean, 0.5 * (s.disturbed_mean + s.usual_mean) + self._mean_doubt
        weight = np.where(self.usual.independent >= LEAST_INDEPENDENT, 1.0 / self.usual.correlation, 0.0)[:, None]
        ratios = (
            self._of_scale(white),
            self._of_scale(z) * weight,
            step * (z - middle) * weight,
            step * (-z - middle) * weight,
        )
        return np.nan_to_num(np.array(ratios), nan=0.0)

    def _of_scale(self, z: Array) -> Array:
        low, high = self.settings.usual_scale, self.settings.disturbed_scale
        return np.asarray(0.5 * z * z * (low**-2 - high**-2) - math.log(high / low))
