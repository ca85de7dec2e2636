"""Unit quaternions (scalar first, tip -> base) and rotation vectors, compiled, for the spatial models."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def product_into(p: Array, q: Array, out: Array) -> None:
    """Set out (4,) = Hamilton product p q of quaternions (4,): first turn by q, then by p. out must be neither."""
    out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    out[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    out[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    out[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]


@njit(cache=True, nogil=True)
def quaternion_product(p: Array, q: Array) -> Array:
    """Hamilton product p q of quaternions (4,): first turn by q, then by p."""
    out = np.empty(4)
    product_into(p, q, out)
    return out


@njit(cache=True, nogil=True)
def normalized_into(q: Array, out: Array) -> None:
    """Set out (4,) = q (4,) brought to unit length; out may be q."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        out[i] = scale * q[i]


@njit(cache=True, nogil=True)
def conjugate(q: Array) -> Array:
    """Inverse of the unit quaternion q (4,)."""
    return np.array([q[0], -q[1], -q[2], -q[3]])


@njit(cache=True, nogil=True)
def matrix_into(q: Array, R: Array) -> None:
    """R (3, 3) = rotation matrix of the unit quaternion q (4,); (3.15) with the element (1, 3) corrected."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, nogil=True)
def rotation_matrix(q: Array) -> Array:
    """Rotation matrix (3, 3) of the unit quaternion q (4,); (3.15) with the element (1, 3) corrected."""
    R = np.empty((3, 3))
    matrix_into(q, R)
    return R


@njit(cache=True, nogil=True)
def quaternion_of_matrix(R: Array) -> Array:
    """Unit quaternion (4,) of the rotation matrix R (3, 3), scalar part not negative. Shepperd's choice of pivot."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    if trace >= max(R[0, 0], R[1, 1], R[2, 2]):
        q[0], q[1], q[2], q[3] = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        q[0], q[1] = R[2, 1] - R[1, 2], 1.0 + 2.0 * R[0, 0] - trace
        q[2], q[3] = R[1, 0] + R[0, 1], R[2, 0] + R[0, 2]
    elif R[1, 1] >= R[2, 2]:
        q[0], q[1] = R[0, 2] - R[2, 0], R[1, 0] + R[0, 1]
        q[2], q[3] = 1.0 + 2.0 * R[1, 1] - trace, R[2, 1] + R[1, 2]
    else:
        q[0], q[1] = R[1, 0] - R[0, 1], R[2, 0] + R[0, 2]
        q[2], q[3] = R[2, 1] + R[1, 2], 1.0 + 2.0 * R[2, 2] - trace
    q /= math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return -q if q[0] < 0.0 else q


@njit(cache=True, nogil=True)
def quaternion_of_vector(v: Array) -> Array:
    """Unit quaternion (4,) of the rotation vector v (3,) in rad; smooth through zero."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    half = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return np.array([math.cos(0.5 * angle), half * v[0], half * v[1], half * v[2]])


@njit(cache=True, nogil=True)
def vector_of_quaternion(q: Array) -> Array:
    """Rotation vector (3,) in rad of the unit quaternion q (4,), length at most pi; smooth through zero."""
    sign = -1.0 if q[0] < 0.0 else 1.0
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = 2.0 * sign if sine < 1e-9 else 2.0 * sign * math.atan2(sine, sign * q[0]) / sine
    return np.array([scale * q[1], scale * q[2], scale * q[3]])


@njit(cache=True, nogil=True)
def turn_back(q: Array, v: Array, out: Array) -> None:
    """Set out (3,) = vector v (3,) turned by the inverse of the unit quaternion q (4,)."""
    R = rotation_matrix(q)
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]


@njit(cache=True, nogil=True)
def cross(a: Array, b: Array) -> Array:
    """Vector product (3,) of a (3,) and b (3,)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True, nogil=True)
def skew(a: Array) -> Array:
    """Matrix S (3, 3) of the vector product: S b = a x b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
