"""Compiled answer to a tip force in the base frame: cold along the branch from the unloaded shape, or warm from a guess."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import multiple_shooting as ms
from host.mechanics.branch import CONVERGED, FOLD, LARGEST_GUESS_ERROR, Nodes, follow, newton
from host.mechanics.cosserat_kernels import BODY_LENGTH, COARSE, FINE, POSE, ROW, SHAFT_LENGTH, sweep
from host.mechanics.rotations import conjugate, quaternion_product, turn_back
from host.mechanics.segments import cut, lay_loads
from host.mechanics.stability import unstable_modes
from host.mechanics.tip_shooting import (
    LANDED,
    NO_STATIONS,
    QUICK_BELOW,
    UNIQUE_BELOW,
    Room,
    correct_once,
    length3,
    load_number,
    polish,
    quick_branch,
    unloaded_direction,
)

Array = NDArray[np.float64]

GOAL_FINE, GOAL_EXACT = 1e-6, 1e-9  # share of the force by which n(base) may miss at the end
WARM_TRUST, WARM_BELOW = 0.3, 25.0  # a warm start further off, or under a higher load number, is solved cold
NO_FORCES = np.zeros((0, 3))


@njit(cache=True, error_model="numpy", nogil=True)
def solve_cold(
    rod: Array, force: Array, stations: Array, bend: float, x: Array, out: Array, work: Array
) -> tuple[int, float, int, int, int]:
    """Equilibrium on the branch from the unloaded shape. Returns (status, load reached, sweeps, load steps, unstable).

    Arguments: rod (9,); force (3,) N, base frame; stations (n,) m back from the tip, ascending, exposed; bend: FINE
    or EXACT. Written: x (3,) force in the tip frame; out (n + 1, 48) pose rows at the stations and the base.
    Status: `branch.CONVERGED`, or `FOLD` or `ITERATIONS` with the share of the load at which the branch ends.
    """
    size, goal = length3(force), GOAL_EXACT if bend < FINE else GOAL_FINE
    if size == 0.0:
        x[:] = 0.0
        sweep(rod, x, stations, bend, POSE, out, work)
        return CONVERGED, 1.0, 1, 0, 0
    used = 0
    if load_number(rod, size) <= QUICK_BELOW:
        room = Room(np.empty((3, 3)), np.empty((4, 3)), out, work)
        found, used, steps = quick_branch(rod, force, x, room)
        if found:
            miss, more = polish(rod, force, stations, bend, x, 10.0 * LANDED, goal, room)
            used += more
            if miss < goal and unstable_modes(rod, x, work) == 0:
                return CONVERGED, 1.0, used, steps, 0
    status, load, passes, steps, unstable = robust_branch(rod, force, stations, bend, x, out)
    return status, load, used + passes, steps, unstable


@njit(cache=True, error_model="numpy", nogil=True)
def solve_warm(
    rod: Array, force: Array, stations: Array, bend: float, x: Array, out: Array, work: Array
) -> tuple[bool, int]:
    """Equilibrium next to the guess x (3,), a force in the tip frame; refined in place. Returns (converged, sweeps).

    Arguments as `solve_cold`. Not converged where the guess is too far off to be sure of the branch: solve cold then.
    """
    size, goal = length3(force), GOAL_EXACT if bend < FINE else GOAL_FINE
    if size == 0.0:
        x[:] = 0.0
        sweep(rod, x, stations, bend, POSE, out, work)
        return True, 1
    if length3(x) == 0.0:
        unloaded_direction(rod, force, x)
    if load_number(rod, size) > WARM_BELOW:
        return False, 0
    room = Room(np.empty((3, 3)), np.empty((4, 3)), out, work)
    miss, determinant = correct_once(rod, force, COARSE, x, room)
    if not (miss < WARM_TRUST and determinant > 0.0):
        return False, 1
    miss, sweeps = polish(rod, force, stations, bend, x, max(0.2 * miss, LANDED), goal, room)
    return miss < goal, sweeps + 1


@njit(cache=True, error_model="numpy", nogil=True)
def robust_branch(
    rod: Array, force: Array, stations: Array, bend: float, x: Array, out: Array
) -> tuple[int, float, int, int, int]:
    """`solve_cold` by multiple shooting, for any load number: slower, with a wider and better watched path."""
    size = length3(force)
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    count = stations.shape[0]
    marks = np.empty(count + 3)
    marks[0], marks[1], marks[2] = 0.0, rod[BODY_LENGTH], total
    marks[3:] = total - stations
    segments = cut(rod, np.sort(marks), size)
    lay_loads(segments, force, np.zeros(3), NO_STATIONS, NO_FORCES, ms.N_START)
    lay_loads(segments, force, np.zeros(3), NO_STATIONS, NO_FORCES, ms.DN_START)
    n = segments.shape[0]
    nodes, slope = Nodes(np.empty((n + 1, 4)), np.empty((n + 1, 3))), np.empty((n + 1, 6))
    first = min(1.0, UNIQUE_BELOW / load_number(rod, size))
    status, load, passes, steps, unstable = follow(segments, nodes, first, COARSE, LARGEST_GUESS_ERROR)
    if status != CONVERGED:
        return status, load, passes, steps, unstable
    work = np.zeros(ms.WORK)
    ok, _, more, unstable = newton(segments, 1.0, nodes, bend, 1e-9, LARGEST_GUESS_ERROR, slope, work)
    if not ok:
        return FOLD, load, passes + more, steps, unstable
    positions = np.empty((n + 1, 3))
    lay_out(segments, 1.0, nodes, bend, positions, work)
    turn_back(nodes.Q[n], force, x)
    where = total - np.append(stations, total)
    rows_from_nodes(segments, nodes.Q, positions, force, where, out)
    return CONVERGED, 1.0, passes + more, steps, unstable


@njit(cache=True, error_model="numpy", nogil=True)
def lay_out(segments: Array, load: float, nodes: Nodes, bend: float, positions: Array, work: Array) -> None:
    """Work out the positions (n + 1, 3) of the nodes in the base frame, m."""
    work[7:10] = 0.0
    positions[0] = 0.0
    for i in range(segments.shape[0]):
        ms.cross_segment(segments[i], load, nodes.Q[i], nodes.M[i], bend, ms.STATE, work)
        positions[i + 1] = work[7:10]


@njit(cache=True, error_model="numpy", nogil=True)
def rows_from_nodes(segments: Array, Q: Array, positions: Array, force: Array, where: Array, out: Array) -> None:
    """Set out (k, 48) to pose rows, as a tip sweep would leave them, of the nodes nearest to the arc lengths where (k,)."""
    n = segments.shape[0]
    for j in range(where.shape[0]):
        node, here, best = 0, 0.0, abs(where[j])
        for i in range(n):
            here += segments[i, ms.LENGTH]
            if abs(where[j] - here) < best:
                node, best = i + 1, abs(where[j] - here)
        out[j, :ROW] = 0.0
        turn_back(Q[node], positions[node] - positions[n], out[j, 0:3])
        turn_back(Q[node], force, out[j, 3:6])
        out[j, 6:10] = quaternion_product(conjugate(Q[n]), Q[node])
