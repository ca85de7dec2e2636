"""One explicit Runge-Kutta step of order 8 in 12 stages, taken apart so that any compiled rates fit in."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

STAGES = 12

# Dormand and Prince, order 8 (Hairer, Norsett, Wanner: Solving Ordinary Differential Equations I, II.5, DOP853).
# Row i: weights of the rates before stage i.
A = np.zeros((STAGES, STAGES))
A[1, [0]] = [0.05260015195876773]
A[2, [0, 1]] = [0.0197250569845379, 0.0591751709536137]
A[3, [0, 2]] = [0.02958758547680685, 0.08876275643042054]
A[4, [0, 2, 3]] = [0.2413651341592667, -0.8845494793282861, 0.924834003261792]
A[5, [0, 3, 4]] = [0.037037037037037035, 0.17082860872947386, 0.12546768756682242]
A[6, [0, 3, 4, 5]] = [0.037109375, 0.17025221101954405, 0.06021653898045596, -0.017578125]
A[7, [0, 3, 4, 5, 6]] = [
    0.03709200011850479,
    0.17038392571223998,
    0.10726203044637328,
    -0.015319437748624402,
    0.008273789163814023,
]
A[8, [0, 3, 4, 5, 6, 7]] = [
    0.6241109587160757,
    -3.3608926294469414,
    -0.868219346841726,
    27.59209969944671,
    20.154067550477894,
    -43.48988418106996,
]
A[9, [0, 3, 4, 5, 6, 7, 8]] = [
    0.47766253643826434,
    -2.4881146199716677,
    -0.590290826836843,
    21.230051448181193,
    15.279233632882423,
    -33.28821096898486,
    -0.020331201708508627,
]
A[10, [0, 3, 4, 5, 6, 7, 8, 9]] = [
    -0.9371424300859873,
    5.186372428844064,
    1.0914373489967295,
    -8.149787010746927,
    -18.52006565999696,
    22.739487099350505,
    2.4936055526796523,
    -3.0467644718982196,
]
A[11, [0, 3, 4, 5, 6, 7, 8, 9, 10]] = [
    2.273310147516538,
    -10.53449546673725,
    -2.0008720582248625,
    -17.9589318631188,
    27.94888452941996,
    -2.8589982771350235,
    -8.87285693353063,
    12.360567175794303,
    0.6433927460157636,
]
B = np.zeros(STAGES)
B[[0, 5, 6, 7, 8, 9, 10, 11]] = [
    0.054293734116568765,
    4.450312892752409,
    1.8915178993145003,
    -5.801203960010585,
    0.3111643669578199,
    -0.1521609496625161,
    0.20136540080403034,
    0.04471061572777259,
]
C = A.sum(axis=1)  # where in the step each stage stands


@njit(cache=True, error_model="numpy", fastmath={"contract"}, nogil=True)
def stage_state(  # noqa: C901 - one branch for each stage, so that its weights are constants of the loop
    stage: int, y: Array, h: float, k: Array, row: int, width: int, z: Array
) -> None:
    """Set z = state at `stage` (1 to 11) of a step of length h from y, by the rates k of the stages before it.

    Arguments: y, z (at least width,); k (12 * row,), the rates of stage i at k[i * row]; only the first `width`
    entries of each take part. One loop per stage, so that the compiler keeps the weights in registers.
    """
    if stage == 1:
        for w in range(width):
            z[w] = y[w] + h * (A[1, 0] * k[w])
    elif stage == 2:
        for w in range(width):
            z[w] = y[w] + h * (A[2, 0] * k[w] + A[2, 1] * k[1 * row + w])
    elif stage == 3:
        for w in range(width):
            z[w] = y[w] + h * (A[3, 0] * k[w] + A[3, 2] * k[2 * row + w])
    elif stage == 4:
        for w in range(width):
            z[w] = y[w] + h * (A[4, 0] * k[w] + A[4, 2] * k[2 * row + w] + A[4, 3] * k[3 * row + w])
    elif stage == 5:
        for w in range(width):
            z[w] = y[w] + h * (A[5, 0] * k[w] + A[5, 3] * k[3 * row + w] + A[5, 4] * k[4 * row + w])
    elif stage == 6:
        for w in range(width):
            z[w] = y[w] + h * (
                A[6, 0] * k[w] + A[6, 3] * k[3 * row + w] + A[6, 4] * k[4 * row + w] + A[6, 5] * k[5 * row + w]
            )
    elif stage == 7:
        for w in range(width):
            z[w] = y[w] + h * (
                A[7, 0] * k[w]
                + A[7, 3] * k[3 * row + w]
                + A[7, 4] * k[4 * row + w]
                + A[7, 5] * k[5 * row + w]
                + A[7, 6] * k[6 * row + w]
            )
    elif stage == 8:
        for w in range(width):
            z[w] = y[w] + h * (
                A[8, 0] * k[w]
                + A[8, 3] * k[3 * row + w]
                + A[8, 4] * k[4 * row + w]
                + A[8, 5] * k[5 * row + w]
                + A[8, 6] * k[6 * row + w]
                + A[8, 7] * k[7 * row + w]
            )
    elif stage == 9:
        for w in range(width):
            z[w] = y[w] + h * (
                A[9, 0] * k[w]
                + A[9, 3] * k[3 * row + w]
                + A[9, 4] * k[4 * row + w]
                + A[9, 5] * k[5 * row + w]
                + A[9, 6] * k[6 * row + w]
                + A[9, 7] * k[7 * row + w]
                + A[9, 8] * k[8 * row + w]
            )
    elif stage == 10:
        for w in range(width):
            z[w] = y[w] + h * (
                A[10, 0] * k[w]
                + A[10, 3] * k[3 * row + w]
                + A[10, 4] * k[4 * row + w]
                + A[10, 5] * k[5 * row + w]
                + A[10, 6] * k[6 * row + w]
                + A[10, 7] * k[7 * row + w]
                + A[10, 8] * k[8 * row + w]
                + A[10, 9] * k[9 * row + w]
            )
    elif stage == 11:
        for w in range(width):
            z[w] = y[w] + h * (
                A[11, 0] * k[w]
                + A[11, 3] * k[3 * row + w]
                + A[11, 4] * k[4 * row + w]
                + A[11, 5] * k[5 * row + w]
                + A[11, 6] * k[6 * row + w]
                + A[11, 7] * k[7 * row + w]
                + A[11, 8] * k[8 * row + w]
                + A[11, 9] * k[9 * row + w]
                + A[11, 10] * k[10 * row + w]
            )


@njit(cache=True, error_model="numpy", fastmath={"contract"}, nogil=True)
def finish_step(y: Array, h: float, k: Array, row: int, width: int) -> None:
    """Move y (at least width,) by one step of length h, by the rates k of all 12 stages."""
    for w in range(width):
        y[w] += h * (
            B[0] * k[w]
            + B[5] * k[5 * row + w]
            + B[6] * k[6 * row + w]
            + B[7] * k[7 * row + w]
            + B[8] * k[8 * row + w]
            + B[9] * k[9 * row + w]
            + B[10] * k[10 * row + w]
            + B[11] * k[11 * row + w]
        )
