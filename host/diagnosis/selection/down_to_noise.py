"""Whether a simulation explains all recordings down to the white noise of their readings.

A free mass integrates every force twice. Its simulated position follows a recording down to the noise of single readings
only if no force, delay or second mass is missing. The force that a measured motion needs is a far weaker test, because it
holds the noise of the second derivative. Forces that were not recorded, and noise of the recorded force, let the simulation
run away: then the forces have to be compared.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from host.diagnosis.estimation.evidence import whiteness
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.estimation.rules import SelectionRules
from host.diagnosis.model.model import Segment
from host.diagnosis.model.operators import fill, white_level

Array = npt.NDArray[np.float64]


def at_white_noise(problem: Problem, fit: Fit) -> bool:
    """Whether the residual of `fit` is no larger than the noise in the upper half of each output's spectrum, and white.

    A reading in steps is explained if its residual is no larger than that of rounding. The residual of a model with effects
    need not be white.
    """
    rules = problem.rules
    levels = [_levels(segment, r, rules) for segment, r in zip(problem.segments, fit.residuals, strict=True)]
    if fit.terms:
        return all(bool(np.all(level <= rules.simulated_over_noise)) for level in levels)
    if not all(bool(np.all(level <= rules.simulated_over_noise_nominal)) for level in levels):
        return False
    for row in range(len(problem.noise)):
        rounded = [_rms(r[row]) <= _rounding(s, rules)[row] for s, r in zip(problem.segments, fit.residuals, strict=True)]
        scaled = [
            r[row] / (rules.simulated_over_noise_nominal * white_level(fill(s.y[row])))
            for s, r, coarse in zip(problem.segments, fit.residuals, rounded, strict=True)
            if not coarse
        ]
        if whiteness(scaled, [np.isfinite(r) for r in scaled]) < rules.simulated_whiteness:
            return False
    return True


def ran_away(problem: Problem, fit: Fit) -> bool:
    """Whether the residual of the nominal `fit` is beyond what single effects leave, in every recording."""
    return all(
        bool(np.any(_levels(segment, r, problem.rules) > problem.rules.ran_away_over_noise))
        for segment, r in zip(problem.segments, fit.residuals, strict=True)
    )


def _levels(segment: Segment, residuals: Array, rules: SelectionRules) -> Array:
    """Residual RMS over white noise, of each output (outputs,)."""
    rounding = _rounding(segment, rules)
    noise = [max(white_level(fill(y)), coarse, 1e-300) for y, coarse in zip(segment.y, rounding, strict=True)]
    return np.array([_rms(r) for r in residuals]) / np.array(noise)


def _rounding(segment: Segment, rules: SelectionRules) -> Array:
    """RMS of the residual that rounding of each output (outputs,) explains."""
    if segment.resolution is None:
        return np.zeros(len(segment.y))
    return rules.simulated_over_rounding * segment.resolution


def _rms(r: Array) -> float:
    good = r[np.isfinite(r)]
    return float(np.sqrt(np.mean(good**2))) if good.size else 0.0
