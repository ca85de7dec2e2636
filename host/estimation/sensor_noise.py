"""Uncertainty of the poses: the tracker's noise, and the whitening of the residuals of each sensor case."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation.spatial_kernels import UNIT_TOLERANCE
from host.mechanics.rod import finite
from host.mechanics.rotations import conjugate, quaternion_product, rotation_matrix
from protocol.errors import InputError
from protocol.rig_file import Rig

Array = NDArray[np.float64]

POSITION_STD_m = 0.29e-3  # NDI Aurora, per axis
ORIENTATION_STD_rad = math.radians(0.2)


class PoseSensor(NamedTuple):
    """One measured pose; the covariances may be left out, then they are the tracker's data sheet."""

    offset_m: float  # arc length back from the tip
    position_m: ArrayLike  # (3,) base frame
    quaternion_wxyz: ArrayLike  # (4,) sensor frame -> base frame
    position_covariance_m2: ArrayLike | None = None  # (3, 3) base frame
    orientation_covariance_rad2: ArrayLike | None = None  # (3, 3) sensor frame


class TrackedSensors(NamedTuple):
    """The sensors of a rig, one at the tip, one on the shaft and perhaps a third, and the tracker's noise."""

    shaft_offset_m: float  # arc length from the tip back to the second sensor
    position_std_m: float  # per axis
    angle_std_rad: float  # per axis
    rear_offset_m: float | None = None  # arc length from the tip back to the third sensor; None: there is none

    @classmethod
    def from_rig(cls, rig: Rig) -> TrackedSensors:
        """Return the sensors and the noise of the rig file's tracker."""
        tracker = rig.tracker
        _, shaft_m, *rear_m = tracker.tool_offsets_m
        return cls(shaft_m, tracker.position_noise_m, tracker.orientation_noise_rad, *rear_m)


@dataclass(frozen=True)
class SurfacePrior:
    """A surface with little friction: the force is along its normal, except for a tangential part.

    normal: (3,) in the base frame, (2,) for the planar model, either sense; tangential_std_N: standard deviation of the
    force along the surface.
    """

    normal: ArrayLike
    tangential_std_N: float


def checked_covariance(key: str, value: ArrayLike | None, std: float) -> Array:
    """Covariance (3, 3), the default where None. Raises InputError where it is not symmetric and positive definite."""
    if value is None:
        return std * std * np.eye(3)
    matrix = finite(key, value, (3, 3), "a covariance: 3 x 3, symmetric, positive definite")
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InputError(key, matrix.tolist(), "a covariance: 3 x 3, symmetric, positive definite")
    return matrix


def checked_quaternion(key: str, value: ArrayLike) -> Array:
    """Unit quaternion (4,), brought to length one exactly. Raises InputError where its length is off by more than 1e-3."""
    q = finite(key, value, (4,), "four finite numbers (w, x, y, z)")
    norm = float(np.linalg.norm(q))
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise InputError(key, q.tolist(), f"a quaternion of unit length, not {norm:.6g}")
    return q / norm


def residual_covariance(case: int, quaternions: Array, positions_cov: Sequence[Array], turns_cov: Sequence[Array]) -> Array:
    """Covariance (m, m) of the residuals of a case, in the order of `spatial_residuals.residuals`.

    Arguments: quaternions (k, 4) measured; covariances (3, 3) of the sensors, positions in the base frame, turns in the
    sensor's frame. Cases 5 and 6 compare with sensor 0: its noise is in all of their residuals, which are therefore
    correlated; leaving that out costs accuracy.
    """
    if case <= 4:
        blocks = [positions_cov[0]] if case <= 2 else [positions_cov[0] + positions_cov[1]]
        blocks += turns_cov[:1] if case == 2 else turns_cov[:2] if case == 4 else []
        out: Array = np.zeros((3 * len(blocks), 3 * len(blocks)))
        for i, block in enumerate(blocks):
            out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
        return out
    others = case - 4
    out = np.kron(np.ones((others, others)), turns_cov[0]).astype(np.float64)
    for j in range(1, others + 1):
        R = rotation_matrix(quaternion_product(conjugate(quaternions[0]), quaternions[j]))
        out[3 * j - 3 : 3 * j, 3 * j - 3 : 3 * j] += R @ turns_cov[j] @ R.T
    return out


def whitening(covariance: Array) -> Array:
    """Lower triangular W (m, m) with W C W' = 1."""
    return np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(covariance)))


@lru_cache(maxsize=64)
def chi_square_limit(degrees_of_freedom: int, deviations: float) -> float:
    """Chi square that noise exceeds as rarely as a normal number exceeds so many deviations (Wilson and Hilferty)."""
    if degrees_of_freedom <= 0:
        return deviations**2
    spread = 2.0 / (9.0 * degrees_of_freedom)
    return float(degrees_of_freedom * (1.0 - spread + deviations * math.sqrt(spread)) ** 3)
