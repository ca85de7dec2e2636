"""Force at the tip from poses along the catheter: the six sensor cases of chapter 5, weighted, with covariance and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics.catheter import Catheter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseSensor:
    """One measured pose. Covariances (3, 3) are optional; None means the tracker's data sheet (0.29 mm, 0.2 deg per axis)."""

    offset_m: float  # arc length back from the tip
    position_m: ArrayLike  # (3,) base frame
    quaternion_wxyz: ArrayLike  # (4,) sensor frame -> base frame
    position_covariance_m2: ArrayLike | None = None  # base frame
    orientation_covariance_rad2: ArrayLike | None = None  # sensor frame


@dataclass(frozen=True)
class SurfacePrior:
    """The contact's surface: the force is along `normal` (base frame) up to a tangential part of that standard deviation."""

    normal: ArrayLike
    tangential_std_N: float


@dataclass(frozen=True)
class ForceEstimate:
    """Force, how sure, and whether to believe it (see `estimate_cosserat`)."""

    force_N: Array  # (3,)
    force_frame: str  # "tip"
    covariance_N2: Array  # (3, 3)
    converged: bool
    residual: float  # dimensionless, cost of chapter 5 at the answer: sqrt(|position error|^2 / l^2 + |rotation error|^2)
    iterations: int
    chi_square: float  # weighted squared residual; expected value = degrees_of_freedom
    degrees_of_freedom: int
    warnings: tuple[str, ...]
    weakest_direction: Array  # (3,) unit vector in the tip frame
    weakest_std_N: float
    solutions_N: Array  # (k, 3) every force found that explains the poses (k = 1 for cases 2, 4, 6)
    contact_offset_m: float  # where the force acts, back from the tip (0 unless it was asked for)
    contact_offset_std_m: float


def estimate_cosserat(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    case: int,
    sensors: Sequence[PoseSensor],
    *,
    previous_force_N: ArrayLike | None = None,
    prior: SurfacePrior | None = None,
    roll_rad: float = 0.0,
) -> ForceEstimate:
    """Signature fixed; the body follows. Raises ValueError("key: found X, wanted Y") for bad input."""
    raise NotImplementedError
