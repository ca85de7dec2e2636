"""Plants of the simulations of chapter 7: a catheter in the plane, its tip against a wall that is a linear spring (7.3.1).

Base frame of chapter 7: x along the catheter's axis, y across it, positive with positive curvature. The wall lies along x
and pushes the tip towards -y, without friction. Two plants stand side by side: the rod of chapter 3, as in the thesis, and
the circular arcs of chapter 2, for comparison.

The thesis solves the rod for a known force by Algorithm 3.1, and finds the force by Newton's method around it
(`contact_by_algorithm_3_1`). The scans of gains use one Newton's method on both, with the exact derivatives of one sweep
along the rod. It finds the same contact in some 20 us, and it continues where Algorithm 3.1 does not converge.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import pcar_kernels
from host.mechanics.cosserat_kernels import EXACT, POSE, POSE_AND_FORCE_TANGENTS, ROW, WORK, sweep
from host.mechanics.pcar import NO_DRAG, arcs_of
from host.mechanics.rod import rod_record
from host.mechanics.small_matrices import apply3, inverse3
from host.mechanics.stability import unstable_modes
from host.mechanics.thesis_reference import ELEMENTS, ORIENTATION_THRESHOLD, algorithm_3_1
from host.mechanics.tip_shooting import NO_STATIONS
from protocol.catheter import load_catheter

Array = NDArray[np.float64]

TISSUE_N_PER_M = 1000.0
# Newton's method ends where the tip is this near to the tissue (m) and the other components of the force are this small (N).
TIP_m, LOAD_N = 1e-10, 1e-9
# It gives up after so many passes, where a step is not half the one before, or where the first is longer than this (N).
PASSES, SHRINK, FIRST_N = 12, 0.5, 0.1
# Smallest part of the way between two instants: below it, the catheter snaps.
SMALLEST_STEP = 1.0 / 256


class PlantModel(NamedTuple):
    """Catheter and tissue: `record` (9,) of `rod.rod_record`; `arcs_m` (m), `EI` (N m2) of the arcs, for not `is_rod`."""

    is_rod: bool
    length_m: float
    record: Array
    arcs_m: Array
    EI: Array
    tissue_N_per_m: float


class RestingTip(NamedTuple):
    """Outcome at one instant: whether an equilibrium was found, the force across (N), the tip along and across (m)."""

    found: bool
    force_N: float
    x: float
    y: float


NOT_FOUND = RestingTip(False, math.inf, math.nan, math.nan)


class Instant(NamedTuple):
    """What the plant is given: curvature (1/m), body outside (m, negative: in the sheath), wall (m), factor of stiffness."""

    curvature: float
    insertion_m: float
    wall_m: float
    stiffness: float


@lru_cache(maxsize=8)
def plant_model(catheter: str, is_rod: bool) -> PlantModel:
    """Return the plant of a catheter file; the circular arcs if not `is_rod`."""
    loaded = load_catheter(catheter)
    assert loaded.pcar is not None
    arcs_m, EI = np.array(loaded.pcar.distal_arcs_m), np.array(arcs_of(loaded, 0.001, 0.0).EI_N_m2)
    return PlantModel(is_rod, loaded.distal_length_m, rod_record(loaded, 0.001, 0.0), arcs_m, EI, TISSUE_N_PER_M)


@njit(cache=True, error_model="numpy")
def rest(model: PlantModel, at: Instant, before: Instant, x: Array) -> RestingTip:
    """Return where the tip rests, followed from `before` while that is stable, else from the unloaded shape.

    x (3,): force in the tip frame (N), zero without contact: at `before`, then at `at`.
    """
    if not model.is_rod:
        return _arcs_contact(model, at, math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), x)
    rod, out, work = model.record.copy(), np.zeros((1, ROW)), np.zeros(WORK)
    if x[0] != 0.0 or x[1] != 0.0 or x[2] != 0.0:
        found = _follow(model, before, at, x, rod, out, work)
        if found.found and _stable(model, rod, x, out[0], work):
            return found
    # Not in contact before, or it left the wall or snapped: the wall comes from where the unloaded tip just touches it.
    x[:] = 0.0
    _place(model, at, rod)
    sweep(rod, x, NO_STATIONS, EXACT, POSE, out, work)
    along, across = -out[0, 2], out[0, 1]
    if across <= at.wall_m:
        return RestingTip(True, 0.0, along, across)
    found = _follow(model, Instant(at.curvature, at.insertion_m, across, at.stiffness), at, x, rod, out, work)
    if found.found and _stable(model, rod, x, out[0], work):
        return found
    return NOT_FOUND


@njit(cache=True, error_model="numpy")
def _stable(model: PlantModel, rod: Array, x: Array, row: Array, work: Array) -> bool:
    """Whether the contact with the force x (3,) is stable, in the plane and out of it; row (48,): of its last sweep.

    The spring removes one unstable mode of the free tip where the force falls as the tip is pressed back, compliances added.
    """
    modes = unstable_modes(rod, x, work)
    if modes == 0:
        return True
    G, Gi = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            G[i, j] = row[24 + 4 * i + j]
    inverse3(G, Gi)
    pressed_back = -(row[16] * Gi[0, 1] + row[17] * Gi[1, 1] + row[18] * Gi[2, 1])
    return modes == 1 and pressed_back + 1.0 / model.tissue_N_per_m < 0.0


@njit(cache=True, error_model="numpy")
def _place(model: PlantModel, at: Instant, rod: Array) -> None:
    """Set the record rod (9,) for an instant, as `rod.rod_record` does."""
    for i in range(6):
        rod[i] = model.record[i] / at.stiffness
    rod[6], rod[7], rod[8] = model.length_m + min(at.insertion_m, 0.0), max(at.insertion_m, 0.0), at.curvature


@njit(cache=True, error_model="numpy")
def _follow(model: PlantModel, a: Instant, b: Instant, x: Array, rod: Array, out: Array, work: Array) -> RestingTip:
    """Return the contact at b, followed from the force x (3,) at a in steps that Newton's method can take; x is moved."""
    done, step, ahead = 0.0, 1.0, np.empty(3)
    while step >= SMALLEST_STEP:
        share = min(1.0, done + step)
        here = Instant(
            a.curvature + share * (b.curvature - a.curvature),
            a.insertion_m + share * (b.insertion_m - a.insertion_m),
            a.wall_m + share * (b.wall_m - a.wall_m),
            a.stiffness + share * (b.stiffness - a.stiffness),
        )
        _place(model, here, rod)
        ahead[:] = x
        found = _press(rod, here.wall_m, model.tissue_N_per_m, ahead, out, work)
        if found.found:
            x[:] = ahead
            done, step = share, 2.0 * step
            if done == 1.0:
                return found
        else:
            step *= 0.5
    return NOT_FOUND


