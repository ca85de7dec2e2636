"""Angle between two orientations, by scipy: tests compare the project's own quaternions with it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def angle_between(p_wxyz: np.ndarray, q_wxyz: np.ndarray) -> float:
    """Angle (rad) of the rotation from unit quaternion p (4,) to q (4,), scalar first."""
    p, q = (Rotation.from_quat(np.roll(one, -1)) for one in (p_wxyz, q_wxyz))
    return float((p.inv() * q).magnitude())
