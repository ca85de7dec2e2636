"""Checks of what a plug-in driver returns, as the drivers of this package check what their devices send."""

from __future__ import annotations

import dataclasses

import numpy as np

from realtime.drivers.net_ft import ForceSample
from realtime.drivers.pose_sample import PoseFlag, PoseSample

# As of the Aurora: a quaternion this far from unit length, or a position beyond this, is not a pose.
UNIT_TOLERANCE, MAX_DISTANCE_M = 0.02, 3.0


def checked_pose(sample: PoseSample) -> PoseSample:
    """Return `sample`, marked as missing if it is not a pose: not finite, not a unit quaternion, beyond 3 m.

    Raises TypeError for anything else than a PoseSample with a position (3,) and a quaternion (4,).
    """
    _check_kind(sample, PoseSample, {"position_m": 3, "quaternion_wxyz": 4})
    norm = float(np.linalg.norm(sample.quaternion_wxyz))
    far_m = float(np.linalg.norm(sample.position_m))
    # Comparisons with NaN are false.
    if sample.missing or (abs(norm - 1.0) < UNIT_TOLERANCE and far_m <= MAX_DISTANCE_M):
        return sample
    return dataclasses.replace(
        sample,
        position_m=np.full(3, np.nan),
        quaternion_wxyz=np.full(4, np.nan),
        missing=True,
        flags=sample.flags | PoseFlag.NOT_A_POSE,
    )


def checked_force(sample: ForceSample) -> ForceSample | None:
    """Return `sample`, None if it is not finite. Raises TypeError if it is not a ForceSample with (3,) force and torque."""
    _check_kind(sample, ForceSample, {"force_N": 3, "torque_Nm": 3})
    return sample if np.all(np.isfinite(sample.force_N)) and np.all(np.isfinite(sample.torque_Nm)) else None


def _check_kind(sample: object, kind: type, sizes: dict[str, int]) -> None:
    if not isinstance(sample, kind):
        raise TypeError(f"found {type(sample).__name__} in what read returned, wanted {kind.__name__}")
    for name, size in sizes.items():
        value = np.asarray(getattr(sample, name))
        if value.shape != (size,) or value.dtype.kind != "f":
            found = f"{value.dtype} of shape {value.shape}"
            raise TypeError(f"found {found} as {kind.__name__}.{name}, wanted {size} floating-point numbers")
