"""Robust fits to sine sweeps: backlash and slope of an axis, dead zones and curve of the knob (thesis 6.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

from protocol.errors import InputError

Array = NDArray[np.float64]
Z95 = 1.959964
# Longest delay between encoder and pose that a fit may find, and how well the stamps are trusted beforehand (s).
MAX_DELAY_S, STAMPS_WITHIN_S = 0.03, 0.005
_HUBER_SIGMA = 2.0


class Estimate(NamedTuple):
    """A value and the half width of its 95 % interval, in the same unit."""

    value: float
    half95: float

    @property
    def low(self) -> float:
        """Return the lower end of the 95 % interval."""
        return self.value - self.half95

    @property
    def high(self) -> float:
        """Return the upper end of the 95 % interval."""
        return self.value + self.half95


class Run(NamedTuple):
    """One sweep of one axis: encoder (n,) at `encoder_s` (n,), what the catheter did (k,) at `time_s` (k,); seconds from
    the sweep's begin, `rate_rad_per_s` its sine."""

    encoder_s: Array
    encoder: Array
    time_s: Array
    output: Array
    amplitude: float
    rate_rad_per_s: float

    def input_at(self, delay_s: float = 0.0) -> Array:
        """Return the encoder (k,) `delay_s` before the times of the outputs."""
        return np.interp(self.time_s - delay_s, self.encoder_s, self.encoder)


class PlayFit(NamedTuple):
    """output = slope * play(input) + offset. `per_run` (n, 2): width and slope of each run alone, as the thesis means
    them."""

    width: Estimate
    slope: Estimate
    offset: Estimate
    delay_s: float
    per_run: Array
    noise: float


class KnobFit(NamedTuple):
    """Dead zones and gains: `edges_rad` are lower stop, lower and upper end of the slack, upper stop; gains in 1/m per
    rad."""

    edges_rad: tuple[Estimate, Estimate, Estimate, Estimate]
    gains_per_m_rad: tuple[Estimate, Estimate]
    rest_curvature_per_m: Estimate
    delay_s: float
    knob_rad: Array
    curvature_per_m: Array


@njit(cache=True)
def play(inputs: Array, width: float, start: float) -> Array:
    """Apply the play operator of `width` to `inputs` (n,), from `start` on; the output follows the side that pushes it."""
    out, y = np.empty_like(inputs), start
    for i in range(inputs.size):
        y = min(max(y, inputs[i] - 0.5 * width), inputs[i] + 0.5 * width)
        out[i] = y
    return out


def _after_first_turn(run: Run) -> Run:
    """Return the run from its first extreme on: before it, the position of the catheter within the gap is not known."""
    keep = run.time_s >= 0.5 * np.pi / run.rate_rad_per_s
    return run._replace(time_s=run.time_s[keep], output=run.output[keep])


def _robust_sigma(residual: Array) -> float:
    return max(float(1.4826 * np.median(np.abs(residual - np.median(residual)))), 1e-12)


def _solve(
    residuals: Callable[[Array], Array], start: Array, scale: Array, sigma: float, low: Array, high: Array
) -> tuple[Array, Array, float]:
    """(solution, covariance, noise) of a soft-L1 fit. Steps of the numeric Jacobian: 1e-4 of each parameter's scale."""

    def scaled(x: Array) -> Array:
        return residuals(x * scale)

    found = least_squares(
        scaled,
        start / scale,
        bounds=(low / scale, high / scale),
        loss="soft_l1",
        f_scale=_HUBER_SIGMA * sigma,
        x_scale=1.0,
        diff_step=1e-4,
    )
    noise = _robust_sigma(residuals(found.x * scale))
    normal = found.jac.T @ found.jac
    covariance = noise**2 * np.linalg.pinv(normal)
    return found.x * scale, covariance * np.outer(scale, scale), noise


def fit_play(runs: Sequence[Run], max_width: float, sigma: float, with_width: bool = True) -> PlayFit:
    """Width, slope, offset and delay common to all `runs` (Figs. 6.3 to 6.6).

    Arguments: max_width, greatest width looked for; sigma, expected noise of one output; both in the output's unit.
    with_width: False fixes the width at zero. Raises InputError where a run has no sample after its first turn.
    """
    late = [_after_first_turn(run) for run in runs]
    if any(run.time_s.size < 8 for run in late):
        raise InputError.from_sentence(
            "sweep: found fewer than 8 poses after its first turn, wanted a longer sweep or a tracker that sees it"
        )

    def model(run: Run, x: Array) -> Array:
        given = run.input_at(x[3])
        return x[1] * play(given, abs(x[0]), given[0] - 0.5 * abs(x[0])) + x[2]

    def residuals_of(chosen: Sequence[Run]) -> Callable[[Array], Array]:
        return lambda x: np.concatenate([*(model(run, x) - run.output for run in chosen), [sigma * x[3] / STAMPS_WITHIN_S]])

    amplitude = max(run.amplitude for run in late)
    swing = np.mean([np.ptp(run.output) / (2 * run.amplitude) for run in late])
    centre = np.mean([0.5 * (run.output.max() + run.output.min()) for run in late])
    start = np.array([0.2 * max_width if with_width else 0.0, swing, centre, 0.0])
    scale = np.array([max_width, 1.0, amplitude, 0.01])
    high = np.array([max_width if with_width else 1e-9 * max_width, 10.0, np.inf, MAX_DELAY_S])
    low = np.array([0.0, 0.0, -np.inf, -MAX_DELAY_S])
    start = np.clip(start, low, high - 1e-10 * np.isfinite(high))
    x, covariance, noise = _solve(residuals_of(late), start, scale, sigma, low, high)
    alone = []
    low[3], high[3] = x[3] - 1e-7, x[3] + 1e-7
    for run in late:
        y, _, _ = _solve(residuals_of([run]), np.clip(x, low, high - 1e-10), scale, sigma, low, high)
        alone.append([y[0], y[1]])
    per_run = np.array(alone)
    half = Z95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if len(alone) > 1:
        half[:2] = np.maximum(half[:2], Z95 * per_run.std(axis=0, ddof=1) / np.sqrt(len(alone)))
    return PlayFit(
        Estimate(float(x[0]), float(half[0])),
        Estimate(float(x[1]), float(half[1])),
        Estimate(float(x[2]), float(half[2])),
        float(x[3]),
        per_run,
        noise,
    )


