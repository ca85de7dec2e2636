"""The unloaded shape nearest to the tracked poses: its curvature, and whether a catheter that nothing touches explains them.

An unloaded distal shaft is an arc of one curvature, whatever its stiffness. The fit is that of the rod
(`spatial_rig_kernels`) with the force held at zero: unknown are the curvature, which nothing is assumed of, and small errors
of insertion and roll.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.interface import Actuation, PoseReading
from host.estimation.lasting_errors import ALL_JOINTS, INSERTION, NOWHERE, ROLL, ActuationKnowledge, Prior
from host.estimation.sensor_noise import TrackedSensors
from host.estimation.spatial_rig_kernels import TrackedFrame, fit, known_rows, new_fit
from host.mechanics.rod import rod_record
from protocol.catheter import Catheter, CosseratParameters
from protocol.errors import InputError
from protocol.rig_file import Rig

Array = NDArray[np.float64]

NO_FORCE_N = 1e-6  # standard deviation of a force that is held at zero
OPEN_CURVATURE_per_m = 100.0  # of a curvature that nothing is assumed of
LARGEST_FORCE_N = 1.0


class FreeShape(NamedTuple):
    """Curvature (1/m) with its standard deviation by the tracker's noise; `whitened` (k, 6): residuals of k poses, each
    position and turn over the tracker's noise; `chi_square` of the whole fit, with so many degrees of freedom.
    """

    curvature_per_m: float
    std_per_m: float
    whitened: Array
    chi_square: float
    degrees_of_freedom: int


class FreeShapeFit:
    """Fits the unloaded shape to the poses of tip and shaft."""

    def __init__(self, catheter: Catheter, sensors: TrackedSensors, knowledge: ActuationKnowledge) -> None:
        self._catheter, self._sensors = _with_rod(catheter), sensors
        joints = [knowledge.start[INSERTION], OPEN_CURVATURE_per_m, knowledge.start[ROLL]]
        self._known = Prior(NOWHERE, ALL_JOINTS, np.zeros(3), np.diag(np.square(joints)))

    @classmethod
    def from_rig(cls, rig: Rig, catheter: Catheter) -> FreeShapeFit:
        """For the catheter and the tracker of a rig file."""
        return cls(catheter, TrackedSensors.from_rig(rig), ActuationKnowledge.from_rig(rig))

    def __call__(self, tip: PoseReading, shaft: PoseReading | None, actuation: Actuation) -> FreeShape | None:
        """The unloaded shape nearest to the poses, `shaft` None where it was not seen; None where there is none.

        Raises: InputError where the actuation is out of range.
        """
        rod = rod_record(self._catheter, actuation.insertion_m, actuation.curvature_per_m)
        seen = [(0.0, tip)] + ([] if shaft is None else [(self._sensors.shaft_offset_m, shaft)])
        poses = np.array([[*pose.position_m, *pose.quaternion_wxyz] for _, pose in seen])
        if not np.isfinite(poses).all():
            return None
        frame = TrackedFrame(
            rod[:6].copy(),
            self._catheter.distal_length_m,
            np.array([actuation.insertion_m, actuation.curvature_per_m, actuation.roll_rad]),
            np.array([offset for offset, _ in seen]),
            poses,
            self._sensors.position_std_m,
            self._sensors.angle_std_rad,
            *known_rows(self._known, NO_FORCE_N),
        )
        k = len(seen)
        found = new_fit(k)
        settled, cost = fit(frame, LARGEST_FORCE_N, found)
        if not settled or not np.isfinite(found.x).all():
            return None
        covariance = np.linalg.inv(found.information[3:, 3:])  # force held
        whitened = found.residual / np.repeat([self._sensors.position_std_m, self._sensors.angle_std_rad], 3)
        # One unknown is free of assumptions; those of insertion and roll come with a measurement each, their assumption.
        return FreeShape(
            actuation.curvature_per_m + float(found.x[4]), float(np.sqrt(covariance[1, 1])), whitened, cost, 6 * k - 1
        )


def _with_rod(catheter: Catheter) -> Catheter:
    """`catheter` with rod parameters; the unloaded shape does not depend on them, so arcs' stiffness serves as well."""
    if catheter.cosserat is not None:
        return catheter
    if catheter.pcar is None:
        raise InputError("catheter", catheter.name, "a catheter with [pcar] or [cosserat] parameters")
    body, shaft = catheter.pcar.EI_N_m2[0], catheter.pcar.EI_N_m2[1]
    return replace(catheter, cosserat=CosseratParameters(shaft, shaft, shaft, body, body, body))
