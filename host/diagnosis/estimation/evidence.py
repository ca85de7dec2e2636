"""Gain of a model on held-out samples with coloured residuals: sample size, log-likelihood, paired blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import stats

from host.diagnosis.estimation.feedback import freed
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.model import Segment

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PairedBlocks:
    """What independent blocks of samples gained, one array for each output; tested where a decision asks for it."""

    by_output: Sequence[Array]
    rules: SelectionRules

    @cached_property
    def p_value(self) -> float:
        """The smaller of: all outputs together, and the surest output times their number (Bonferroni)."""
        if not self.by_output:
            return 1.0
        together = _sign_of_mean(np.concatenate(self.by_output), self.rules)
        alone = min(_sign_of_mean(blocks, self.rules) for blocks in self.by_output)
        return float(min(1.0, together, alone * len(self.by_output))) if len(self.by_output) > 1 else together


@dataclass(frozen=True)
class Gain:
    """Gain in log-likelihood, and the share of the error that went, in the output that gained most.

    `paired`: blocks that tell whether there is a gain, or the p-value that there is none. `excess`: share of that output's
    error before that is above noise; `excesses` (outputs,): the same afterwards. `independent` and `log_ratio` (outputs,):
    effective sample sizes, and logarithms of the ratio of mean squares.
    """

    log_likelihood: float
    paired: PairedBlocks | float
    share: float
    excess: float = 1.0
    independent: Array = field(default_factory=lambda: np.zeros(0))
    log_ratio: Array = field(default_factory=lambda: np.zeros(0))
    excesses: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def p_value(self) -> float:
        """One-sided p-value that there is no gain."""
        return self.paired if isinstance(self.paired, float) else self.paired.p_value


def compare(
    segments: list[Segment], which: str, before: list[Array], after: list[Array], noise_sd: Array, rules: SelectionRules
) -> Gain:
    """Gain of `after` over `before` (residuals per segment, (outputs, n)) on samples `which` (`fit`, `heldout` or `both`).

    Gaussian likelihood with the level left free, N / 2 log(MSE) each output, where N counts independent samples only: it
    is divided by
    the correlation time of what the better model leaves. `noise_sd` (outputs,): standard deviations below which nothing is
    gained; nor below the scatter that the steps of a reading make. Noise that a controller sent back into the input is
    taken off both (`feedback.py`); shares are of the whole error.
    """
    raw_before, raw_after = before, after
    before, after = _freed(segments, before), _freed(segments, after)
    independent, log_ratio, excess, excess_after = (np.zeros(noise_sd.size) for _ in range(4))
    by_output: list[Array] = []
    for row in range(noise_sd.size):
        b2, a2, n_eff, times = _pooled(segments, which, before, after, row)
        if n_eff < rules.evidence_independent_samples:
            continue
        steps = max((float(s.resolution[row]) for s in segments if s.resolution is not None), default=0.0)
        least = 1e-6 * noise_sd[row] ** 2
        level_b, level_a = max(b2, steps**2) + least, max(a2, steps**2) + least
        independent[row], log_ratio[row] = n_eff, np.log(level_b / level_a)
        excess[row] = max(0.0, 1.0 - noise_sd[row] ** 2 / level_b)
        excess_after[row] = max(0.0, 1.0 - rules.excess_noise_ratio * noise_sd[row] ** 2 / level_a)
        by_output.append(np.array(_blocks(segments, which, before, after, row, times, level_a)))
    gain = 0.5 * float(independent @ log_ratio)
    top = int(np.argmax(independent * log_ratio))
    share = float(1.0 - np.exp(-log_ratio[top]))
    if before is not raw_before:
        b2, a2, _, _ = _pooled(segments, which, raw_before, raw_after, top)
        share, excess[top] = 1.0 - a2 / max(b2, 1e-300), max(0.0, 1.0 - noise_sd[top] ** 2 / max(b2, 1e-300))
    return Gain(gain, PairedBlocks(by_output, rules), share, float(excess[top]), independent, log_ratio, excess_after)


def _freed(segments: list[Segment], residuals: list[Array]) -> list[Array]:
    """Residuals without the noise that later input says; the same list where no output is fed back."""
    if not any(basis is not None for segment in segments for basis in segment.fed_back):
        return residuals
    return [
        np.vstack([freed(segment, row, values) for row, values in enumerate(r)])
        for segment, r in zip(segments, residuals, strict=True)
    ]


def asked(segment: Segment, which: str) -> Mask:
    """Samples (n,) of a recording to `fit`, those `heldout`, or `both`."""
    return np.asarray(segment.fit | segment.heldout) if which == "both" else np.asarray(getattr(segment, which))


def _pooled(
    segments: list[Segment], which: str, before: list[Array], after: list[Array], row: int
) -> tuple[float, float, float, list[float]]:
    sum_b = sum_a = count = n_eff = 0.0
    times = []
    for segment, b, a in zip(segments, before, after, strict=True):
        mask = asked(segment, which) & np.isfinite(b[row]) & np.isfinite(a[row])
        n = int(mask.sum())
        if n < 20:
            times.append(1.0)
            continue
        tau = correlation_time(np.where(mask, a[row], np.nan))
        times.append(tau)
        sum_b += float(np.sum(b[row][mask] ** 2))
        sum_a += float(np.sum(a[row][mask] ** 2))
        count += n
        n_eff += n / tau
    return sum_b / max(count, 1.0), sum_a / max(count, 1.0), n_eff, times


def _blocks(
    segments: list[Segment], which: str, before: list[Array], after: list[Array], row: int, times: list[float], level: float
) -> list[float]:
    found = []
    for segment, b, a, tau in zip(segments, before, after, times, strict=True):
        mask = asked(segment, which) & np.isfinite(b[row]) & np.isfinite(a[row])
        gained = (b[row][mask] ** 2 - a[row][mask] ** 2) / level
        length = int(max(4.0 * tau, gained.size / 24.0, 8.0))
        parts = max(1, gained.size // length)
        if gained.size >= 20:
            found += [float(np.sum(part)) for part in np.array_split(gained, parts)]
    return found


def _sign_of_mean(blocks: Array, rules: SelectionRules) -> float:
    """One-sided p-value that independent blocks do not gain: the smaller of t test and signed ranks (blocks of unlike
    size), doubled.
    """
    if blocks.size < rules.evidence_blocks:
        return 0.5 if blocks.size == 0 or np.mean(blocks) <= 0 else rules.few_blocks_p_value
    spread = np.std(blocks) + 1e-300
    t = np.mean(blocks) / (spread / np.sqrt(blocks.size))
    by_mean = stats.t.sf(t, blocks.size - 1)
    by_rank = stats.wilcoxon(blocks, alternative="greater").pvalue if np.any(blocks != 0.0) else 1.0
    return float(np.clip(2.0 * min(by_mean, by_rank), 1e-300, 1.0))


def whiteness(residuals: list[Array], masks: list[Mask], lags: int = 25) -> float:
    """p-value that whitened residuals (each (n,), unit variance if the model is right) are white with no more than noise
    power.

    Ljung-Box over `lags`, pooled over recordings, together with a chi-square test of the level; the smaller p-value,
    doubled.
    """
    q = dof = power = count = 0.0
    for r, mask in zip(residuals, masks, strict=True):
        good = mask & np.isfinite(r)
        n = int(good.sum())
        if n < 4 * lags:
            continue
        x = np.where(good, r - np.mean(r[good]), 0.0)
        c0 = float(x @ x) / n
        if c0 <= 0.0:  # exact: a model without noise
            continue
        for k in range(1, lags + 1):
            pairs = int(np.sum(good[k:] & good[:-k]))
            rho = float(x[k:] @ x[:-k]) / max(pairs, 1) / c0
            q += rho * rho * pairs
        dof += lags
        power += float(np.sum(r[good] ** 2))
        count += n
    if count == 0:
        return 1.0
    kurtosis = 3.0
    level = stats.norm.sf((power / count - 1.0) / np.sqrt((kurtosis - 1.0) / count))
    return float(min(1.0, 2.0 * min(stats.chi2.sf(q, dof), level)))
