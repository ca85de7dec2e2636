"""Tip force given in the base frame, the quick way: Newton on its direction in the tip frame, one sweep per pass.

The sweep from the tip ends with n(base), which must equal the given force: G = d n(base) / d force is the Newton
matrix, and its determinant has the sign of (-1)^(unstable modes). Quick and safe for load numbers F L^2 / EI below
about ten; `branch.follow` takes over above, and wherever a check here fails.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.cosserat_kernels import (
    BODY_1,
    BODY_LENGTH,
    COARSE,
    K0,
    POSE,
    POSE_AND_FORCE_TANGENTS,
    SHAFT_1,
    SHAFT_LENGTH,
    sweep,
)
from host.mechanics.small_matrices import apply3, inverse3

Array = NDArray[np.float64]

NO_STATIONS = np.zeros(0)
UNIQUE_BELOW = 2.0  # load number under which the equilibrium is taken as the only one (planar bound: pi^2 / 4)
QUICK_BELOW = 25.0
NEAR = 0.03  # miss at which a load step counts as done: the Newton step that follows leaves about 1e-3
LANDED = 1e-3  # ten times this is the largest miss, at full load, that is polished without following the branch again
TRUST = 0.15  # share of the force by which a predicted n(base) may miss
DRIFT = 0.3  # a corrected load step that ends further than this share of itself from its prediction may be on another branch
NEAR_SINGULAR = 0.02  # determinant of G below which a fold may be near
PASSES = 12


class Room(NamedTuple):
    """Working memory of one solution, so that kernels allocate nothing."""

    inverse: Array  # (3, 3) of the Newton matrix G
    vectors: Array  # (4, 3)
    out: Array  # (n + 1, 48) rows of the last sweep
    work: Array  # (672,) of a sweep


@njit(cache=True, error_model="numpy", nogil=True)
def length3(v: Array) -> float:
    """Return the Euclidean norm of v (3,)."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, error_model="numpy", nogil=True)
def load_number(rod: Array, size_N: float) -> float:
    """F L^2 / EI of a force of that size, with the softest direction of shaft and body."""
    shaft, total = rod[SHAFT_LENGTH], rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    soft_shaft = max(rod[SHAFT_1], rod[SHAFT_1 + 1], rod[SHAFT_1 + 2])
    soft_body = max(rod[BODY_1], rod[BODY_1 + 1], rod[BODY_1 + 2])
    return size_N * (shaft * shaft * soft_shaft + (total * total - shaft * shaft) * max(soft_shaft, soft_body))


@njit(cache=True, error_model="numpy", nogil=True)
def unloaded_direction(rod: Array, force: Array, out: Array) -> None:
    """Set out (3,) = the base-frame force (3,) in the frame of the unloaded tip."""
    angle = rod[K0] * rod[SHAFT_LENGTH]
    c, s = math.cos(angle), math.sin(angle)
    out[0], out[1], out[2] = force[0], c * force[1] + s * force[2], -s * force[1] + c * force[2]


@njit(cache=True, error_model="numpy", nogil=True)
def scale_to(v: Array, length: float) -> None:
    """Bring v (3,) to that length, in place."""
    factor = length / max(length3(v), 1e-300)
    for i in range(3):
        v[i] *= factor


@njit(cache=True, error_model="numpy", nogil=True)
def newton_matrix(row: Array, G: Array) -> None:
    """G (3, 3) = d n(base) / d (force in the tip frame), from the row at the base."""
    for i in range(3):
        for j in range(3):
            G[i, j] = row[24 + 4 * i + j]


@njit(cache=True, error_model="numpy", nogil=True)
def miss_of(row: Array, force: Array, miss: Array) -> float:
    """Set miss (3,) = force minus n(base), both in the base frame; returns its share of the force."""
    for i in range(3):
        miss[i] = force[i] - row[3 + i]
    return length3(miss) / max(length3(force), 1e-300)


@njit(cache=True, error_model="numpy", nogil=True)
def correct_once(rod: Array, force: Array, bend: float, x: Array, room: Room) -> tuple[float, float]:
    """One Newton step of the tip-frame force x (3,), in place. Returns (miss before it, determinant of G).

    Arguments: force (3,) base frame. Leaves the inverse of G in the room.
    """
    out, Gi, miss, step = room.out, room.inverse, room.vectors[0], room.vectors[1]
    sweep(rod, x, NO_STATIONS, bend, POSE_AND_FORCE_TANGENTS, out, room.work)
    error = miss_of(out[0], force, miss)
    newton_matrix(out[0], Gi)
    determinant = inverse3(Gi.copy(), Gi)
    apply3(Gi, miss, step)
    for i in range(3):
        x[i] += step[i]
    scale_to(x, length3(force))
    return error, determinant


