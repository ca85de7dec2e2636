"""An estimator that answers every pose with no force: for tests that are about processes."""

import numpy as np

from host.estimation.interface import Actuation, PoseReading, TipForce
from protocol.rig_file import Rig


class NoForce:
    """Zero force, unit covariance."""

    def estimate(self, pose_tip: PoseReading, pose_shaft: PoseReading | None, actuation: Actuation) -> TipForce:
        """Always the same answer."""
        return TipForce(np.zeros(3), np.eye(3), True, 0.0, pose_tip.stamp_ns)


def make(rig: Rig) -> NoForce:
    """Return the estimator, as `load_estimator` asks a module for one."""
    return NoForce()
