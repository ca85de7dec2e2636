"""Frames of contact: sensor to base by the measured pose, and the wall's normal as the force on it shows (Fig. 7.2)."""

from __future__ import annotations

import math

from numba import njit

from realtime.control.declare import Floats, ReadFloats

# A normal that is learned stays within this angle's cosine of the one commanded (20 degrees).
_LEAST_COSINE = 0.94


@njit(cache=True)
def to_base(quaternion_wxyz: ReadFloats, vector: ReadFloats, out: Floats) -> None:
    """`vector` (3,) of a frame whose pose in the base frame is the unit quaternion (4,), in the base frame, into `out`."""
    w, x, y, z = quaternion_wxyz[0], quaternion_wxyz[1], quaternion_wxyz[2], quaternion_wxyz[3]
    a, b, c = vector[0], vector[1], vector[2]
    out[0] = (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - w * z) * b + 2.0 * (x * z + w * y) * c
    out[1] = 2.0 * (x * y + w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z - w * x) * c
    out[2] = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c


@njit(cache=True)
def dot(a: ReadFloats, b: ReadFloats) -> float:
    """Return the scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def take(normal: Floats, commanded: ReadFloats) -> None:
    """Set `normal` (3,) to the commanded one, if that is a unit vector."""
    if abs(dot(commanded, commanded) - 1.0) < 1e-3:
        for i in range(3):
            normal[i] = commanded[i]


@njit(cache=True)
def follow_force(normal: Floats, commanded: ReadFloats, force_N: ReadFloats, share: float) -> None:
    """Turn `normal` (3,), unit, outward, by `share` (0 to 1) towards where the force (3,) on a smooth wall says it is.

    `commanded` (3,), unit: the normal given; the learned one stays within 20 degrees of it. No force: nothing learned.
    """
    size_N = math.sqrt(dot(force_N, force_N))
    if not size_N > 1e-9:
        return
    before = (normal[0], normal[1], normal[2])
    for i in range(3):
        normal[i] += share * (-force_N[i] / size_N - normal[i])
    size = math.sqrt(dot(normal, normal))
    if size > 0.1:
        for i in range(3):
            normal[i] /= size
    if not (size > 0.1 and dot(normal, commanded) >= _LEAST_COSINE):
        for i in range(3):
            normal[i] = before[i]
