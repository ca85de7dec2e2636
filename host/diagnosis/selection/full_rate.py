"""The fits on all samples of the recordings, and the errors on held-out ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import whiteness
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.selection.found import Found
from host.diagnosis.symbolic.dictionary import lay_out

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FullRate:
    """The nominal and the best fit with their residuals on all samples of the recordings."""

    nominal: Fit
    best: Fit


@dataclass
class Figures:
    """RMSE on held-out samples at full rate, per output."""

    before: Array
    after: Array
    noise_sd: Array
    white_before: Array
    white_after: Array
    primary: int


def at_full_rate(full: Problem, fit: Fit, like: Problem) -> Fit:
    """`fit` simulated on the samples of `full`."""
    for segment, coarse in zip(full.segments, like.segments, strict=True):
        segment.start = coarse.start
        if not fit.terms:
            full.model.settle(segment, fit.values)
        if segment.begin is not None and coarse.begin is not None:
            segment.begin.values = coarse.begin.values
    again = replace(fit)
    again.residuals = [full.left(segment, fit.terms, fit.values) for segment in full.segments]
    return again


def fits_at_full_rate(full: Problem, found: Found, coarse: Problem) -> FullRate:
    """Both fits on the samples of `full`, whose segments then hold the equations, and the states of the best fit."""
    nominal = at_full_rate(full, found.nominal, coarse)
    for form in found.forms:
        lay_out(full.segments, form)
    return FullRate(nominal, at_full_rate(full, found.best, coarse))


def figures_of(full: Problem, fits: FullRate) -> Figures:
    """RMS errors on held-out samples before and after, the noise, and how white the residuals are, per output."""
    rows = range(len(full.noise))
    before, after, white_b, white_a = (np.zeros(len(full.noise)) for _ in range(4))
    nominal, best = fits.nominal, fits.best
    for row in rows:
        for store, fit in ((before, nominal), (after, best)):
            store[row] = rms([r[row][p.heldout] for r, p in zip(fit.residuals, full.segments, strict=True)])
        for store, fit in ((white_b, nominal), (white_a, best)):
            masks, noise = [p.heldout for p in full.segments], full.noise[row]
            # The colour of the noise is an estimate: a residual that is white itself must not fail for a wrong one.
            coloured = whiteness([noise.whiten(r[row]) for r in fit.residuals], masks)
            white = whiteness([r[row] / noise.sigma for r in fit.residuals], masks) if noise.sigma > 0.0 else 0.0
            store[row] = max(coloured, white)
    ratio = np.where(after > 0, before / np.maximum(after, 1e-300), 1.0)
    used = np.isfinite(before) & (before > 0)
    primary = int(np.argmax(np.where(used, ratio, 0.0)))
    # The residual is noise and perhaps more: an estimate above it, of parts taken for rest, is too high.
    left = np.array([rms([r[row] for r in best.residuals]) for row in rows])
    noise_sd = np.fmin(full.noise_sd, np.where(left > 0.0, left, np.nan))
    return Figures(before, after, noise_sd, white_b, white_a, primary)


def rms(parts: list[Array]) -> float:
    """Return the RMS of all finite samples of `parts`, NaN where there are none."""
    together = np.concatenate(parts)
    together = together[np.isfinite(together)]
    return float(np.sqrt(np.mean(together**2))) if together.size else float("nan")
