"""Rotations as 3x3 matrices for the plant's kernels: exponential, product, quaternion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

Array = np.ndarray


@njit(cache=True)
def exponential(v0: float, v1: float, v2: float, out: Array) -> None:
    """out (3,3) = rotation by the vector (v0, v1, v2) in rad (Rodrigues' formula, smooth through zero)."""
    square = v0 * v0 + v1 * v1 + v2 * v2
    if square < 1e-8:
        a = 1.0 - square / 6.0
        b = 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / square
    out[0, 0] = 1.0 - b * (v1 * v1 + v2 * v2)
    out[1, 1] = 1.0 - b * (v0 * v0 + v2 * v2)
    out[2, 2] = 1.0 - b * (v0 * v0 + v1 * v1)
    out[0, 1] = b * v0 * v1 - a * v2
    out[1, 0] = b * v0 * v1 + a * v2
    out[0, 2] = b * v0 * v2 + a * v1
    out[2, 0] = b * v0 * v2 - a * v1
    out[1, 2] = b * v1 * v2 - a * v0
    out[2, 1] = b * v1 * v2 + a * v0


@njit(cache=True)
def multiply(a: Array, b: Array, out: Array) -> None:
    """out (3,3) = a b; `out` is neither a nor b."""
    for i in range(3):
        for k in range(3):
            out[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]


@njit(cache=True)
def quaternion(rotation: Array, out: Array) -> None:
    """out (4,) = scalar-first unit quaternion of `rotation` (3,3), scalar part not negative (Shepperd's choice of pivot)."""
    xx, yy, zz = rotation[0, 0], rotation[1, 1], rotation[2, 2]
    trace = xx + yy + zz
    if trace >= max(xx, yy, zz):
        w, x = 1.0 + trace, rotation[2, 1] - rotation[1, 2]
        y, z = rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    elif xx >= yy and xx >= zz:
        w, x = rotation[2, 1] - rotation[1, 2], 1.0 + xx - yy - zz
        y, z = rotation[0, 1] + rotation[1, 0], rotation[0, 2] + rotation[2, 0]
    elif yy >= zz:
        w, x = rotation[0, 2] - rotation[2, 0], rotation[0, 1] + rotation[1, 0]
        y, z = 1.0 + yy - xx - zz, rotation[1, 2] + rotation[2, 1]
    else:
        w, x = rotation[1, 0] - rotation[0, 1], rotation[0, 2] + rotation[2, 0]
        y, z = rotation[1, 2] + rotation[2, 1], 1.0 + zz - xx - yy
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    out[0], out[1], out[2], out[3] = w * scale, x * scale, y * scale, z * scale


@njit(cache=True)
def quaternion_product(a: Array, b: Array, out: Array) -> None:
    """out (4,) = a b for scalar-first quaternions; `out` is neither a nor b."""
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@njit(cache=True)
def quaternion_of_vector(v0: float, v1: float, v2: float, out: Array) -> None:
    """out (4,) = unit quaternion of the rotation vector (v0, v1, v2) in rad."""
    angle = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    scale = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    out[0], out[1], out[2], out[3] = math.cos(0.5 * angle), scale * v0, scale * v1, scale * v2
