"""One sweep along the rod from the tip, force given in the tip frame: state, exact tangents, conjugate points.

The rod is swept from the tip (sigma = 0) towards the base in its own frame. With the tendon tension substituted away
and the spatial wrench constant, (3.18) and (3.19) shrink to nine numbers a section:
    rho: section minus tip, in the section's frame      rho' = u x rho - e3
    n:   contact force, in the section's frame          n'   = u x n
    q:   the section's frame seen from the tip          q'   = -1/2 q o u
with the moment m = n x rho and the curvatures u = (m1/EI1 + k0, m2/EI2, m3/GJ).
At the base, -rho is the tip in the base frame, n the tip force in the base frame, conj(q) the tip's orientation.

Layout of a state row: rho 0:3, n 3:6, q 6:10, two spare; then tangents, four lanes each (force 1, 2, 3, curvature k0):
d rho 12:24, d n 24:36, d theta 36:48 (turn of the section relative to the tip, in the section's frame).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.runge_kutta8 import STAGES, finish_step, stage_state

Array = NDArray[np.float64]

POSE, POSE_AND_FORCE_TANGENTS, ALL_TANGENTS = 12, 36, 48  # how much of a row takes part
ROW = 48
WORK = (STAGES + 2) * ROW
# Radians of the sharpest possible bend per step. Largest errors over 0-0.35 N, 0-60 1/m, 0-50 mm: see tests.
EXACT, FINE, COARSE = 0.3, 0.9, 1.4
MAX_STEPS = 400

# Entries of a rod record: compliances of shaft and body (1/(N m2)), exposed lengths (m), pre-curvature (1/m).
SHAFT_1, SHAFT_2, SHAFT_3, BODY_1, BODY_2, BODY_3, SHAFT_LENGTH, BODY_LENGTH, K0 = range(9)
CURVATURE_LANE = np.array([0.0, 0.0, 0.0, 1.0])
NO_LANE = np.zeros(4)


@njit(cache=True, error_model="numpy", fastmath={"contract"}, nogil=True)
def _rates(  # noqa: PLR0913 - scalars, so that the compiler keeps them in registers
    y: Array, c1: float, c2: float, c3: float, k0: float, lane: Array, width: int, k: Array, at: int
) -> None:
    """k[at:at+width] = derivative of the row y by sigma. c: compliances; lane (4,): d k0 by the four lanes."""
    r1, r2, r3, n1, n2, n3 = y[0], y[1], y[2], y[3], y[4], y[5]
    u1 = c1 * (n2 * r3 - n3 * r2) + k0
    u2 = c2 * (n3 * r1 - n1 * r3)
    u3 = c3 * (n1 * r2 - n2 * r1)
    k[at] = u2 * r3 - u3 * r2
    k[at + 1] = u3 * r1 - u1 * r3
    k[at + 2] = u1 * r2 - u2 * r1 - 1.0
    k[at + 3] = u2 * n3 - u3 * n2
    k[at + 4] = u3 * n1 - u1 * n3
    k[at + 5] = u1 * n2 - u2 * n1
    q0, q1, q2, q3 = y[6], y[7], y[8], y[9]
    k[at + 6] = 0.5 * (q1 * u1 + q2 * u2 + q3 * u3)
    k[at + 7] = -0.5 * (q0 * u1 + q2 * u3 - q3 * u2)
    k[at + 8] = -0.5 * (q0 * u2 + q3 * u1 - q1 * u3)
    k[at + 9] = -0.5 * (q0 * u3 + q1 * u2 - q2 * u1)
    k[at + 10] = 0.0
    k[at + 11] = 0.0
    if width > POSE:
        for c in range(4):
            a1, a2, a3 = y[12 + c], y[16 + c], y[20 + c]
            b1, b2, b3 = y[24 + c], y[28 + c], y[32 + c]
            e1 = c1 * (b2 * r3 - b3 * r2 + n2 * a3 - n3 * a2) + lane[c]
            e2 = c2 * (b3 * r1 - b1 * r3 + n3 * a1 - n1 * a3)
            e3 = c3 * (b1 * r2 - b2 * r1 + n1 * a2 - n2 * a1)
            k[at + 12 + c] = e2 * r3 - e3 * r2 + u2 * a3 - u3 * a2
            k[at + 16 + c] = e3 * r1 - e1 * r3 + u3 * a1 - u1 * a3
            k[at + 20 + c] = e1 * r2 - e2 * r1 + u1 * a2 - u2 * a1
            k[at + 24 + c] = e2 * n3 - e3 * n2 + u2 * b3 - u3 * b2
            k[at + 28 + c] = e3 * n1 - e1 * n3 + u3 * b1 - u1 * b3
            k[at + 32 + c] = e1 * n2 - e2 * n1 + u1 * b2 - u2 * b1
            if width > POSE_AND_FORCE_TANGENTS:
                t1, t2, t3 = y[36 + c], y[40 + c], y[44 + c]
                k[at + 36 + c] = u2 * t3 - u3 * t2 - e1
                k[at + 40 + c] = u3 * t1 - u1 * t3 - e2
                k[at + 44 + c] = u1 * t2 - u2 * t1 - e3


@njit(cache=True, error_model="numpy", fastmath={"contract"}, nogil=True)
def step_row(work: Array, h: float, c1: float, c2: float, c3: float, k0: float, lane: Array, width: int) -> None:
    """The row work[0:48] moved by one step of length h towards the base."""
    y, z, k = work[:ROW], work[ROW : 2 * ROW], work[2 * ROW :]
    _rates(y, c1, c2, c3, k0, lane, width, k, 0)
    for stage in range(1, STAGES):
        stage_state(stage, y, h, k, ROW, width, z)
        _rates(z, c1, c2, c3, k0, lane, width, k, stage * ROW)
    finish_step(y, h, k, ROW, width)


@njit(cache=True, error_model="numpy", nogil=True)
def start_row(work: Array, force: Array) -> None:
    """The row work[0:48] set to the tip: no offset, force (3,) in the tip frame, unit tangents."""
    for w in range(ROW):
        work[w] = 0.0
    work[3], work[4], work[5], work[6] = force[0], force[1], force[2], 1.0
    work[24] = work[29] = work[34] = 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def largest_rate(rod: Array, row: Array, body: bool) -> float:
    """Largest rate (1/m) from this section to the base, which sets the steps.

    The curvature is bounded, as m.K^-1.m / 2 + k0 m1 + n3 is constant on each part; a rod under the load n also has a
    wave number of its own, sqrt(n / EI), which counts where the bound is small (a straight rod in compression).
    """
    c = rod[BODY_1:SHAFT_LENGTH] if body else rod[:BODY_1]
    k0 = 0.0 if body else rod[K0]
    r1, r2, r3, n1, n2, n3 = row[0], row[1], row[2], row[3], row[4], row[5]
    m1, m2, m3 = n2 * r3 - n3 * r2, n3 * r1 - n1 * r3, n1 * r2 - n2 * r1
    energy = c[0] * m1 * m1 + c[1] * m2 * m2 + c[2] * m3 * m3 + 2.0 * k0 * m1 + 2.0 * n3 + k0 * k0 / c[0]
    force = math.sqrt(n1 * n1 + n2 * n2 + n3 * n3)
    return math.sqrt((max(energy + 2.0 * force, 0.0) + force) * max(c[0], c[1], c[2]))


@njit(cache=True, error_model="numpy", fastmath={"contract"}, nogil=True)
def _advance(rod: Array, length: float, body: bool, rate: float, width: int, work: Array) -> None:
    """The row work[0:48] moved by `length` inside one part of the rod, in steps of at most 1/rate."""
    steps = min(int(length * rate) + 1, MAX_STEPS)
    h = length / steps
    for _ in range(steps):
        if body:
            step_row(work, h, rod[BODY_1], rod[BODY_2], rod[BODY_3], 0.0, NO_LANE, width)
        else:
            step_row(work, h, rod[SHAFT_1], rod[SHAFT_2], rod[SHAFT_3], rod[K0], CURVATURE_LANE, width)


@njit(cache=True, error_model="numpy", nogil=True)
def sweep(rod: Array, force: Array, stations: Array, bend_per_step: float, width: int, out: Array, work: Array) -> None:
    """Rows at every station and, last, at the base, for the force (3,) in N in the tip frame.

    Arguments: rod (9,) see above; stations (n,) arc lengths back from the tip in m, ascending, at most the exposed
    length; bend_per_step: FINE or COARSE; width: POSE, POSE_AND_FORCE_TANGENTS or ALL_TANGENTS;
    out (n + 1, 48), written; work (672,), scratch.
    """
    start_row(work, force)
    here = 0.0
    shaft, total = rod[SHAFT_LENGTH], rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    in_body = False
    rate = largest_rate(rod, work, False) / bend_per_step
    for i in range(stations.shape[0] + 1):
        goal = stations[i] if i < stations.shape[0] else total
        if not in_body and goal > shaft:
            if shaft > here:
                _advance(rod, shaft - here, False, rate, width, work)
            here, in_body = max(here, shaft), True
            rate = largest_rate(rod, work, True) / bend_per_step
        if goal > here:
            _advance(rod, goal - here, in_body, rate, width, work)
            here = goal
        for w in range(width):
            out[i, w] = work[w]
        normalize(out[i])


@njit(cache=True, error_model="numpy", nogil=True)
def normalize(row: Array) -> None:
    """The row's quaternion brought back to unit length."""
    scale = 1.0 / math.sqrt(row[6] * row[6] + row[7] * row[7] + row[8] * row[8] + row[9] * row[9])
    for w in range(6, 10):
        row[w] *= scale
