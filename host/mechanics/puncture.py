"""The catheter through a puncture: one of its points held in place (2.19), and the reaction that holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.mechanics import pcar_kernels as kernels
from host.mechanics.pcar import NO_DRAG, Arcs, Equilibrium, Status
from host.mechanics.pcar_kernels import Load, Shaft
from protocol.errors import InputError

Array = NDArray[np.float64]

STEP_LIMIT = 200
SMALLEST_STEP = 1e-4
TOLERANCE_rad = 1e-10


@dataclass(frozen=True)
class PuncturedEquilibrium:
    """A static shape through a puncture, and the force of the tissue's hole on the catheter."""

    equilibrium: Equilibrium
    reaction_N: Array  # (2,) base frame


class Hole(NamedTuple):
    """The held point of the catheter, and room for the arcs up to it."""

    arc: int  # in which the point lies
    part: float  # how far into it, m
    point: Array  # (2,) where it is held, m
    short: Array  # (arc + 1,) lengths of the arcs up to the point
    short_work: Array  # (ROWS, arc + 1)


@njit(cache=True, nogil=True, error_model="numpy")
def add_reaction(length: Array, hole: Hole, reaction: Array, kappa: Array, work: Array) -> tuple[float, float]:
    """Add the reaction's moments to `work` after `evaluate`; leaves the held point's levers in `hole.short_work`.

    The rows of the point's own arc are scaled by part / length, as only that share of the arc feels the reaction.
    Result: the point's position (m).
    """
    arc, part, short, short_work = hole.arc, hole.part, hole.short, hole.short_work
    for i in range(arc):
        short[i] = length[i]
    short[arc] = part
    count, held = arc + 1, Load(reaction[0], reaction[1], np.zeros((0, 2)))
    x, y, _ = kernels.evaluate(short[:count], kappa[:count], held, 1.0, short_work)
    kernels.arms(short_work)
    share = part / length[arc]
    for i in range(count):
        scale = share if i == arc else 1.0
        work[kernels.MOMENT, i] += scale * short_work[kernels.MOMENT, i]
        work[kernels.COUPLING, i] += scale * short_work[kernels.COUPLING, i]
        work[kernels.DIAGONAL, i] += scale * scale * short_work[kernels.DIAGONAL, i]
        short_work[kernels.ARM_X, i] *= scale
        short_work[kernels.ARM_Y, i] *= scale
    return x, y


@njit(cache=True, nogil=True, error_model="numpy")
def constrained_step(
    shaft: Shaft,
    external: Load,
    load: float,
    hole: Hole,
    compliance: float,
    kappa: Array,
    reaction: Array,
    work: Array,
) -> tuple[int, float, float, float]:
    """One Newton step of shape and reaction together; the step of `kappa` is left in work[STEP].

    The held point is off `point` by `compliance` (m/N) times the reaction. Result: negative directions of the second
    variation within the constraint (0 when stable, -1 when the point cannot be moved both ways), turning of the step
    (rad), step of the reaction (2) in N.
    """
    length, arc, point, short_work = shaft.length, hole.arc, hole.point, hole.short_work
    kernels.evaluate(length, kappa, external, load, work)
    x, y = add_reaction(length, hole, reaction, kappa, work)
    negative, _ = kernels.newton_step(shaft, kappa, work)
    for i in range(length.size):
        inside = i <= arc
        work[kernels.ARM_X, i] = -short_work[kernels.ARM_Y, i] if inside else 0.0
        work[kernels.ARM_Y, i] = short_work[kernels.ARM_X, i] if inside else 0.0
    kernels.back_substitute(length, work, kernels.ARM_X)
    kernels.back_substitute(length, work, kernels.ARM_Y)
    gap_x, gap_y = point[0] - x - compliance * reaction[0], point[1] - y - compliance * reaction[1]
    s_xx, s_xy, s_yx, s_yy = compliance, 0.0, 0.0, compliance
    for i in range(arc + 1):
        row_x, row_y = -length[i] * short_work[kernels.ARM_Y, i], length[i] * short_work[kernels.ARM_X, i]
        gap_x -= row_x * work[kernels.STEP, i]
        gap_y -= row_y * work[kernels.STEP, i]
        s_xx += row_x * work[kernels.ARM_X, i]
        s_xy += row_x * work[kernels.ARM_Y, i]
        s_yx += row_y * work[kernels.ARM_X, i]
        s_yy += row_y * work[kernels.ARM_Y, i]
    determinant = s_xx * s_yy - s_xy * s_yx
    if not abs(determinant) > 1e-12 * (abs(s_xx) + abs(s_yy)) ** 2:
        return -1, 0.0, 0.0, 0.0
    d_x = (s_yy * gap_x - s_xy * gap_y) / determinant
    d_y = (s_xx * gap_y - s_yx * gap_x) / determinant
    turning = 0.0
    for i in range(length.size):
        work[kernels.STEP, i] += d_x * work[kernels.ARM_X, i] + d_y * work[kernels.ARM_Y, i]
        turning += abs(length[i] * work[kernels.STEP, i])
    # inertia: the tangent's negative directions less those that the two constraints take away
    positive = 2 if determinant > 0.0 and s_xx + s_yy > 0.0 else (0 if determinant > 0.0 else 1)
    return negative + positive - 2, turning, d_x, d_y


