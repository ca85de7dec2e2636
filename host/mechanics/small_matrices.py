"""Three by three matrices without a library call: inverse, product, sign of the eigenvalues, for compiled callers."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def inverse3(A: Array, out: Array) -> float:
    """Set out (3, 3) = inverse of A (3, 3); returns the determinant. A singular A gives out = 0 and 0."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c10 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c20 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    determinant = A[0, 0] * c00 + A[0, 1] * c10 + A[0, 2] * c20
    scale = 1.0 / determinant if determinant != 0.0 else 0.0
    out[0, 0], out[1, 0], out[2, 0] = c00 * scale, c10 * scale, c20 * scale
    out[0, 1] = (A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]) * scale
    out[1, 1] = (A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]) * scale
    out[2, 1] = (A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]) * scale
    out[0, 2] = (A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]) * scale
    out[1, 2] = (A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]) * scale
    out[2, 2] = (A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) * scale
    return float(determinant)


@njit(cache=True, error_model="numpy", nogil=True)
def multiply3(A: Array, B: Array, out: Array) -> None:
    """Write the product A B of two matrices (3, 3) into out."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(cache=True, error_model="numpy", nogil=True)
def apply3(A: Array, b: Array, out: Array) -> None:
    """Set out (3,) = A b; out must not be b."""
    for i in range(3):
        out[i] = A[i, 0] * b[0] + A[i, 1] * b[1] + A[i, 2] * b[2]


@njit(cache=True, error_model="numpy", nogil=True)
def negative_eigenvalues3(A: Array) -> int:
    """How many of the (real) eigenvalues of A (3, 3) are negative: Descartes' rule on its characteristic polynomial."""
    trace = A[0, 0] + A[1, 1] + A[2, 2]
    minors = (
        A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0] + A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0] + A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    )
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c10 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c20 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    determinant = A[0, 0] * c00 + A[0, 1] * c10 + A[0, 2] * c20
    count, last = 0, 1.0
    for coefficient in (trace, minors, determinant):
        if coefficient * last < 0.0:
            count += 1
        if coefficient != 0.0:
            last = coefficient
    return count