@njit(cache=True, error_model="numpy")
def _press(rod: Array, wall_m: float, tissue_N_per_m: float, x: Array, out: Array, work: Array) -> RestingTip:
    """Newton's method on the force x (3,) in the tip frame, in place: (0, F, 0) in the base frame, y = wall + F / K_t."""
    J, Ji, miss, step = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    limit = FIRST_N
    for _ in range(PASSES):
        sweep(rod, x, NO_STATIONS, EXACT, POSE_AND_FORCE_TANGENTS, out, work)
        row = out[0]
        # The rod bends towards -e2 of its base frame (our y), with e3 along the axis (our x); rho is minus the tip.
        along, across, force = -row[2], row[1], row[4]
        miss[0], miss[1], miss[2] = -row[3], wall_m + force / tissue_N_per_m - across, -row[5]
        if abs(miss[1]) < TIP_m and abs(miss[0]) + abs(miss[2]) < LOAD_N:
            return RestingTip(force > 0.0, force, along, across)
        for j in range(3):
            J[0, j], J[2, j] = row[24 + j], row[32 + j]
            J[1, j] = row[16 + j] - row[28 + j] / tissue_N_per_m
        inverse3(J, Ji)
        apply3(Ji, miss, step)
        size = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if not size < limit:
            break
        limit = max(SHRINK * size, LOAD_N)
        for i in range(3):
            x[i] += step[i]
    return NOT_FOUND


