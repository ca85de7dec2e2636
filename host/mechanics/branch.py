"""The equilibrium on the branch that starts at the unloaded shape: load continuation that notices folds and crossings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import multiple_shooting as ms
from host.mechanics.riccati import correct, linearize
from host.mechanics.rotations import quaternion_of_vector, quaternion_product

Array = NDArray[np.float64]

CONVERGED, FOLD, ITERATIONS = 0, 1, 2
SMALLEST_LOAD_STEP = 1e-6
LARGEST_GUESS_ERROR = 0.15  # rad: a prediction further off than this is not trusted to be on the same branch
MAX_PASSES = 3000


class Nodes(NamedTuple):
    """The rod's state at the ends of its segments."""

    Q: Array  # (n + 1, 4) orientations
    M: Array  # (n + 1, 3) moments, N m


@njit(cache=True, error_model="numpy", nogil=True)
def unload(segments: Array, nodes: Nodes) -> None:
    """Set the nodes to the rod without load: straight where k0 = 0, an arc about e1 elsewhere."""
    Q, M, angle = nodes.Q, nodes.M, 0.0
    for i in range(segments.shape[0] + 1):
        Q[i, 0], Q[i, 1], Q[i, 2], Q[i, 3] = np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0
        M[i, 0] = M[i, 1] = M[i, 2] = 0.0
        if i < segments.shape[0]:
            angle += segments[i, ms.K0] * segments[i, ms.LENGTH]


@njit(cache=True, error_model="numpy", nogil=True)
def move_nodes(nodes: Nodes, step: Array, scale: float) -> None:
    """Move the nodes by scale * step (n + 1, 6); the tip's moment stays zero."""
    Q, M = nodes.Q, nodes.M
    last = Q.shape[0] - 1
    for i in range(last + 1):
        Q[i] = quaternion_product(Q[i], quaternion_of_vector(scale * step[i, :3]))
        Q[i] /= np.sqrt(np.sum(Q[i] * Q[i]))
        if i < last:
            M[i] += scale * step[i, 3:]


@njit(cache=True, error_model="numpy", nogil=True)
def size_of(step: Array) -> float:
    """Largest turn (rad) of a step (n + 1, 6)."""
    largest = 0.0
    for i in range(step.shape[0]):
        largest = max(largest, ms.norm3(step[i, :3]))
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def newton(
    segments: Array,
    load: float,
    nodes: Nodes,
    bend: float,
    tolerance: float,
    trust: float,
    by_load: Array,
    work: Array,
) -> tuple[bool, float, int, int]:
    """Newton at one load, in place. Returns (converged, first step's turn, passes, unstable modes).

    Gives up where the first step turns a section by more than `trust`, or a step is not a third of the one before.
    """
    n = segments.shape[0]
    phi, gap, step, gain = np.empty((n, 6, 8)), np.empty((n, 6)), np.empty((n + 1, 6)), np.empty((n, 3, 5))
    first = before = 0.0
    unstable = 0
    for iteration in range(8):
        linearize(segments, load, nodes.Q, nodes.M, bend, phi, gap, work)
        unstable = correct(nodes.Q, phi, gap, step, by_load, gain)
        size = size_of(step)
        if iteration == 0:
            first = size
            if not size < trust:
                return False, size, 1, unstable
        elif not size < max(0.3 * before, tolerance):
            return False, first, iteration + 1, unstable
        move_nodes(nodes, step, 1.0)
        if size < tolerance:
            return True, first, iteration + 1, unstable
        before = size
    return False, first, 8, unstable


@njit(cache=True, error_model="numpy", nogil=True)
def follow(segments: Array, nodes: Nodes, first_step: float, bend: float, trust: float) -> tuple[int, float, int, int, int]:
    """Nodes carried along the branch from no load to full load. Returns (status, load, passes, load steps, unstable).

    Arguments: segments (n, 18) with lane 6 = the full load; nodes (n + 1), written; first_step: share
    of the load to begin with; bend: see `cosserat_kernels`; trust: LARGEST_GUESS_ERROR, or less for a closer watch.
    Where the number of unstable modes changes, the step must be small and the prediction good before it is accepted:
    there another branch crosses, and a long step could end on it.
    """
    n = segments.shape[0]
    work = np.zeros(ms.WORK)
    slope, old_slope, step = np.zeros((n + 1, 6)), np.zeros((n + 1, 6)), np.zeros((n + 1, 6))
    unload(segments, nodes)
    _, _, passes, unstable = newton(segments, 0.0, nodes, bend, 1e-6, 1.0, slope, work)
    load, h, old_h, steps = 0.0, first_step, 0.0, 0
    ahead = Nodes(nodes.Q.copy(), nodes.M.copy())
    while load < 1.0:
        h = min(h, 1.0 - load)
        if load + h > 1.0 - 1e-9:
            h = 1.0 - load
        ratio = 0.5 * h / old_h if old_h > 0.0 else 0.0
        step[:] = (1.0 + ratio) * slope - ratio * old_slope
        ahead.Q[:], ahead.M[:] = nodes.Q, nodes.M
        move_nodes(ahead, step, h)
        new_slope = np.zeros((n + 1, 6))
        ok, error, used, modes = newton(segments, load + h, ahead, bend, 1e-4, trust, new_slope, work)
        passes += used
        if ok and modes != unstable and (h > 1e-3 or error > 0.02 * h * size_of(slope)):
            ok = h < 4.0 * SMALLEST_LOAD_STEP and error < 0.05
        if ok:
            nodes.Q[:], nodes.M[:] = ahead.Q, ahead.M
            old_slope[:], slope[:] = slope, new_slope
            load, old_h, unstable, steps = load + h, h, modes, steps + 1
            h *= min(3.0, max(0.5, (0.3 * trust / max(error, 1e-9)) ** (1.0 / 3.0)))
        else:
            h *= 0.3
        if h < SMALLEST_LOAD_STEP and load < 1.0:
            return FOLD, load, passes, steps, unstable
        if passes > MAX_PASSES:
            return ITERATIONS, load, passes, steps, unstable
    return CONVERGED, load, passes, steps, unstable
