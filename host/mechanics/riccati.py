"""One Newton correction of a rod cut into segments: clamped base, free tip, solved by a Riccati pass from the tip."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.multiple_shooting import NEWTON, WITH_POSITION, cross_segment
from host.mechanics.rotations import conjugate, quaternion_product, rotation_matrix, vector_of_quaternion
from host.mechanics.small_matrices import apply3, inverse3, multiply3, negative_eigenvalues3

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def linearize(segments: Array, load: float, Q: Array, M: Array, bend: float, phi: Array, gap: Array, work: Array) -> None:
    """Set phi (n, 6 or 9, 8): change of each segment's end by its start, load and k0; gap (n, 6): end minus the next node.

    Arguments: segments (n, 18), Q (n + 1, 4), M (n + 1, 3); the tip's moment M[n] is zero. With nine rows phi also
    gets the change of the segment's chord, in the base frame.
    """
    width = WITH_POSITION if phi.shape[1] == 9 else NEWTON
    for i in range(segments.shape[0]):
        cross_segment(segments[i], load, Q[i], M[i], bend, width, work)
        turn = vector_of_quaternion(quaternion_product(conjugate(Q[i + 1]), work[0:4]))
        for row in range(3):
            gap[i, row] = turn[row]
            gap[i, 3 + row] = work[4 + row] - M[i + 1, row]
            for lane in range(8):
                phi[i, row, lane] = work[16 + 8 * row + lane]
                phi[i, 3 + row, lane] = work[40 + 8 * row + lane]
                if width == WITH_POSITION:
                    phi[i, 6 + row, lane] = work[64 + 8 * row + lane]


@njit(cache=True, error_model="numpy", nogil=True)
def correct(Q: Array, phi: Array, gap: Array, step: Array, by_load: Array, gain: Array) -> int:
    """Newton step of every node and its change with lane 6; returns the number of unstable modes.

    Arguments: Q (n + 1, 4) nodes; phi (n, 6 or 9, 8), gap (n, 6) from `linearize`; gain (n, 3, 5), scratch.
    Written: step, by_load (n + 1, 6), turn in the section's frame (rad) and moment (N m).
    Backwards, dm = S dtheta + g with S = 0, g = 0 at the free tip; D - S B, brought to one frame, has a negative
    eigenvalue for each conjugate point inside the segment, and each is a mode in which the equilibrium is unstable.
    """
    n = phi.shape[0]
    S, g, gt = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    P, Pi, X = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    unstable = 0
    for i in range(n - 1, -1, -1):
        A, B, C, D = phi[i, :3, :3], phi[i, :3, 3:6], phi[i, 3:6, :3], phi[i, 3:6, 3:6]
        multiply3(S, B, P)
        multiply3(S, A, X)
        for r in range(3):
            g[r] += S[r, 0] * gap[i, 0] + S[r, 1] * gap[i, 1] + S[r, 2] * gap[i, 2] - gap[i, 3 + r]
            gt[r] += S[r, 0] * phi[i, 0, 6] + S[r, 1] * phi[i, 1, 6] + S[r, 2] * phi[i, 2, 6] - phi[i, 3 + r, 6]
            for c in range(3):
                P[r, c] = D[r, c] - P[r, c]
                X[r, c] -= C[r, c]
        turn = rotation_matrix(quaternion_product(conjugate(Q[i]), Q[i + 1]))
        multiply3(turn, P, Pi)
        unstable += negative_eigenvalues3(Pi)
        inverse3(P, Pi)
        multiply3(Pi, X, S)
        apply3(Pi, g, gain[i, :, 3])
        apply3(Pi, gt, gain[i, :, 4])
        for r in range(3):
            g[r], gt[r] = gain[i, r, 3], gain[i, r, 4]
            for c in range(3):
                gain[i, r, c] = S[r, c]
    forward(phi, gap, step, by_load, gain)
    return unstable


@njit(cache=True, error_model="numpy", nogil=True)
def forward(phi: Array, gap: Array, step: Array, by_load: Array, gain: Array) -> None:
    """The second half of `correct`: from the clamped base to the tip through the stored gains."""
    n = phi.shape[0]
    for r in range(3):
        step[0, r] = by_load[0, r] = 0.0
    for i in range(n):
        for r in range(3):
            step[i, 3 + r], by_load[i, 3 + r] = gain[i, r, 3], gain[i, r, 4]
            for c in range(3):
                step[i, 3 + r] += gain[i, r, c] * step[i, c]
                by_load[i, 3 + r] += gain[i, r, c] * by_load[i, c]
        for r in range(6):
            step[i + 1, r], by_load[i + 1, r] = gap[i, r], phi[i, r, 6]
            for c in range(6):
                step[i + 1, r] += phi[i, r, c] * step[i, c]
                by_load[i + 1, r] += phi[i, r, c] * by_load[i, c]