def contact_by_algorithm_3_1(
    model: PlantModel, at: Instant, elements: int = ELEMENTS, threshold: float = ORIENTATION_THRESHOLD
) -> RestingTip:
    """Return the contact as the thesis finds it: Newton-Raphson on the force, Algorithm 3.1 for each (Fig. 7.3).

    elements: of Euler's method along the rod; threshold: of the orientation (sum of quaternion components). The slope of
    the depth is a difference quotient over 1 mN. A step adds 20 mN at most: a longer one may end at another equilibrium, in
    which the tip is folded over. Not found where Algorithm 3.1 does not converge.
    """
    rod, difference_N, longest_N = model.record.copy(), 1e-3, 0.02
    _place(model, at, rod)

    def tip(force_N: float) -> tuple[bool, float, float]:
        found = algorithm_3_1(rod, np.array([0.0, force_N, 0.0]), 0.0, elements, threshold)
        return bool(found.converged), float(found.position_m[2]), float(-found.position_m[1])

    force = 0.0
    for _ in range(50):
        there, x, y = tip(force)
        near, _, y_near = tip(force + difference_N)
        depth_m = y - at.wall_m - force / model.tissue_N_per_m
        if force == 0.0 and depth_m <= 0.0:
            return RestingTip(there, 0.0, x, y)
        if abs(depth_m) < 1e-9:
            return RestingTip(there, force, x, y)
        if not (there and near):
            break
        step_N = depth_m / (1.0 / model.tissue_N_per_m - (y_near - y) / difference_N)
        force = max(force + min(step_N, longest_N), 0.5 * force)
    return NOT_FOUND


@njit(cache=True)
def _arcs_shape(
    model: PlantModel, at: Instant, force_N: float, length: Array, kappa0: Array, kappa: Array, work: Array
) -> tuple[int, float, float]:
    """(status, x, y) of the tip of the arcs under (0, -force)."""
    inside = max(0.0, -at.insertion_m)
    length[0], kappa0[0] = max(0.0, at.insertion_m), 0.0
    for i in range(model.arcs_m.size):
        length[i + 1] = max(0.0, model.arcs_m[i] - inside)
        inside = max(0.0, inside - model.arcs_m[i])
        kappa0[i + 1] = at.curvature
    external = pcar_kernels.Load(0.0, -force_N, NO_DRAG)
    shaft = pcar_kernels.Shaft(length, at.stiffness * model.EI, np.zeros_like(model.EI), kappa0)
    status, _, share = pcar_kernels.load_path(shaft, external, kappa, work)
    x, y, _ = pcar_kernels.evaluate(length, kappa, external, share, work)
    return status, x, y


@njit(cache=True)
def _arcs_contact(model: PlantModel, at: Instant, guess_N: float, carried: Array) -> RestingTip:
    """Contact of the arcs by regula falsi; carried (3,): set to the force. A shape that folds counts as too much force."""
    n = model.EI.size
    length, kappa0, kappa, work = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((pcar_kernels.ROWS, n))
    carried[:] = 0.0
    _, x, y = _arcs_shape(model, at, 0.0, length, kappa0, kappa, work)
    if y <= at.wall_m:
        return RestingTip(True, 0.0, x, y)
    low, high, low_gap, high_gap, status = 0.0, max(0.02, 1.5 * guess_N), y - at.wall_m, 0.0, 0
    for _ in range(30):
        status, x, y = _arcs_shape(model, at, high, length, kappa0, kappa, work)
        high_gap = y - at.wall_m - high / model.tissue_N_per_m
        if status != 0 or high_gap <= 0.0:
            break
        low, low_gap, high = high, high_gap, 2.0 * high
    middle = low
    for k in range(60):
        share = low_gap / (low_gap - high_gap) if status == 0 and k % 3 != 2 else 0.5
        middle = low + min(max(share, 0.01), 0.99) * (high - low)
        status_here, x, y = _arcs_shape(model, at, middle, length, kappa0, kappa, work)
        gap = y - at.wall_m - middle / model.tissue_N_per_m
        if status_here != 0 or gap <= 0.0:
            high, high_gap, status = middle, gap, status_here
        else:
            low, low_gap = middle, gap
        if high - low < 1e-7 or (status_here == 0 and abs(gap) < 1e-9):
            break
    carried[1] = middle
    return RestingTip(True, middle, x, y)
