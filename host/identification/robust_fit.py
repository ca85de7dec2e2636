"""Fits a shape model to markers under a robust loss: Gauss-Newton on exact sensitivities, or the thesis' simplex."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from host.identification.parameters import CatheterParameter
from host.identification.recorded_shapes import RecordedShape
from protocol.catheter import Catheter

Array = NDArray[np.float64]

STEPS = 60
END = 1e-7  # scaled step
FIRST_DAMPING = 1e-3
SMOOTHING = 1e-2  # of the loss "distance" near zero, in units of the noise scale


class ShapeModel(Protocol):
    """What a catheter model offers to the fit."""

    recordings: list[RecordedShape]
    parameters: list[CatheterParameter]

    def catheter_at(self, x: Array) -> Catheter | None:
        """The catheter with parameters `x`; None where they are out of bounds."""
        ...

    def start(self) -> Array:
        """Return the parameters (p,) from which the fit starts."""
        ...

    def scale(self) -> Array:
        """Return the natural step of each parameter (p,)."""
        ...

    def predict(self, x: Array, index: int, jacobian: bool = False) -> tuple[Array, Array] | None:
        """Markers (m, d) and, if asked, derivatives (m, d, p); None where there is no equilibrium."""
        ...


# loss of a marker's distance r in units of the noise scale: value, and weight = (d value / d r) / r
LOSSES: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "squares": (lambda r: 0.5 * r**2, np.ones_like),
    "huber": (lambda r: np.where(r <= 1.345, 0.5 * r**2, 1.345 * (r - 0.6725)), lambda r: 1.345 / np.maximum(r, 1.345)),
    "cauchy": (lambda r: 2.84 * np.log1p(r**2 / 5.68), lambda r: 1.0 / (1.0 + r**2 / 5.68)),
    "distance": (lambda r: np.sqrt(r**2 + SMOOTHING**2), lambda r: 1.0 / np.sqrt(r**2 + SMOOTHING**2)),
}


@dataclass(frozen=True)
class RobustFit:
    """Result of a search: parameters, objective and evaluations."""

    x: Array
    objective: float
    evaluations: int  # of the whole set of recordings
    seconds: float
    converged: bool
    method: str


class Objective:
    """The sum over all markers of a robust loss of their distance to the model, in units of `noise_m` per axis."""

    def __init__(self, model: ShapeModel, loss: str, noise_m: float, used: list[int] | None = None) -> None:
        self.model, self.loss, self.noise_m = model, loss, noise_m
        self.used = list(range(len(model.recordings))) if used is None else used
        self.evaluations = 0

    def __call__(self, x: Array) -> float:
        """The objective at `x`; infinite where a load has no equilibrium."""
        self.evaluations += 1
        total = 0.0
        for index in self.used:
            predicted = self.model.predict(x, index)
            if predicted is None:
                return math.inf
            recording = self.model.recordings[index]
            distance = np.linalg.norm(predicted[0] - recording.position_m, axis=1) / self.noise_m
            total += recording.weight * float(LOSSES[self.loss][0](distance).sum())
        return total

    def linearize(self, x: Array) -> tuple[float, Array, Array, list[Array]] | None:
        """Objective, gradient, Gauss-Newton matrix, and each recording's own gradient, at `x`."""
        self.evaluations += 1
        size = x.size
        total, gradient, matrix, parts = 0.0, np.zeros(size), np.zeros((size, size)), []
        for index in self.used:
            predicted = self.model.predict(x, index, jacobian=True)
            if predicted is None:
                return None
            recording = self.model.recordings[index]
            error = (predicted[0] - recording.position_m) / self.noise_m
            jacobian = predicted[1] / self.noise_m
            distance = np.linalg.norm(error, axis=1)
            value, weight_of = LOSSES[self.loss]
            weight = recording.weight * weight_of(distance)
            total += recording.weight * float(value(distance).sum())
            part = np.einsum("m,md,mdp->p", weight, error, jacobian)
            gradient += part
            matrix += np.einsum("m,mdp,mdq->pq", weight, jacobian, jacobian)
            parts.append(part)
        return total, gradient, matrix, parts


def gauss_newton(objective: Objective, start: Array, steps: int = STEPS) -> RobustFit:
    """Damped Gauss-Newton with reweighting, from `start`. The damping follows Levenberg, in the model's scale."""
    begin, before = time.perf_counter(), objective.evaluations
    scale = objective.model.scale()
    x, damping, converged = start.copy(), FIRST_DAMPING, False
    linear = objective.linearize(x)
    if linear is None:
        return RobustFit(x, math.inf, 1, time.perf_counter() - begin, False, "gauss-newton")
    value, gradient, matrix, _ = linear
    for _ in range(steps):
        scaled = matrix * np.outer(scale, scale)
        damping_term = damping * (np.diag(scaled) + 1e-9 * np.trace(scaled) / x.size)
        step = -scale * np.linalg.solve(scaled + np.diag(damping_term), scale * gradient)
        step *= min(1.0, 1.0 / max(float(np.abs(step / scale).max()), 1e-300))
        trial = objective.linearize(x + step)
        if trial is not None and trial[0] <= value:
            x = x + step
            value, gradient, matrix, _ = trial
            damping = max(damping * 0.2, 1e-12)
            if float(np.abs(step / scale).max()) < END:
                converged = True
                break
        else:
            if float(np.abs(step / scale).max()) < END:
                converged = True
                break
            damping = max(damping * 8.0, 1e-6)
            if damping > 1e12:
                break
    return RobustFit(x, value, objective.evaluations - before, time.perf_counter() - begin, converged, "gauss-newton")


def nelder_mead(objective: Objective, start: Array) -> RobustFit:
    """The thesis' search (2.3.1): the simplex of Nelder and Mead, without derivatives."""
    from scipy.optimize import minimize

    begin, before = time.perf_counter(), objective.evaluations
    scale = objective.model.scale()
    found = minimize(
        lambda u: objective(u * scale),
        start / scale,
        method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-6, "maxiter": 4000, "maxfev": 4000, "adaptive": start.size > 4},
    )
    return RobustFit(
        found.x * scale,
        float(found.fun),
        objective.evaluations - before,
        time.perf_counter() - begin,
        bool(found.success),
        "nelder-mead",
    )


def noise_scale(model: ShapeModel, x: Array) -> float:
    """Robust standard deviation per axis (m) of the markers about the model at `x`: the median distance, scaled."""
    distances, dimensions = [], 2
    for index, recording in enumerate(model.recordings):
        predicted = model.predict(x, index)
        if predicted is not None:
            distances.append(np.linalg.norm(predicted[0] - recording.position_m, axis=1))
            dimensions = recording.position_m.shape[1]
    # median of the length of a Gaussian vector of 2 or 3 parts
    median = float(np.median(np.concatenate(distances))) if distances else math.inf
    return max(median / (1.1774 if dimensions == 2 else 1.5382), 1e-9)
