"""Interface of every force estimator in the loop: poses and actuation in, tip force with covariance out."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from protocol.catheter import Catheter
from protocol.topics import Message

Array = NDArray[np.float64]


class PoseReading(NamedTuple):
    """A tracked pose in the base frame: position_m (3,), quaternion_wxyz (4,) sensor to base, scalar first."""

    position_m: Array
    quaternion_wxyz: Array
    stamp_ns: int


class Actuation(NamedTuple):
    """The distal end's joints when the pose was measured, as the controller has them through the transmission.

    force_direction (3,): unit vector in the base frame along which the controller presses; None where it does not.
    mode: phase of the control loop, a label of `protocol.enums.Phase`; empty where it is not known.
    """

    insertion_m: float
    roll_rad: float
    curvature_per_m: float
    stamp_ns: int
    force_direction: Array | None = None
    mode: str = ""


class TipForce(NamedTuple):
    """force_N (3,) of the tip on the tissue and covariance_N2 (3, 3), base frame; stamp_ns is the pose's.

    `lasting_covariance_N2` (3, 3) is the part of the covariance that poses shortly after each other share: errors of
    insertion, curvature, roll and stiffness. What remains of `covariance_N2` is noise, new in each pose.
    A pose that no force explains is not an error: `converged` is false, and `residual` says how far off it is.
    `nominal` is the answer with the stiffness of the catheter's file, where another stiffness is in use. With `body_contact`
    the poses show a contact away from the tip: the force is then not that of the tip.
    """

    force_N: Array
    covariance_N2: Array
    converged: bool
    residual: float
    stamp_ns: int
    lasting_covariance_N2: Array | None = None
    nominal: TipForce | None = None
    body_contact: bool = False


class Estimator(Protocol):
    """Called once for each tip pose; may keep the branch it is on and what it has learned of the actuation."""

    def estimate(
        self,
        pose_tip: PoseReading,
        pose_shaft: PoseReading | None,
        actuation: Actuation,
        pose_rear: PoseReading | None = None,
    ) -> TipForce:
        """The force that explains `pose_tip` (and the others, where they were seen) at that actuation.

        pose_rear is given only where the rig file has a third sensor and it was seen.
        """
        ...


@runtime_checkable
class Reporting(Protocol):
    """An estimator with further messages in addition to the force."""

    def reports(self) -> list[tuple[str, Message]]:
        """Return (topic, message) of what is new since the last call, and forget it."""
        ...


@runtime_checkable
class StiffnessUser(Protocol):
    """An estimator whose stiffness can be changed while it runs."""

    def use_stiffness(self, catheter: Catheter, relative_sd: float) -> None:
        """Use the stiffness of `catheter` from now on, known to `relative_sd`."""
        ...

    def restate_curvature(self, by_per_m: float) -> None:
        """Expect every curvature from now on larger by this (1/m) at the same place of the knob.

        What was learned of the curvature's error becomes smaller by as much.
        """
        ...
