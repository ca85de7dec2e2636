"""Calibration: fit, confidence, identifiability and leave-one-out error, in one report."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from host.identification.parameters import CatheterParameter
from host.identification.robust_fit import Objective, RobustFit, ShapeModel, gauss_newton, nelder_mead, noise_scale
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

UNDETERMINED_STD = 0.5  # relative standard deviation beyond which a parameter counts as not determined by the data
NOTHING_KNOWN_STD = 10.0  # relative standard deviation that stands for "nothing is known"
ROUNDS = 4  # of scale and fit in turns


@dataclass(frozen=True)
class FittedParameter:
    """One parameter with its 95 % interval; `determined` is False where the data leave it open."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    determined: bool


@dataclass(frozen=True)
class UndeterminedDirection:
    """A combination of parameters that the data leave open: a change along it hardly moves a marker."""

    combination: dict[str, float]  # unit vector in relative parameters
    relative_std: float


@dataclass(frozen=True)
class LeftOut:
    """Error on a recording that the fit has not seen."""

    recording: int
    rms_m: float
    max_m: float
    tip_m: float


@dataclass(frozen=True)
class Calibration:
    """The calibrated catheter, its parameters with intervals, and how well they explain the recordings."""

    catheter: Catheter  # the start catheter with the fitted values
    x: Array
    parameters: list[FittedParameter]
    fits: list[RobustFit]  # on the same objective
    noise_m: float  # robust, per axis
    rms_m: float
    max_m: float
    outliers: list[tuple[int, int]]  # (recording, marker) beyond four standard deviations
    singular_values: Array  # of the scaled sensitivities, largest first
    undetermined: list[UndeterminedDirection]
    left_out: list[LeftOut]
    recordings: int  # how many were fitted


def calibrate_model(
    model: ShapeModel, loss: str = "huber", method: str = "gauss-newton", leave_one_out: bool = True
) -> Calibration:
    """Fit `model` to its recordings.

    Arguments: `loss`, a key of `LOSSES`; `method`, gauss-newton, nelder-mead or both (the answer is then that of
    Gauss-Newton). Result: `Calibration`. Source: 2.3.1 and (2.20), with robust loss, exact sensitivities and
    statistics added. Raises: InputError where the start has no equilibrium.
    """
    x = model.start()
    if not math.isfinite(Objective(model, loss, 1.0)(x)):
        found = "start values under which a recorded load has no equilibrium"
        raise InputError("catheter", found, "stiffer ones")
    objective = Objective(model, loss, noise_scale(model, x))
    search = nelder_mead if method == "nelder-mead" else gauss_newton
    fit = search(objective, x)
    for _ in range(ROUNDS):
        noise = noise_scale(model, fit.x)
        if abs(noise / objective.noise_m - 1.0) < 1e-3:
            break
        objective = Objective(model, loss, noise)
        fit = search(objective, fit.x)
    fits = [fit]
    if method == "both":
        fits = [search(objective, x) for search in (gauss_newton, nelder_mead)]
        fit = fits[0]
    parameters, singular, undetermined = _confidence(model, objective, fit.x)
    rms, largest, outliers = _errors(model, fit.x, objective.noise_m)
    left_out = _leave_one_out(model, objective, fit.x) if leave_one_out and len(model.recordings) > 1 else []
    catheter = model.catheter_at(fit.x)
    assert catheter is not None  # the fit's own values have an equilibrium
    return Calibration(
        catheter,
        fit.x,
        parameters,
        fits,
        objective.noise_m,
        rms,
        largest,
        outliers,
        singular,
        undetermined,
        left_out,
        len(model.recordings),
    )


def _confidence(
    model: ShapeModel, objective: Objective, x: Array
) -> tuple[list[FittedParameter], Array, list[UndeterminedDirection]]:
    """Intervals from the sandwich over recordings (the markers of one shape err together), and undetermined directions."""
    from scipy.stats import t as student

    names, linear = model.parameters, objective.linearize(x)
    assert linear is not None
    _, _, matrix, parts = linear
    scale = model.scale()
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    # a direction without any effect gets the information of `NOTHING_KNOWN_STD`, however small the noise
    values = np.where(values > 1e-12 * float(values.max()), values, 0.0)
    known = np.maximum(values, NOTHING_KNOWN_STD**-2)
    inverse = (vectors / known) @ vectors.T * np.outer(scale, scale)
    scores = np.array(parts)
    count, size = scores.shape
    sandwich = inverse @ (scores.T @ scores) @ inverse * (count / max(count - 1, 1))
    # few recordings say little about how they scatter: never narrower than independent markers would make it
    variance = np.maximum(np.diag(sandwich), np.diag(inverse))
    quantile = float(student.ppf(0.975, max(count - size, 1))) if count > 1 else 12.7
    relative = np.sqrt(np.diag(inverse)) / scale
    fitted = [
        _interval(names[i], x[i], math.sqrt(variance[i]) * quantile, relative[i] < UNDETERMINED_STD) for i in range(size)
    ]
    undetermined = [
        UndeterminedDirection(
            {names[i].name: float(vectors[i, k]) for i in range(size) if abs(vectors[i, k]) > 0.1},
            float(1.0 / math.sqrt(known[k])),
        )
        for k in range(size)
        if 1.0 / math.sqrt(known[k]) > UNDETERMINED_STD
    ]
    return fitted, np.sqrt(values[::-1]), undetermined


def _interval(of: CatheterParameter, x: float, half: float, determined: bool) -> FittedParameter:
    low, high = x - half, x + half
    if of.logarithmic:
        x, low, high = (math.exp(min(max(value, -700.0), 700.0)) for value in (x, low, high))
    return FittedParameter(of.name, of.unit, float(x), float(low), float(high), bool(determined))


def _errors(model: ShapeModel, x: Array, noise_m: float) -> tuple[float, float, list[tuple[int, int]]]:
    squares, largest, outliers = [], 0.0, []
    for index, recording in enumerate(model.recordings):
        predicted = model.predict(x, index)
        if predicted is None:
            continue
        distance = np.linalg.norm(predicted[0] - recording.position_m, axis=1)
        squares.append(distance**2)
        largest = max(largest, float(distance.max()))
        outliers += [(index, int(j)) for j in np.flatnonzero(distance > 4.0 * noise_m * math.sqrt(2.0))]
    return float(np.sqrt(np.mean(np.concatenate(squares)))), largest, outliers


def _leave_one_out(model: ShapeModel, objective: Objective, x: Array) -> list[LeftOut]:
    found = []
    for index, recording in enumerate(model.recordings):
        others = [k for k in range(len(model.recordings)) if k != index]
        fit = gauss_newton(Objective(model, objective.loss, objective.noise_m, others), x)
        predicted = model.predict(fit.x, index)
        if predicted is None:
            found.append(LeftOut(index, math.inf, math.inf, math.inf))
            continue
        distance = np.linalg.norm(predicted[0] - recording.position_m, axis=1)
        tip = int(np.argmin(recording.offset_m))
        found.append(LeftOut(index, float(np.sqrt(np.mean(distance**2))), float(distance.max()), float(distance[tip])))
    return found
