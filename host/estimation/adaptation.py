"""Stiffness tracked during a run (8.1.2) from the catheter's own free moments, with a detector of sudden change.

A tip pose in contact depends on force and stiffness only through their quotient, so poses in contact do not determine both.
Out of contact the shaft is a circular arc whatever its stiffness, and its curvature is tension times offset over EI: each
free pose compares the curvature that the actuation should give with the one that is there. In contact the stiffness
is held, so the force estimate is never pushed by the adaptation.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation.planar import tip_covariance
from host.mechanics.pcar import arcs_of, kinematic_jacobian, point_at
from protocol.catheter import Catheter, CosseratParameters, PcarParameters

Array = NDArray[np.float64]

FIT_STEPS = 8


@dataclass(frozen=True)
class AdaptationConfig:
    """What is assumed of drift, actuation and contact."""

    drift_per_sqrt_s: float = 0.004  # random walk of log stiffness: 10 % in ten minutes
    first_std: float = 0.05  # of log stiffness before anything was seen
    actuation_std: float = 0.01  # relative, of the curvature that the actuation should give
    curvature_exponent: float = 1.0  # curvature ~ stiffness^-exponent: 1 for a given tension, less for a given wire
    least_curvature_per_m: float = 5.0  # a straighter shaft does not determine the stiffness
    free_chi_square: float = 13.8  # of two degrees of freedom: one free pose in a thousand is taken for contact
    memory_samples: float = 20.0  # of the mean residual that finds a light, lasting contact
    settle_samples: int = 10  # free poses in a row before they are used
    confirm_samples: int = 5  # a free pose counts only when so many after it are free as well
    largest_innovation: float = 3.0  # in standard deviations: what is further out counts as this
    change_drift: float = 0.5  # of the two-sided cumulative sum, in standard deviations
    change_level: float = 12.0
    change_std: float = 0.1  # uncertainty of log stiffness after a detected change


@dataclass(frozen=True)
class StiffnessState:
    """What is known after a sample. `scale` multiplies the catheter's nominal stiffness."""

    scale: float
    std: float  # of log scale
    free: bool  # this pose was out of contact and was used
    changed: bool  # a sudden change was detected at this sample
    samples: int  # free poses used so far