@njit(cache=True, nogil=True, error_model="numpy")
def constrained_path(
    shaft: Shaft, external: Load, hole: Hole, kappa: Array, reaction: Array, work: Array
) -> tuple[int, int, float, int]:
    """From the loaded free shape to the held one: the hole is a spring that stiffens without bound.

    Where the free shape has no equilibrium at full load, the load grows together with the spring. Writes `kappa`
    and `reaction` (2,). Result: status, evaluations, share reached, negative directions.
    """
    length, EI, arc, part = shaft.length, shaft.EI, hole.arc, hole.part
    status, evaluations, _ = kernels.load_path(shaft, external, kappa, work)
    free = status == kernels.CONVERGED
    if not free:
        kappa[:] = shaft.kappa0
    kept, kept_reaction = kappa.copy(), np.zeros(2)
    reaction[:] = 0.0
    bending = 0.0
    for i in range(arc + 1):
        bending += length[i] / EI[i]
    scale = bending * (length[:arc].sum() + part) ** 2  # compliance of the held point, roughly
    limit = evaluations + STEP_LIMIT
    share, step, negative = 0.0, 0.25, 0
    while evaluations < limit and step > SMALLEST_STEP:
        goal = min(1.0, share + step)
        load = 1.0 if free else goal
        previous, accepted = 0.0, False
        for count in range(12):
            compliance = scale * (1.0 - goal) / goal
            negative, turning, d_x, d_y = constrained_step(shaft, external, load, hole, compliance, kappa, reaction, work)
            evaluations += 1
            too_far = not turning <= kernels.LARGEST_STEP_rad
            slow = count > 0 and previous > 1e-7 and turning > kernels.CONTRACTION * previous
            if negative != 0 or too_far or slow:
                break
            kappa += work[kernels.STEP]
            reaction[0] += d_x
            reaction[1] += d_y
            previous, accepted = turning, turning < TOLERANCE_rad
            if accepted:
                break
        if accepted and goal == 1.0:
            return kernels.CONVERGED, evaluations, 1.0, negative
        if accepted:
            share = goal
            kept[:], kept_reaction[:] = kappa, reaction
            step *= 1.5
        else:
            kappa[:], reaction[:] = kept, kept_reaction
            step *= 0.5
    return kernels.NOT_CONVERGED, evaluations, share, negative


def solve_through_puncture(
    arcs: Arcs, force_N: ArrayLike, station_m: float, point_m: ArrayLike, drag_N_per_m: ArrayLike | None = None
) -> PuncturedEquilibrium:
    """Static shape with the point at arc length `station_m` held at `point_m`, and the reaction there.

    Arguments: `force_N` (2,) at the tip; `station_m` from the sheath's exit, with at least two arcs from the exit up
    to it; `point_m` (2,) base frame; `drag_N_per_m` (2,) or (n, 2). Result: the equilibrium reached from the free
    shape as the hole stiffens from nothing to rigid. Raises: InputError. Source: (2.19), (2.8) with the
    reaction as Lagrange multiplier.
    """
    force, point = np.asarray(force_N, dtype=float), np.asarray(point_m, dtype=float)
    if force.shape != (2,) or point.shape != (2,) or not np.isfinite([*force, *point]).all():
        raise InputError("force_N, point_m", f"{force_N!r}, {point_m!r}", "two finite numbers each")
    out = arcs.length_m > 0.0
    length, ends = arcs.length_m[out], np.cumsum(arcs.length_m[out])
    if not 0.0 < station_m <= ends[-1] or not math.isfinite(station_m):
        raise InputError("station_m", station_m, f"more than 0, up to {float(ends[-1])}")
    arc = int(np.searchsorted(ends, station_m))
    if arc == 0:
        wanted = f"more than {float(ends[0])}, or more arcs: the first arc alone cannot give way in both directions"
        raise InputError("station_m", station_m, wanted)
    drag = (
        NO_DRAG
        if drag_N_per_m is None
        else np.ascontiguousarray(np.broadcast_to(np.asarray(drag_N_per_m, dtype=float), (out.size, 2))[out])
    )
    part = min(station_m - (ends[arc] - length[arc]), length[arc])
    kappa, reaction, work = np.empty(length.size), np.empty(2), np.empty((kernels.ROWS, length.size))
    shaft = Shaft(length, arcs.EI_N_m2[out], arcs.cubic_stiffening_m2[out], arcs.unloaded_curvature_per_m[out])
    external = Load(float(force[0]), float(force[1]), drag)
    hole = Hole(arc, float(part), point, np.empty(arc + 1), np.empty((kernels.ROWS, arc + 1)))
    status, evaluations, share, negative = constrained_path(shaft, external, hole, kappa, reaction, work)
    x, y, angle = kernels.evaluate(length, kappa, external, share, work)
    every = arcs.unloaded_curvature_per_m.copy()
    every[out] = kappa
    found = Equilibrium(every, np.array([x, y]), angle, Status(status), negative == 0, evaluations, share)
    return PuncturedEquilibrium(found, reaction)