def dead_zone_curvature(knob_rad: Array, x: Array) -> Array:
    """Curvature (n,) 1/m; x: four edges (rad), lower and upper gain (1/m per rad), curvature at rest (1/m)."""
    below = np.clip(knob_rad, x[0], x[1]) - x[1]
    above = np.clip(knob_rad, x[2], x[3]) - x[2]
    return x[6] + x[4] * below + x[5] * above


def fit_knob(runs: Sequence[Run], sigma_per_m: float) -> KnobFit:
    """Dead zones, gains and the monotone curve of knob sweeps whose output is curvature (1/m) (Fig. 6.8).

    Raises InputError for sweeps that do not bend the catheter.
    """

    def given(delay_s: float) -> Array:
        return np.concatenate([run.input_at(delay_s) for run in runs])

    output = np.concatenate([run.output for run in runs])
    start = _edges_by_eye(given(0.0), output)

    def residuals(x: Array) -> Array:
        return dead_zone_curvature(given(x[7]), x) - output

    scale = np.array([1.0, 0.1, 0.1, 1.0, 30.0, 30.0, 1.0, 0.01])
    low = np.array([-np.inf, -np.inf, -np.inf, -np.inf, 0.0, 0.0, -np.inf, -MAX_DELAY_S])
    x, covariance, noise = _solve(
        residuals, np.array([*start, 0.0]), scale, sigma_per_m, low, np.array([np.inf] * 7 + [MAX_DELAY_S])
    )
    half = Z95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    e = [Estimate(float(value), float(width)) for value, width in zip(x, half, strict=True)]
    knob = given(x[7])
    places, curve = _monotone_curve(knob, output, x[:4], noise)
    return KnobFit((e[0], e[1], e[2], e[3]), (e[4], e[5]), e[6], float(x[7]), places, curve)


def _edges_by_eye(knob: Array, curvature: Array) -> Array:
    """A first guess: stops where the curvature has reached 97 % of its range, slack where it is within 3 % of rest."""
    low, high = np.percentile(curvature, (0.5, 99.5))
    if not high - low > 0.5:
        raise InputError.from_sentence(
            f"knob sweep: found curvatures from {low:.2f} to {high:.2f} 1/m, wanted a catheter that bends"
        )
    rest = float(np.median(curvature[np.abs(knob - np.median(knob)) < 0.03 * np.ptp(knob)]))
    upper, lower = knob[curvature > rest + 0.97 * (high - rest)], knob[curvature < rest + 0.97 * (low - rest)]
    still = knob[np.abs(curvature - rest) < 0.03 * (high - low)]
    e0, e3 = float(np.percentile(lower, 90)), float(np.percentile(upper, 10))
    e1, e2 = float(np.percentile(still, 15)), float(np.percentile(still, 85))
    return np.array([e0, e1, e2, e3, (rest - low) / max(e1 - e0, 0.1), (high - rest) / max(e3 - e2, 0.1), rest])


def _monotone_curve(knob: Array, curvature: Array, edges: Array, noise: float) -> tuple[Array, Array]:
    """Places (rad) and curvatures (1/m) of a piecewise linear curve that never falls, by least squares with Huber weights.

    Knots: the ends of the sweep, the four edges, and five in each bending part, so that a curved part keeps its shape.
    """
    e0, e1, e2, e3 = edges
    places = np.unique(np.concatenate([[knob.min()], np.linspace(e0, e1, 7), np.linspace(e2, e3, 7), [knob.max()]]))
    places = places[(places >= knob.min()) & (places <= knob.max())]
    steps = np.diff(places)
    ramps = np.clip((knob[:, None] - places[:-1]) / steps, 0.0, 1.0)
    design = np.column_stack([np.ones_like(knob), ramps])
    low = np.concatenate([[-np.inf], np.zeros(len(steps))])
    weight = np.ones_like(knob)
    for _ in range(4):
        root = np.sqrt(weight)
        solution = lsq_linear(design * root[:, None], curvature * root, bounds=(low, np.inf)).x
        size = np.abs(design @ solution - curvature)
        weight = np.minimum(1.0, _HUBER_SIGMA * noise / np.maximum(size, 1e-12))
    return places, solution[0] + np.concatenate([[0.0], np.cumsum(solution[1:])])
