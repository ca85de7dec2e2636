"""Samples of the device drivers into the tick's input record, turned into the base frame."""

from __future__ import annotations

import numpy as np

from protocol.rig_file import Rig
from protocol.topics import ForceEstimate


def rotation(quaternion_wxyz: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,), scalar first; (3.15) corrected."""
    w, x, y, z = quaternion_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_product(a: tuple[float, ...] | np.ndarray, b: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Return the Hamilton product (4,) of two quaternions, scalar first: the rotation b, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


class Intake:
    """Registers the rig's sensors to the base frame at the sheath's exit and fills records of `realtime.control.records`."""

    def __init__(self, rig: Rig) -> None:
        self._tracker_turn = np.array(rig.tracker.base_from_tracker_wxyz)
        self._tracker_rotation = rotation(self._tracker_turn)
        self._tracker_shift_m = np.array(rig.tracker.base_from_tracker_m)
        self._sensor_rotation = rotation(rig.force_sensor.base_from_sensor_wxyz)
        # Load of the sensor at no force (sensor frame, N), as `force_zero` measured it; subtracted from every reading.
        self.zero_N = np.zeros(3)

    def pose(
        self, record: np.record, stamp_ns: int, arrival_ns: int, position_m: np.ndarray, quaternion_wxyz: np.ndarray
    ) -> None:
        """Write a tracker pose (tracker frame: position (3,) m, quaternion (4,)) into a POSE record (base frame)."""
        record.count += 1
        record.stamp_ns, record.arrival_ns = stamp_ns, arrival_ns
        record.position_m[:] = self._tracker_rotation @ np.asarray(position_m) + self._tracker_shift_m
        record.quaternion_wxyz[:] = quaternion_product(self._tracker_turn, quaternion_wxyz)

    def force(self, record: np.record, stamp_ns: int, arrival_ns: int, force_N: np.ndarray) -> None:
        """Write a force reading (sensor frame, (3,) N) into a FORCE record (base frame, force on the tissue)."""
        record.count += 1
        record.stamp_ns, record.arrival_ns = stamp_ns, arrival_ns
        record.force_N[:] = self._sensor_rotation @ (np.asarray(force_N) - self.zero_N)

    @staticmethod
    def estimate(record: np.record, estimate: ForceEstimate, arrival_ns: int) -> bool:
        """Write a force estimate (base frame, on the tissue) into a FORCE record. Return whether it has a force."""
        force_N, covariance_N2 = estimate.force_N, estimate.covariance_N2
        if not estimate.converged or force_N is None or covariance_N2 is None:
            return False
        record.count += 1
        record.stamp_ns, record.arrival_ns = estimate.stamp_ns, arrival_ns
        record.force_N[:] = force_N
        record.covariance_N2.flat = covariance_N2
        lasting_N2 = estimate.lasting_covariance_N2
        record.lasting_covariance_N2.flat = lasting_N2 if lasting_N2 is not None else 0.0
        adapted = estimate.nominal_force_N is not None
        record.nominal_N[:] = estimate.nominal_force_N if adapted else force_N
        record.nominal_covariance_N2.flat = estimate.nominal_covariance_N2 if adapted else covariance_N2
        return True
