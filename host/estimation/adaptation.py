"""Stiffness tracked during a run (8.1.2) from the catheter's own free moments, with a detector of sudden change.

A tip pose in contact depends on force and stiffness only through their quotient, so poses in contact do not determine both.
Out of contact the shaft is an arc whatever its stiffness. How much it bends for a given knob depends on how it is driven:

    kappa = T e / EI,  T = k_w (delta - e L kappa)   so that   kappa = k_w e delta / (EI + k_w e^2 L)

with tension T, offset e and path delta of the pull-wire, its stiffness k_w, and the shaft's length L. Near the stiffness
EI_0 that the knob's curve was recorded with, kappa ~ EI^-p with p = EI_0 / (EI_0 + k_w e^2 L): 1 where the drive
sets the tension, 0 where the wire does not stretch at all. Each free pose compares the curvature that the curve gives with
the one that is there. In contact the stiffness is held, so the force estimate is never pushed by the adaptation.

The filter has two states: the logarithm x of the stiffness, a random walk, and a lasting error d of the knob's curve:

    log(kappa_curve / kappa_seen) = p x - d / kappa_seen + noise

Both show in the same way while the curvature is one value. What is known of each beforehand then divides the difference.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from host.estimation.free_shape import FreeShape
from host.estimation.sensor_noise import chi_square_limit
from protocol.catheter import Catheter, CosseratParameters, PcarParameters
from protocol.rig_file import Rig

Array = NDArray[np.float64]

FREE_DEVIATIONS = 4.0  # of the chi square of a free pose
# Of the correction: how far the exponent may be off, relative. Wires and handles of one kind scatter by about so much.
EXPONENT_SD = 0.3


@dataclass(frozen=True)
class AdaptationConfig:
    """Assumptions on drift, actuation and contact."""

    first_sd: float = 0.1  # of log stiffness before anything was seen, and its most
    drift_per_sqrt_s: float = 0.004  # random walk of log stiffness: 10 % in ten minutes
    curve_sd_per_m: float = 0.5  # of the knob's curve, lasting
    actuation_sd: float = 0.01  # relative, of the curvature at one pose
    curvature_exponent: float = 0.5
    limit: float = 0.3  # the stiffness in use stays within 1 / (1 + limit) and 1 + limit
    least_curvature_per_m: float = 5.0  # a straighter shaft does not determine the stiffness
    memory_samples: float = 20.0  # of the mean residual that finds a light, lasting contact
    settle_samples: int = 10  # free poses in a row before they are used
    confirm_samples: int = 16  # a free pose counts only when so many after it are free as well: 0.4 s of the tracker
    largest_innovation: float = 3.0  # in standard deviations: what is further out counts as this
    change_drift: float = 0.5  # of the two-sided cumulative sum, in standard deviations
    change_level: float = 12.0

    @classmethod
    def from_rig(cls, rig: Rig) -> AdaptationConfig:
        """Return the values of section [estimation] of the rig file."""
        known = rig.estimation
        return cls(
            first_sd=known.adaptation_sd,
            curve_sd_per_m=known.curvature_sd_per_m,
            curvature_exponent=known.curvature_exponent,
            limit=known.adaptation_limit,
        )


@dataclass(frozen=True)
class StiffnessState:
    """State of the adaptation after a sample. `scale` multiplies the nominal stiffness and is within the limit."""

    scale: float
    sd: float  # relative, of the scale in use
    free: bool  # a pose out of contact was used
    limited: bool  # the stiffness seems to be further off than may be used
    changed: bool  # a sudden change was detected at this sample
    samples: int  # free poses used so far
    changes: int  # sudden changes detected so far


class StiffnessTracker:
    """Kalman filter on the stiffness and the error of the knob's curve, fed by free poses only."""

    def __init__(self, config: AdaptationConfig | None = None) -> None:
        self._config = config or AdaptationConfig()
        self._mean, self._covariance = np.zeros(2), np.diag([self._config.first_sd**2, self._config.curve_sd_per_m**2])
        self._mean_residual, self._mean_weight, self._contact = np.zeros(0), 0.0, False
        self._up = self._down = 0.0
        self._in_a_row = self._samples = self._changes = 0
        self._pending: deque[tuple[float, float, float]] = deque()
        self._stamp_s: float | None = None

    def update(self, time_s: float, curvature_per_m: float, shape: FreeShape | None) -> StiffnessState:
        """Take in one sample.

        Arguments: `curvature_per_m`, what the knob's curve gives; `shape`, the unloaded shape nearest to the poses, None
        where there is none or the tip is known to be in contact. Raises: ValueError (time going back).
        """
        if self._stamp_s is not None and not time_s >= self._stamp_s:
            raise ValueError(f"time_s: found {time_s} after {self._stamp_s}, wanted a time that does not go back")
        elapsed_s = 0.0 if self._stamp_s is None else time_s - self._stamp_s
        self._stamp_s = time_s
        config = self._config
        self._covariance[0, 0] += config.drift_per_sqrt_s**2 * elapsed_s
        # Never less known than at the start, covariances scaled along.
        shrink = min(1.0, config.first_sd / math.sqrt(self._covariance[0, 0]))
        self._covariance[0, :] *= shrink
        self._covariance[:, 0] *= shrink
        if shape is None or not self._is_free(shape):
            self._in_a_row = 0
            self._pending.clear()
            return self._state(False, False)
        self._in_a_row += 1
        seen = shape.curvature_per_m
        bent = min(abs(seen), abs(curvature_per_m)) >= config.least_curvature_per_m
        if self._in_a_row < config.settle_samples or not bent or seen * curvature_per_m < 0.0:
            return self._state(False, False)
        self._pending.append((curvature_per_m, seen, shape.std_per_m))
        if len(self._pending) <= config.confirm_samples:
            return self._state(False, False)
        return self._state(True, self._measure(*self._pending.popleft()))

    def _is_free(self, shape: FreeShape) -> bool:
        config, residual = self._config, shape.whitened.ravel()
        here = shape.chi_square < chi_square_limit(shape.degrees_of_freedom, FREE_DEVIATIONS)
        if (here and self._contact) or residual.size != self._mean_residual.size:
            self._mean_residual, self._mean_weight = np.zeros(residual.size), 0.0
        self._contact = not here
        keep = 1.0 - 1.0 / config.memory_samples
        self._mean_residual = keep * self._mean_residual + (1.0 - keep) * np.clip(residual, -6.0, 6.0)
        self._mean_weight = keep**2 * self._mean_weight + (1.0 - keep) ** 2
        lasting = float(self._mean_residual @ self._mean_residual) / self._mean_weight
        return here and lasting < chi_square_limit(residual.size, FREE_DEVIATIONS)

    def _measure(self, nominal_per_m: float, seen_per_m: float, sd_per_m: float) -> bool:
        """Extended Kalman update with log(nominal / seen curvature); returns whether a sudden change was detected."""
        config = self._config
        bent = nominal_per_m * math.exp(-config.curvature_exponent * float(self._mean[0]))
        expected = bent + float(self._mean[1])
        if expected * seen_per_m <= 0.0:
            return False
        # Sensitivities at the expected curvature: at the seen one its noise would make the filter drift where x and d
        # look alike.
        by = np.array([config.curvature_exponent * bent / expected, -1.0 / expected])
        noise = (sd_per_m / expected) ** 2 + config.actuation_sd**2
        innovation = math.log(expected / seen_per_m)
        spread = float(by @ self._covariance @ by) + noise
        normal = innovation / math.sqrt(spread)
        if abs(normal) > config.largest_innovation:
            innovation *= config.largest_innovation / abs(normal)
            normal = math.copysign(config.largest_innovation, normal)
        self._up = max(0.0, self._up + normal - config.change_drift)
        self._down = max(0.0, self._down - normal - config.change_drift)
        changed = max(self._up, self._down) > config.change_level
        if changed:  # the stiffness is as open as at the start; the curve is what it was
            self._up = self._down = 0.0
            self._changes += 1
            self._covariance[0, :] = self._covariance[:, 0] = 0.0
            self._covariance[0, 0] = config.first_sd**2
            spread = float(by @ self._covariance @ by) + noise
        gain = self._covariance @ by / spread
        self._mean = self._mean + gain * innovation
        self._covariance = self._covariance - np.outer(gain, by @ self._covariance)
        self._samples += 1
        return changed

    @property
    def log_scale(self) -> float:
        """Logarithm of the stiffness in use, within the limit."""
        bound = math.log1p(self._config.limit)
        return min(max(float(self._mean[0]), -bound), bound)

    def _state(self, free: bool, changed: bool) -> StiffnessState:
        x, used = float(self._mean[0]), self.log_scale
        # What lies beyond the limit is not used, and counts as error; so does an exponent that is not the rig's.
        sd = math.sqrt(self._covariance[0, 0] + (EXPONENT_SD * used) ** 2 + (x - used) ** 2)
        return StiffnessState(math.exp(used), sd, free, x != used, changed, self._samples, self._changes)

    def adapted_curvature(self, curvature_per_m: float) -> float:
        """The unloaded curvature that the actuation gives at the stiffness in use and with the error found of its curve."""
        bent = curvature_per_m * math.exp(-self._config.curvature_exponent * self.log_scale)
        return bent + float(self._mean[1])

    def curvature_sd(self, curvature_per_m: float) -> float:
        """Standard deviation (1/m) of `adapted_curvature`: of the stiffness, of the curve, and of one pose's actuation."""
        by = np.array([-self._config.curvature_exponent * curvature_per_m, 1.0])
        one = self._config.actuation_sd * curvature_per_m
        return math.sqrt(float(by @ self._covariance @ by) + one**2)


def scaled(catheter: Catheter, scale: float) -> Catheter:
    """`catheter` with every stiffness multiplied by `scale`. Raises: ValueError."""
    if not 0.0 < scale < math.inf:
        raise ValueError(f"scale: found {scale}, wanted a positive number")
    pcar = catheter.pcar and PcarParameters(tuple(scale * EI for EI in catheter.pcar.EI_N_m2), catheter.pcar.distal_arcs_m)
    cosserat = catheter.cosserat and CosseratParameters(
        **{key: scale * value for key, value in vars(catheter.cosserat).items()}
    )
    return replace(catheter, pcar=pcar, cosserat=cosserat)
