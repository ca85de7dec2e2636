"""The rod cut into segments for multiple shooting, and base-frame loads laid on them."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import multiple_shooting as ms
from host.mechanics.cosserat_kernels import BODY_LENGTH, K0

Array = NDArray[np.float64]

BEND_PER_SEGMENT = 1.3  # a segment's length times sqrt(F / EI): keeps its amplification below exp(1.3)
MARK_TOLERANCE_m = 1e-9


@njit(cache=True, error_model="numpy", nogil=True)
def _parts_between(rod: Array, start: float, end: float, size_N: float) -> int:
    at = 3 if 0.5 * (start + end) < rod[BODY_LENGTH] else 0
    softest = max(rod[at], rod[at + 1], rod[at + 2])
    return int((end - start) * np.sqrt(size_N * softest) / BEND_PER_SEGMENT) + 1


@njit(cache=True, error_model="numpy", nogil=True)
def cut(rod: Array, marks: Array, size_N: float) -> Array:
    """Segments (n, 18) from base to tip, without loads yet, none crossing a mark, none bending much on its own.

    Arguments: rod (9,); marks (k,) arc lengths from the base, ascending, first 0, last the exposed length, with the
    place where body and shaft meet among them; size_N: size of the largest force carried.
    """
    count = 0
    for i in range(marks.shape[0] - 1):
        if marks[i + 1] - marks[i] > MARK_TOLERANCE_m:
            count += _parts_between(rod, marks[i], marks[i + 1], size_N)
    segments = np.zeros((count, ms.SEGMENT))
    n = 0
    for i in range(marks.shape[0] - 1):
        length = marks[i + 1] - marks[i]
        if length <= MARK_TOLERANCE_m:
            continue
        body = 0.5 * (marks[i] + marks[i + 1]) < rod[BODY_LENGTH]
        parts = _parts_between(rod, marks[i], marks[i + 1], size_N)
        for _ in range(parts):
            segments[n, ms.LENGTH] = length / parts
            for j in range(3):
                segments[n, ms.C1 + j] = rod[j + 3] if body else rod[j]
            segments[n, ms.K0] = 0.0 if body else rod[K0]
            segments[n, ms.K0_LANE] = 0.0 if body else 1.0
            n += 1
    return segments


@njit(cache=True, error_model="numpy", nogil=True)
def lay_loads(segments: Array, tip_force: Array, distributed: Array, places: Array, forces: Array, column: int) -> None:
    """Force carried by every segment, in the base frame: value at its start in [column], slope in [column + 3].

    Arguments: segments (n, 18); tip_force (3,) N; distributed (3,) N/m over the exposed length; places (k,) arc
    lengths from the base of the point forces (k, 3) N; column: N_START (the load) or DN_START (lane 6).
    """
    n = segments.shape[0]
    end = 0.0
    for i in range(n):
        end += segments[i, ms.LENGTH]
    beyond = 0.0
    for i in range(n - 1, -1, -1):
        beyond += segments[i, ms.LENGTH]
        middle = end - beyond + 0.5 * segments[i, ms.LENGTH]
        for j in range(3):
            carried = tip_force[j] + beyond * distributed[j]
            for p in range(places.shape[0]):
                if places[p] > middle:
                    carried += forces[p, j]
            segments[i, column + j] = carried
            segments[i, column + 3 + j] = -distributed[j]


@njit(cache=True, error_model="numpy", nogil=True)
def turn_loads(segments: Array, turn: Array) -> None:
    """Lane 6 set to the change of all loads when they are turned at the rate `turn` (3,) about the base: turn x N(s)."""
    for i in range(segments.shape[0]):
        for part in (0, 3):
            for j in range(3):
                a, b = (j + 1) % 3, (j + 2) % 3
                at = ms.N_START + part
                segments[i, ms.DN_START + part + j] = turn[a] * segments[i, at + b] - turn[b] * segments[i, at + a]
