"""Levenberg-Marquardt on the tip-frame force: coarse sweeps with exact tangents until close, then fine ones without."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.estimation.spatial_residuals import MOST_ROWS, ROWS_OF_CASE, SCRATCH, MeasuredPose, residuals
from host.mechanics.base_force import solve_cold
from host.mechanics.branch import CONVERGED
from host.mechanics.cosserat_kernels import (
    ALL_TANGENTS,
    COARSE,
    EXACT,
    POSE,
    POSE_AND_FORCE_TANGENTS,
    ROW,
    WORK,
    sweep,
)
from host.mechanics.small_matrices import apply3, inverse3
from host.mechanics.tip_shooting import NO_STATIONS, broyden, length3, load_number, newton_matrix, scale_to

Array = NDArray[np.float64]

ON_BRANCH = 0.0
QUICK, CAREFUL = 0.65, 0.4  # of the fine sweeps: 4e-9 and 1e-10 m at the tip in the worst of the benchmark's inputs
MOST_ITERATIONS = 40
MOST_REFINEMENTS = 12
CLOSE = 0.04  # a step below this share of the force, or CLOSE_N, is the last one of the coarse sweeps
CLOSE_N = 2e-3
GOAL_N, CAREFUL_GOAL_N = 2e-7, 1e-9  # expected error of the force at which the fine sweeps stop, QUICK and CAREFUL
LARGEST_DAMPING = 1e9
LONGEST_STEP = 6.0  # load number of the longest step: a longer one leaps over the hills between two answers
LARGEST_REFINEMENT_N = 0.2
NEGLIGIBLE = 1e-5  # weighted cost, far below noise, that explains the poses even where the force still creeps
UNIT_TOLERANCE = 1e-3  # by which a measured quaternion may differ from unit length
LARGEST_STD_N = 10.0  # stands in a covariance for a direction about which the poses say nothing
# Layout of what `estimate_sample` leaves: force, covariance, then the residual of the thesis.
COVARIANCE, RESIDUAL, FOUND = 3, 12, 13
BAD_INPUT = -1
SAME = 1e-2  # squared distance over its variance below which two forces are one


class Sensors(NamedTuple):
    """What is the same for all samples of one set of sensors."""

    case: int
    offsets: Array  # (k,) arc lengths back from the tip, m
    whitening: Array  # (m, m), see `MeasuredPose`
    length_m: float  # of the distal shaft, which scales the thesis' residual


class Search(NamedTuple):
    """Limits of the search of one estimate: largest force and tolerances."""

    largest_N: float  # no force above it is considered
    starts: Array  # (n, 3) forces to start from where the first try fails
    fair: float  # weighted cost that ends the search for a better force
    acceptable: float  # weighted cost above which no force explains the poses


class Scratch(NamedTuple):
    """Arrays of one estimation, used again from sample to sample; `new_scratch` makes them."""

    sweep: Array
    residual: Array
    rows: Array  # (k + 1, 48)
    raw: Array  # (MOST_ROWS,) residuals, and their sensitivities, before ...
    raw_A: Array
    z: Array  # ... and after whitening
    A: Array
    kept_raw_A: Array  # sensitivities of the last accepted force
    kept_A: Array
    information: Array  # (3, 3) 1/N^2
    inverse: Array  # (3, 3)
    vectors: Array  # (4, 3): trial, slope, step, force in the tip frame


@njit(cache=True, error_model="numpy", nogil=True)
def new_scratch(sensors: int) -> Scratch:
    """Return scratch memory for a number of sensors."""
    m = MOST_ROWS
    return Scratch(
        np.zeros(WORK),
        np.zeros(SCRATCH),
        np.zeros((sensors + 1, ROW)),
        np.zeros(m),
        np.zeros((m, 3)),
        np.zeros(m),
        np.zeros((m, 3)),
        np.zeros((m, 3)),
        np.zeros((m, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((4, 3)),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def cost_at(p: MeasuredPose, x: Array, bend: float, tangents: bool, s: Scratch) -> float:
    """|W (measured - modelled)|^2 at the force x (3,) in N; fills s.raw, s.z and, with `tangents`, s.raw_A, s.A."""
    sweep(p.rod, x, p.stations, bend, ALL_TANGENTS if tangents else POSE, s.rows, s.sweep)
    residuals(p, s.rows, tangents, s.raw, s.raw_A, s.residual)
    m, cost = ROWS_OF_CASE[p.case], 0.0
    for i in range(m):
        z = a0 = a1 = a2 = 0.0
        for j in range(i + 1):
            w = p.whitening[i, j]
            z += w * s.raw[j]
            if tangents:
                a0, a1, a2 = a0 + w * s.raw_A[j, 0], a1 + w * s.raw_A[j, 1], a2 + w * s.raw_A[j, 2]
        s.z[i], cost = z, cost + z * z
        if tangents:
            s.A[i, 0], s.A[i, 1], s.A[i, 2] = a0, a1, a2
    base = s.rows[s.rows.shape[0] - 1]
    for k in range(p.prior.shape[0]):
        t = p.prior[k]
        s.z[m + k] = -(t[0] * base[3] + t[1] * base[4] + t[2] * base[5])
        cost += s.z[m + k] ** 2
        if tangents:
            for c in range(3):
                s.A[m + k, c] = t[0] * base[24 + c] + t[1] * base[28 + c] + t[2] * base[32 + c]
    return cost


@njit(cache=True, error_model="numpy", nogil=True)
def cost_on_branch(p: MeasuredPose, force: Array, s: Scratch) -> float:
    """`cost_at` with tangents by a force (3,) in the base frame, of the equilibrium that grows from the unloaded shape.

    Leaves the force in the tip frame in s.vectors[3]; 1e300 where the branch folds back. The pose is a far smoother
    function of this force than of the one in the tip frame where the catheter is soft and pulled.
    """
    out, x = np.zeros((1, ROW)), s.vectors[3]
    status, _, _, _, _ = solve_cold(p.whole_rod, force, NO_STATIONS, EXACT, x, out, s.sweep)
    if status != CONVERGED:
        return 1e300
    sweep(p.whole_rod, x, NO_STATIONS, EXACT, POSE_AND_FORCE_TANGENTS, out, s.sweep)
    G, inverse = np.empty((3, 3)), np.empty((3, 3))
    newton_matrix(out[0], G)
    inverse3(G, inverse)
    cost = cost_at(p, x, EXACT, True, s)
    for k in range(ROWS_OF_CASE[p.case] + p.prior.shape[0]):
        for A in (s.A, s.raw_A):
            a0, a1, a2 = A[k, 0], A[k, 1], A[k, 2]
            for c in range(3):
                A[k, c] = a0 * inverse[0, c] + a1 * inverse[1, c] + a2 * inverse[2, c]
    return cost


@njit(cache=True, error_model="numpy", nogil=True)
def keep(m: int, s: Scratch) -> None:
    """The sensitivities of a force that was accepted, and with them the information matrix A' A and the slope A' z."""
    slope = s.vectors[1]
    for i in range(3):
        slope[i] = 0.0
        for j in range(3):
            s.information[i, j] = 0.0
    for k in range(m):
        for i in range(3):
            s.kept_A[k, i], s.kept_raw_A[k, i] = s.A[k, i], s.raw_A[k, i]
            slope[i] += s.A[k, i] * s.z[k]
            for j in range(3):
                s.information[i, j] += s.A[k, i] * s.A[k, j]


@njit(cache=True, error_model="numpy", nogil=True)
def damped_step(damping: float, s: Scratch) -> float:
    """s.vectors[2] = Levenberg-Marquardt step (3,), damped in proportion to the diagonal; returns its length in N."""
    lower_limit = 1e-9 * (s.information[0, 0] + s.information[1, 1] + s.information[2, 2]) + 1e-300
    for i in range(3):
        for j in range(3):
            s.A[i, j] = s.information[i, j]
        s.A[i, i] += damping * (s.information[i, i] + lower_limit) + 1e-6 * lower_limit
    inverse3(s.A[:3], s.inverse)
    step = s.vectors[2]
    apply3(s.inverse, s.vectors[1], step)
    return length3(step)


@njit(cache=True, error_model="numpy", nogil=True)
def descend(
    p: MeasuredPose, largest_N: float, bend: float, close: float, close_N: float, x: Array, s: Scratch
) -> tuple[bool, float, int]:
    """Move x (3,) until a step is below close_N or the share `close` of x. Returns (settled, cost before it, sweeps).

    A step that does not lower the cost is damped; forces above `largest_N` are not entered. x is the force in the tip
    frame, or with bend = ON_BRANCH the force in the base frame (`cost_on_branch`).
    """
    m = ROWS_OF_CASE[p.case] + p.prior.shape[0]
    damping, sweeps = 0.0, 1
    longest = LONGEST_STEP / load_number(p.whole_rod, 1.0)
    cost = cost_at(p, x, bend, True, s) if bend != ON_BRANCH else cost_on_branch(p, x, s)
    keep(m, s)
    trial, step = s.vectors[0], s.vectors[2]
    for _ in range(MOST_ITERATIONS):
        size = damped_step(damping, s)
        shorter = min(1.0, longest / max(size, 1e-300))
        for i in range(3):
            trial[i] = x[i] + shorter * step[i]
        if size < max(close_N, close * length3(x)) and damping < 1e-2:
            x[:] = trial
            return True, cost, sweeps
        new = 1e300
        if trial[0] ** 2 + trial[1] ** 2 + trial[2] ** 2 <= largest_N**2:
            new = cost_at(p, trial, bend, True, s) if bend != ON_BRANCH else cost_on_branch(p, trial, s)
            sweeps += 1
        if new < cost:
            x[:] = trial
            cost = new
            keep(m, s)
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = 10.0 * damping if damping > 0.0 else 1e-3
            if damping > LARGEST_DAMPING or size < 0.1 * close_N:
                return size < close_N, cost, sweeps
    return False, cost, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def goal_of(p: MeasuredPose) -> float:
    """Expected error of the force, N, at which the search stops."""
    return GOAL_N if p.bend >= QUICK else CAREFUL_GOAL_N


@njit(cache=True, error_model="numpy", nogil=True)
def refine(p: MeasuredPose, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """Fine phase: Broyden steps of x (3,), in place, from the kept sensitivities. Returns (settled, cost, sweeps).

    Stops where the error left, guessed from how fast the steps shrink, is below `goal_of`; the residuals s.raw and s.z
    are carried over the last step by their sensitivities.
    """
    m = ROWS_OF_CASE[p.case] + p.prior.shape[0]
    change, slope, step = s.vectors[0], s.vectors[1], s.vectors[2]
    before, settled, cost, sweeps = damped_step(0.0, s), False, 0.0, 0
    goal = goal_of(p)
    while sweeps < MOST_REFINEMENTS and not settled:
        cost = cost_at(p, x, p.bend, False, s)
        sweeps += 1
        for i in range(3):
            change[i], slope[i] = slope[i], 0.0
            for k in range(m):
                slope[i] += s.kept_A[k, i] * s.z[k]
            change[i] -= slope[i]
        if sweeps > 1:
            broyden(s.inverse, step, change, s.vectors[3])
        apply3(s.inverse, slope, step)
        size = length3(step)
        if not size < LARGEST_REFINEMENT_N:
            return False, cost, sweeps
        for i in range(3):
            x[i] += step[i]
        shrink = size / max(before, 1e-300)
        if shrink > 0.9 and size > 10.0 * goal and sweeps > 1:
            break
        shrink = min(shrink, 0.9)
        settled = size * shrink / (1.0 - shrink) < goal
        before = size
    cost = 0.0
    for k in range(m):
        move = move_raw = 0.0
        for i in range(3):
            move += s.kept_A[k, i] * step[i]
            move_raw += s.kept_raw_A[k, i] * step[i]
        s.z[k] -= move
        s.raw[k] -= move_raw
        cost += s.z[k] ** 2
    return settled, cost, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def unweighted(case: int, length_m: float, s: Scratch) -> float:
    """The thesis' cost (5.6) to (5.11) at the answer, root of the sum of squares: positions over `length_m`, turns."""
    total = 0.0
    positions = 0 if case >= 5 else 3
    for i in range(ROWS_OF_CASE[case]):
        scale = 1.0 / length_m if i < positions else 1.0
        total += (scale * s.raw[i]) ** 2
    return math.sqrt(total)


