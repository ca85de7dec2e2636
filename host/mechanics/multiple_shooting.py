"""Newton on all sections at once: the rod under loads held in the base frame, cut into segments tied by a Riccati pass.

A single sweep amplifies its start by exp(L sqrt(F/EI)) under tension, a million times for a soft catheter at 0.35 N;
short segments do not. The unknowns are orientation q and moment m at every node; base clamped, tip free.
    q' = 1/2 q o u      m' = m x u + n x e3      n = R^T N(s)      r' = R e3
with N(s) = a + b (s - start) known on every segment: tip force, point loads beyond s, distributed load.

Layout of a row: q 0:4, m 4:7, r 7:10; tangents with eight lanes each (start theta 0:3, start m 3:6, the load's
direction 6, curvature k0 7): d theta 16:40 (section's frame), d m 40:64 (section's frame), d r 64:88 (base frame).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.runge_kutta8 import STAGES, C, finish_step, stage_state

Array = NDArray[np.float64]

STATE, NEWTON, WITH_POSITION = 16, 64, 88
ROW = 88
WORK = (STAGES + 2) * ROW
# Columns of a segment: length (m), compliances, k0, d k0 of lane 7, N at its start and slope, the same of lane 6.
LENGTH, C1, C2, C3, K0, K0_LANE, N_START, N_SLOPE, DN_START, DN_SLOPE = 0, 1, 2, 3, 4, 5, 6, 9, 12, 15
SEGMENT = 18
LANE_LOAD = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
LANE_K0 = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@njit(cache=True, error_model="numpy", nogil=True)
def _rates(y: Array, seg: Array, load: float, s: float, width: int, k: Array, at: int) -> None:
    """k[at:at+width] = derivative of row y by arc length, at distance s into segment `seg`, loads scaled by `load`."""
    q0, q1, q2, q3 = y[0], y[1], y[2], y[3]
    m1, m2, m3 = y[4], y[5], y[6]
    c1, c2, c3 = seg[1], seg[2], seg[3]
    u1, u2, u3 = c1 * m1 + seg[4], c2 * m2, c3 * m3
    R11, R12, R13 = 1.0 - 2.0 * (q2 * q2 + q3 * q3), 2.0 * (q1 * q2 - q0 * q3), 2.0 * (q1 * q3 + q0 * q2)
    R21, R22, R23 = 2.0 * (q1 * q2 + q0 * q3), 1.0 - 2.0 * (q1 * q1 + q3 * q3), 2.0 * (q2 * q3 - q0 * q1)
    R31, R32, R33 = 2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    N1, N2, N3 = load * (seg[6] + s * seg[9]), load * (seg[7] + s * seg[10]), load * (seg[8] + s * seg[11])
    n1, n2 = R11 * N1 + R21 * N2 + R31 * N3, R12 * N1 + R22 * N2 + R32 * N3
    n3 = R13 * N1 + R23 * N2 + R33 * N3
    k[at] = -0.5 * (q1 * u1 + q2 * u2 + q3 * u3)
    k[at + 1] = 0.5 * (q0 * u1 + q2 * u3 - q3 * u2)
    k[at + 2] = 0.5 * (q0 * u2 + q3 * u1 - q1 * u3)
    k[at + 3] = 0.5 * (q0 * u3 + q1 * u2 - q2 * u1)
    k[at + 4] = m2 * u3 - m3 * u2 + n2
    k[at + 5] = m3 * u1 - m1 * u3 - n1
    k[at + 6] = m1 * u2 - m2 * u1
    k[at + 7], k[at + 8], k[at + 9] = R13, R23, R33
    for w in range(10, 16):
        k[at + w] = 0.0
    if width > STATE:
        dN1, dN2, dN3 = seg[12] + s * seg[15], seg[13] + s * seg[16], seg[14] + s * seg[17]
        dn1, dn2 = R11 * dN1 + R21 * dN2 + R31 * dN3, R12 * dN1 + R22 * dN2 + R32 * dN3
        dk0 = seg[5]
        for c in range(8):
            t1, t2, t3 = y[16 + c], y[24 + c], y[32 + c]
            d1, d2, d3 = y[40 + c], y[48 + c], y[56 + c]
            e1, e2, e3 = c1 * d1 + dk0 * LANE_K0[c], c2 * d2, c3 * d3
            k[at + 16 + c] = e1 + t2 * u3 - t3 * u2
            k[at + 24 + c] = e2 + t3 * u1 - t1 * u3
            k[at + 32 + c] = e3 + t1 * u2 - t2 * u1
            k[at + 40 + c] = d2 * u3 - d3 * u2 + m2 * e3 - m3 * e2 + n3 * t1 - n1 * t3 + dn2 * LANE_LOAD[c]
            k[at + 48 + c] = d3 * u1 - d1 * u3 + m3 * e1 - m1 * e3 + n3 * t2 - n2 * t3 - dn1 * LANE_LOAD[c]
            k[at + 56 + c] = d1 * u2 - d2 * u1 + m1 * e2 - m2 * e1
            if width > NEWTON:
                k[at + 64 + c] = R11 * t2 - R12 * t1
                k[at + 72 + c] = R21 * t2 - R22 * t1
                k[at + 80 + c] = R31 * t2 - R32 * t1


@njit(cache=True, error_model="numpy", nogil=True)
def rate_of(seg: Array, m: Array, load: float) -> float:
    """Largest rate (1/m) inside a segment, from the moment m (3,) at its start; sets the steps (see `largest_rate`)."""
    far = max(norm3(seg[6:9]), norm3(seg[6:9] + seg[0] * seg[9:12])) * load
    stiff = m[0] * m[0] * seg[1] + m[1] * m[1] * seg[2] + m[2] * m[2] * seg[3]
    energy = stiff + 2.0 * seg[4] * m[0] + seg[4] * seg[4] / seg[1]
    return math.sqrt((max(energy, 0.0) + 5.0 * far) * max(seg[1], seg[2], seg[3]))


@njit(cache=True, error_model="numpy", nogil=True)
def norm3(v: Array) -> float:
    """Return the Euclidean norm of v (3,)."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, error_model="numpy", nogil=True)
def cross_segment(seg: Array, load: float, q: Array, m: Array, bend_per_step: float, width: int, work: Array) -> None:
    """work[0:88] = row at the segment's far end, from orientation q (4,) and moment m (3,) at its start.

    Arguments: seg (18,); load: factor on all loads; width: STATE, NEWTON or WITH_POSITION. The row's position is
    not touched at the start, so that it adds up from segment to segment.
    """
    y, z, k = work[:ROW], work[ROW : 2 * ROW], work[2 * ROW :]
    for w in range(4):
        y[w] = q[w]
    for w in range(3):
        y[4 + w] = m[w]
    if width > STATE:
        for w in range(16, ROW):
            y[w] = 0.0
        y[16] = y[25] = y[34] = y[43] = y[52] = y[61] = 1.0
    steps = int(seg[0] * rate_of(seg, m, load) / bend_per_step) + 1
    h = seg[0] / steps
    for i in range(steps):
        _rates(y, seg, load, i * h, width, k, 0)
        for stage in range(1, STAGES):
            stage_state(stage, y, h, k, ROW, width, z)
            _rates(z, seg, load, (i + C[stage]) * h, width, k, stage * ROW)
        finish_step(y, h, k, ROW, width)
    scale = 1.0 / math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2] + y[3] * y[3])
    for w in range(4):
        y[w] *= scale
