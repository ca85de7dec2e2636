"""What every force estimator in the loop is: poses and actuation in, tip force with covariance out."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PoseReading(NamedTuple):
    """A tracked pose in the base frame: position_m (3,), quaternion_wxyz (4,) sensor to base, scalar first."""

    position_m: Array
    quaternion_wxyz: Array
    stamp_ns: int


class Actuation(NamedTuple):
    """The distal end's joints when the pose was measured, as the controller has them through the transmission."""

    insertion_m: float
    roll_rad: float
    curvature_per_m: float
    stamp_ns: int


class TipForce(NamedTuple):
    """force_N (3,) of the tip on the tissue and covariance_N2 (3, 3), base frame; stamp_ns is the pose's.

    A pose that no force explains is not an error: `converged` is false, and `residual` says how far off it is.
    """

    force_N: Array
    covariance_N2: Array
    converged: bool
    residual: float
    stamp_ns: int


class Estimator(Protocol):
    """Called once for each tip pose; may keep the branch it is on between calls, nothing else."""

    def estimate(self, pose_tip: PoseReading, pose_shaft: PoseReading | None, actuation: Actuation) -> TipForce:
        """The force that explains `pose_tip` (and `pose_shaft`, where it was seen) at that actuation."""
        ...