@njit(cache=True, error_model="numpy", nogil=True)
def estimate(p: MeasuredPose, largest_N: float, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """From the guess x (3,), in place, to the force that explains the sample best nearby. (settled, cost, sweeps).

    Where the chord steps do not shrink (poses that hardly determine the force, or a force beyond `largest_N`, which is
    brought back to it first), fine damped steps go on in their place, so that the cost is always that of x itself.
    """
    settled, cost, sweeps = descend(p, largest_N, COARSE, CLOSE, CLOSE_N, x, s)
    if not settled:
        return False, cost, sweeps
    settled, cost, more = refine(p, x, s)
    sweeps += more
    if not settled:
        scale_to(x, min(length3(x), largest_N))
        settled, cost, more = descend(p, largest_N, p.bend, 0.0, goal_of(p), x, s)
        sweeps += more
    return (settled or cost < NEGLIGIBLE) and length3(x) <= 1.01 * largest_N, cost, sweeps


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_on_branch(p: MeasuredPose, largest_N: float, x: Array, s: Scratch) -> tuple[bool, float, int]:
    """`estimate` among the equilibria that grow from the unloaded shape, from no force; x (3,) written, tip frame.

    Slower by the equilibria it solves, but it arrives where the tip-frame force is too sensitive to search for.
    """
    force = np.zeros(3)
    settled, cost, sweeps = descend(p, largest_N, ON_BRANCH, 1e-4, 1e-6, force, s)
    if not settled and not cost < 1.0:
        return False, cost, sweeps
    x[:] = s.vectors[3]
    settled, cost, more = estimate(p, largest_N, x, s)
    return settled, cost, sweeps + more


@njit(cache=True, error_model="numpy", nogil=True)
def sample_of(
    rod: Array, offsets: Array, case: int, positions: Array, quaternions: Array, W: Array, bend: float, prior: Array
) -> MeasuredPose:
    """Make a `MeasuredPose` of checked arrays: stations end at the base, or at the last sensor if that is enough."""
    total = rod[6] + rod[7]
    stations, inside = np.minimum(offsets, total), np.maximum(offsets - total, 0.0)
    used = rod
    if case >= 5 and prior.shape[0] == 0:
        used = rod.copy()
        last = stations[stations.shape[0] - 1]
        used[6] = min(rod[6], last)
        used[7] = max(0.0, last - rod[6])
    return MeasuredPose(used, rod, stations, inside, case, positions, quaternions, W, bend, prior)


@njit(cache=True, error_model="numpy", nogil=True)
def covariance_of(s: Scratch, covariance: Array) -> None:
    """Set covariance (3, 3), N^2, of the force found, from the information that the poses carry."""
    for i in range(3):
        for j in range(3):
            s.A[i, j] = s.information[i, j] + (1.0 / LARGEST_STD_N**2 if i == j else 0.0)
    inverse3(s.A[:3], covariance)
