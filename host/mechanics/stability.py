"""Is the equilibrium stable? Conjugate points along the rod, counted in one sweep (second variation, Jacobi's test)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.cosserat_kernels import (
    ALL_TANGENTS,
    CURVATURE_LANE,
    FINE,
    NO_LANE,
    SHAFT_LENGTH,
    largest_rate,
    normalize,
    start_row,
    step_row,
)
from host.mechanics.rotations import rotation_matrix
from host.mechanics.small_matrices import inverse3, multiply3, negative_eigenvalues3

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def free_end_turns(force: Array, row: Array, T: Array) -> None:
    """T (3, 3): turn of this section, in the tip's frame, by a turn of the tip with the force held in the base frame.

    A turn e of the tip leaves the free end free; the force in the tip frame changes by force x e, so that a section
    turns by e + R (d theta / d force) (force x e). Where T is singular there is a conjugate point.
    """
    R = rotation_matrix(row[6:10])
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        for i in range(3):
            turn = 0.0
            for k in range(3):  # force x e_j has the components [a] = force[b], [b] = -force[a]
                turn += R[i, k] * (row[36 + 4 * k + a] * force[b] - row[36 + 4 * k + b] * force[a])
            T[i, j] = turn + (1.0 if i == j else 0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def unstable_modes(rod: Array, force: Array, work: Array) -> int:
    """Number of unstable modes of the equilibrium with the tip force (3,) in N, in the tip frame; 0 is stable.

    Arguments: rod (9,), force (3,) in the tip frame, held in the base frame when the rod is disturbed; work (672,).
    Between two sections the turns are tied by T2 T1^-1, near the identity unless a conjugate point lies between.
    """
    T0, T1, inverse, ratio = np.eye(3), np.eye(3), np.eye(3), np.eye(3)
    start_row(work, force)
    count = 0
    for part in range(2):
        length = rod[SHAFT_LENGTH + part]
        if length <= 0.0:
            continue
        steps = int(length * largest_rate(rod, work, part == 1) / FINE) + 1
        at, k0, lane = 3 * part, rod[8] * (1 - part), NO_LANE if part == 1 else CURVATURE_LANE
        for _ in range(steps):
            step_row(work, length / steps, rod[at], rod[at + 1], rod[at + 2], k0, lane, ALL_TANGENTS)
            normalize(work)
            free_end_turns(force, work, T1)
            inverse3(T0, inverse)
            multiply3(T1, inverse, ratio)
            count += negative_eigenvalues3(ratio)
            T0[:] = T1
    return count
