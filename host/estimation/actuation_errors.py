"""Errors of the actuation that last from pose to pose: of insertion, curvature and roll, followed by a Kalman filter.

The controller's joints are those of a transmission with backlash and windup. Their errors are unknown at the start and
change when the joints move. Each pose tells about them as well as about the force. The filter keeps what the poses have
told: mean and covariance of the three errors, and lets their uncertainty grow with the travel of the joints and with time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from host.estimation.interface import Actuation
from protocol.rig_file import Rig

Array = NDArray[np.float64]

INSERTION, CURVATURE, ROLL = 0, 1, 2
GAP_NS = 1_000_000_000  # after so long without a pose nothing is remembered


@dataclass(frozen=True)
class ActuationKnowledge:
    """How surely the joints are known: standard deviations at the start, and how they grow.

    start (3,): insertion (m), curvature (1/m), roll (rad). by_travel (3,): of each joint's error after one unit of its
    own travel (m, 1/m, rad), growing with the square root of the travel. by_time (3,): the same after one second.
    """

    start: tuple[float, float, float]
    by_travel: tuple[float, float, float]
    by_time: tuple[float, float, float]

    @classmethod
    def from_rig(cls, rig: Rig) -> ActuationKnowledge:
        """Return what the rig file states: backlash and how surely it is known, and section [estimation]."""
        width_m, known = rig.transmission.insertion_backlash_m, rig.estimation
        # At the start the distal end may be anywhere in the backlash. After one width of travel it is at the other flank,
        # whose place is known as surely as the backlash.
        start_m = max(width_m / np.sqrt(12.0), known.insertion_sd_m)
        return cls(
            (start_m, known.curvature_sd_per_m, known.roll_sd_rad),
            (
                known.insertion_sd_m / np.sqrt(max(width_m, 1e-3)),
                known.curvature_sd_per_m / np.sqrt(rig.catheter.max_curvature_per_m),
                known.roll_sd_rad,
            ),
            (known.insertion_walk_m, known.curvature_walk_per_m, known.roll_walk_rad),
        )


class ActuationErrors:
    """Mean (3,) and covariance (3, 3) of the joints' errors: true joint minus the controller's."""

    def __init__(self, knowledge: ActuationKnowledge) -> None:
        self._known = knowledge
        self.mean, self.covariance = np.zeros(3), np.diag(np.square(knowledge.start))
        self._last: Actuation | None = None

    def forget(self) -> None:
        """Return to what is known at the start."""
        self.mean, self.covariance = np.zeros(3), np.diag(np.square(self._known.start))
        self._last = None

    def move_to(self, actuation: Actuation) -> None:
        """Let the uncertainty grow by the travel and the time since the last call; never above that at the start."""
        last, self._last = self._last, actuation
        if last is None or not 0 <= actuation.stamp_ns - last.stamp_ns <= GAP_NS:
            self.forget()
            self._last = actuation
            return
        travel = np.abs(
            [
                actuation.insertion_m - last.insertion_m,
                actuation.curvature_per_m - last.curvature_per_m,
                actuation.roll_rad - last.roll_rad,
            ]
        )
        seconds = (actuation.stamp_ns - last.stamp_ns) * 1e-9
        growth = np.square(self._known.by_travel) * travel + np.square(self._known.by_time) * seconds
        grown = self.covariance + np.diag(growth)
        shrink = np.minimum(1.0, np.array(self._known.start) / np.sqrt(np.diag(grown)))
        self.covariance = grown * np.outer(shrink, shrink)

    def learn(self, mean: Array, covariance: Array) -> None:
        """Take over what a pose has told: mean (3,) and covariance (3, 3) after it."""
        self.mean, self.covariance = mean.copy(), 0.5 * (covariance + covariance.T)

    def learn_part(self, which: list[int], mean: Array, covariance: Array) -> None:
        """Take over what a pose has told about some of the errors, `which` (k) of them; the others keep theirs."""
        self.mean[which] = mean
        self.covariance[np.ix_(which, which)] = 0.5 * (covariance + covariance.T)