@njit(cache=True, error_model="numpy", nogil=True)
def polish(
    rod: Array, force: Array, stations: Array, bend: float, x: Array, limit: float, goal: float, room: Room
) -> tuple[float, int]:
    """Refine x (3,) at full accuracy by Broyden steps from the room's inverse. Returns (last miss, sweeps).

    Arguments: limit: largest first miss that still counts as the same branch; goal: miss to reach.
    Leaves in room.out (n + 1, 48) the pose rows of the accepted x at the stations and the base.
    """
    out, Gi = room.out, room.inverse
    miss, step, change, spare = room.vectors[0], room.vectors[1], room.vectors[2], room.vectors[3]
    size, smallest, error = length3(force), 0.5 * limit, 0.0
    last = stations.shape[0]
    for sweeps in range(1, PASSES + 1):
        if sweeps > 1:
            for i in range(3):
                change[i] = miss[i]
        sweep(rod, x, stations, bend, POSE, out, room.work)
        error = miss_of(out[last], force, miss)
        if error < goal or not error < 2.0 * smallest:
            return error, sweeps
        smallest = min(error, smallest)
        if sweeps > 1:
            for i in range(3):
                change[i] -= miss[i]
            broyden(Gi, step, change, spare)
        apply3(Gi, miss, step)
        for i in range(3):
            x[i] += step[i]
        scale_to(x, size)
    return error, PASSES


@njit(cache=True, error_model="numpy", nogil=True)
def broyden(Gi: Array, step: Array, change: Array, scratch: Array) -> None:
    """Gi (3, 3), in place: Broyden's update of an inverse, after `step` (3,) changed the function by `change` (3,)."""
    apply3(Gi, change, scratch)
    along = step[0] * scratch[0] + step[1] * scratch[1] + step[2] * scratch[2]
    if abs(along) < 1e-300:
        return
    for i in range(3):
        scratch[i] = (step[i] - scratch[i]) / along
    for j in range(3):
        row = step[0] * Gi[0, j] + step[1] * Gi[1, j] + step[2] * Gi[2, j]
        for i in range(3):
            Gi[i, j] += scratch[i] * row


@njit(cache=True, error_model="numpy", nogil=True)
def hermite(s: float, span: float, x0: Array, d0: Array, x1: Array, d1: Array, out: Array) -> None:
    """Set out (3,) = cubic through (x0, d0) at 0 and (x1, d1) at `span`, at the place s * span."""
    a, b = 2.0 * s**3 - 3.0 * s**2 + 1.0, (s**3 - 2.0 * s**2 + s) * span
    c, d = 3.0 * s**2 - 2.0 * s**3, (s**3 - s**2) * span
    for i in range(3):
        out[i] = a * x0[i] + b * d0[i] + c * x1[i] + d * d1[i]


@njit(cache=True, error_model="numpy", nogil=True)
def land(rod: Array, goal: Array, bend: float, trust: float, x: Array, room: Room) -> tuple[bool, float, float, int]:
    """Newton from the prediction x (3,), in place. Returns (near enough, first miss, determinant, sweeps)."""
    first, before, determinant = 0.0, 1e300, 0.0
    for sweeps in range(1, 7):
        error, determinant = correct_once(rod, goal, bend, x, room)
        if sweeps == 1:
            first = error
            if not error < trust:
                return False, first, determinant, sweeps
        elif not error < max(0.3 * before, NEAR):
            return False, first, determinant, sweeps
        before = error
        if error < NEAR:
            return True, first, determinant, sweeps
    return False, first, determinant, 6


@njit(cache=True, error_model="numpy", nogil=True)
def drifted(start: Array, guess: Array, end: Array) -> bool:
    """Whether Newton went from `guess` to `end` (3,) by more than DRIFT of the step from `start`: another branch?"""
    moved = stepped = 0.0
    for i in range(3):
        moved += (end[i] - guess[i]) ** 2
        stepped += (guess[i] - start[i]) ** 2
    return moved > DRIFT * DRIFT * stepped


@njit(cache=True, error_model="numpy", nogil=True)
def quick_branch(rod: Array, force: Array, x: Array, room: Room) -> tuple[bool, int, int]:
    """Set x (3,) = tip-frame force on the branch from the unloaded shape, to about 1e-5. Returns (found, sweeps, steps).

    Gives up, for `branch.follow` to take over, where load steps keep failing or a fold may be near.
    """
    size = length3(force)
    number = load_number(rod, size)
    slope, x0, slope0, guess, end, goal = np.empty(3), np.zeros(3), np.zeros(3), np.empty(3), np.empty(3), np.empty(3)
    x[:] = 0.0
    unloaded_direction(rod, force, slope)
    load, h, span, sweeps, steps, failures = 0.0, min(1.0, UNIQUE_BELOW / max(number, 1e-300)), 0.0, 0, 0, 0
    while load < 1.0:
        h = 1.0 - load if load + 1.1 * h > 1.0 else h
        if span == 0.0:
            guess[:] = h * slope
        else:
            hermite(1.0 + h / span, span, x0, slope0, x, slope, guess)
        for i in range(3):
            goal[i] = (load + h) * force[i]
        scale_to(guess, (load + h) * size)
        end[:] = guess
        unique = (load + h) * number <= UNIQUE_BELOW * 1.001
        landed, first, determinant, used = land(rod, goal, COARSE, 3.0 if unique else TRUST, end, room)
        sweeps += used
        if landed and (unique or (determinant > NEAR_SINGULAR and not drifted(x, guess, end))):
            x0[:], slope0[:], x[:] = x, slope, end
            apply3(room.inverse, force, slope)
            load, span, steps = load + h, h, steps + 1
            h *= min(3.0, max(0.5, (0.3 * TRUST / max(first, 1e-9)) ** 0.25))
        else:
            h *= 0.4
            failures += 1
            if failures > 8:
                return False, sweeps, steps
    return True, sweeps, steps