class StiffnessTracker:
    """Random-walk Kalman filter on the log of the stiffness scale, fed by free poses only."""

    def __init__(
        self, catheter: Catheter, covariance: ArrayLike | None = None, config: AdaptationConfig | None = None
    ) -> None:
        self._catheter = catheter
        self._covariance = tip_covariance() if covariance is None else np.asarray(covariance, dtype=float)
        self._root = np.linalg.inv(np.linalg.cholesky(self._covariance))
        self._config = config or AdaptationConfig()
        self._log_scale, self._variance = 0.0, self._config.first_std**2
        self._mean_residual, self._mean_weight, self._contact = np.zeros(2), 0.0, False
        self._up = self._down = 0.0
        self._in_a_row = self._samples = 0
        self._pending: deque[tuple[float, float]] = deque()
        self._stamp_s: float | None = None

    def update(self, time_s: float, insertion_m: float, curvature_per_m: float, pose: ArrayLike) -> StiffnessState:
        """Takes in one sample.

        Arguments: `curvature_per_m`, what the actuation should give at nominal stiffness (tension times offset over
        EI); `pose` (3,) tip x, y (m), angle (rad), NaN where it is missing. Raises: ValueError (time going back, range).
        """
        if self._stamp_s is not None and not time_s >= self._stamp_s:
            raise ValueError(f"time_s: found {time_s} after {self._stamp_s}, wanted a time that does not go back")
        elapsed_s = 0.0 if self._stamp_s is None else time_s - self._stamp_s
        self._stamp_s = time_s
        self._variance += self._config.drift_per_sqrt_s**2 * elapsed_s
        measured = np.asarray(pose, dtype=float)
        if measured.shape != (3,) or not np.isfinite(measured).all():
            return self._state(False, False)
        curvature, deviation, residual = self._free_curvature(insertion_m, curvature_per_m, measured)
        if not self._is_free(residual):
            self._in_a_row = 0
            self._pending.clear()
            return self._state(False, False)
        self._in_a_row += 1
        bent = min(abs(curvature), abs(curvature_per_m)) >= self._config.least_curvature_per_m
        if self._in_a_row < self._config.settle_samples or not bent or curvature * curvature_per_m < 0.0:
            return self._state(False, False)
        self._pending.append((math.log(curvature_per_m / curvature), deviation / curvature))
        if len(self._pending) <= self._config.confirm_samples:
            return self._state(False, False)
        return self._state(True, self._measure(*self._pending.popleft()))

    def _free_curvature(self, insertion_m: float, start: float, pose: Array) -> tuple[float, float, Array]:
        """Curvature of the unloaded arc nearest to the pose, its standard deviation, and the whitened residual across
        it (2,), standard normal when free.
        """
        curvature = start
        for _ in range(FIT_STEPS):
            arcs = arcs_of(self._catheter, insertion_m, curvature)
            position, angle = point_at(arcs, arcs.unloaded_curvature_per_m, arcs.total_length_m)
            by = self._root @ (kinematic_jacobian(arcs, arcs.unloaded_curvature_per_m) @ arcs.distal)
            error = self._root @ (pose - np.array([*position, angle]))
            step = float(by @ error / (by @ by))
            curvature += step
            if abs(step) < 1e-9:
                break
        across = np.linalg.qr(by[:, None], mode="complete")[0][:, 1:]
        # the same sense at every sample, so that residuals of a lasting contact add up in the mean
        across *= np.where(across[np.argmax(np.abs(across), axis=0), [0, 1]] < 0.0, -1.0, 1.0)
        return curvature, 1.0 / math.sqrt(float(by @ by)), across.T @ error

    def _is_free(self, residual: Array) -> bool:
        config = self._config
        here = float(residual @ residual) < config.free_chi_square
        if here and self._contact:
            self._mean_residual, self._mean_weight = np.zeros(2), 0.0
        self._contact = not here
        keep = 1.0 - 1.0 / config.memory_samples
        self._mean_residual = keep * self._mean_residual + (1.0 - keep) * np.clip(residual, -6.0, 6.0)
        self._mean_weight = keep**2 * self._mean_weight + (1.0 - keep) ** 2
        lasting = float(self._mean_residual @ self._mean_residual) / self._mean_weight
        return here and lasting < config.free_chi_square

    def _measure(self, log_ratio: float, relative_std: float) -> bool:
        """Kalman update with log(nominal / measured curvature); returns whether a sudden change was detected."""
        config = self._config
        slope = config.curvature_exponent
        noise = relative_std**2 + config.actuation_std**2
        innovation = log_ratio - slope * self._log_scale
        spread = slope**2 * self._variance + noise
        normal = innovation / math.sqrt(spread)
        if abs(normal) > config.largest_innovation:
            innovation *= config.largest_innovation / abs(normal)
            normal = math.copysign(config.largest_innovation, normal)
        self._up = max(0.0, self._up + normal - config.change_drift)
        self._down = max(0.0, self._down - normal - config.change_drift)
        changed = max(self._up, self._down) > config.change_level
        if changed:
            self._up = self._down = 0.0
            self._variance = max(self._variance, config.change_std**2)
            spread = slope**2 * self._variance + noise
        gain = slope * self._variance / spread
        self._log_scale += gain * innovation
        self._variance *= 1.0 - gain * slope
        self._samples += 1
        return changed

    def _state(self, free: bool, changed: bool) -> StiffnessState:
        return StiffnessState(math.exp(self._log_scale), math.sqrt(self._variance), free, changed, self._samples)

    def adapted(self) -> Catheter:
        """The catheter with its stiffness as tracked so far."""
        return scaled(self._catheter, math.exp(self._log_scale))

    def adapted_curvature(self, curvature_per_m: float) -> float:
        """The unloaded curvature that the actuation gives at the tracked stiffness."""
        return curvature_per_m * math.exp(-self._config.curvature_exponent * self._log_scale)


def scaled(catheter: Catheter, scale: float) -> Catheter:
    """`catheter` with every stiffness multiplied by `scale`. Raises: ValueError."""
    if not 0.0 < scale < math.inf:
        raise ValueError(f"scale: found {scale}, wanted a positive number")
    pcar = catheter.pcar and PcarParameters(tuple(scale * EI for EI in catheter.pcar.EI_N_m2), catheter.pcar.distal_arcs_m)
    cosserat = catheter.cosserat and CosseratParameters(
        **{key: scale * value for key, value in vars(catheter.cosserat).items()}
    )
    return replace(catheter, pcar=pcar, cosserat=cosserat)
