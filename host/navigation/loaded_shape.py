"""The catheter for planning where something loads it: bent by a transseptal hole (2.19), or by the contact at the goal.

The hole holds one point of the catheter, x(s_w) = x_p, y(s_w) = y_p in the bending plane; the reaction is the Lagrange
multiplier of `host.mechanics.puncture`. The catheter slides through without friction, so s_w is the length at which the
reaction has no part along it. A contact at the goal bends the rod of chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.pcar import Arcs, arcs_of, point_at
from host.mechanics.puncture import PuncturedEquilibrium, solve_through_puncture
from host.navigation import shape
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

LONGEST_ARC_m = 0.0056  # as in the running estimator
# Nearer to the sheath than this a hole cannot bend the catheter: the first arcs alone do not give way both ways.
SHORTEST_m = 0.012
# The length up to the hole: at most so much longer than the straight way; found by halving until the catheter slides.
LONGER, HALVINGS, SLIDES_N, NEARLY_SLIDES_N = 1.02, 24, 2e-3, 0.02
# Newton's steps towards a tip position: how many, when it is there, of the difference quotient, and the longest.
AIM_STEPS, AIMED_m, AIM_PROBE_m, AIM_LONGEST_m = 25, 2e-5, 1e-4, 0.006


class LoadedLine(NamedTuple):
    """Centre line (n, 3) m from the sheath's exit to the tip, and the size (N) of the force that bends it there."""

    points_m: Array
    force_N: float


def through_hole(
    catheter: Catheter, reach: shape.Reach, joint: Array, hole_m: Array, radius_m: float, points: int
) -> LoadedLine | None:
    """The catheter held by the edge of a hole about `hole_m` (3,), `radius_m` wide; None without equilibrium.

    The hole's part out of the bending plane is left out. The catheter lies on the edge that is next to it unloaded.

    Raises: InputError where the catheter has no [pcar] parameters.
    """
    insertion, roll, curvature = (float(value) for value in joint)
    across, normal = np.array([math.sin(roll), -math.cos(roll), 0.0]), np.array([math.cos(roll), math.sin(roll), 0.0])
    line = shape.centre_line(reach, joint, 200)
    in_plane = hole_m - float(hole_m @ normal) * normal
    nearest = int(np.argmin(np.linalg.norm(line - in_plane, axis=1)))
    to_edge = line[nearest] - in_plane
    in_plane = in_plane + to_edge * min(1.0, radius_m / max(float(np.linalg.norm(to_edge)), 1e-12))
    arcs = arcs_of(catheter, insertion, curvature, LONGEST_ARC_m)
    unloaded_m = (reach.length_m + insertion) * nearest / (len(line) - 1)
    held = _sliding(arcs, np.array([in_plane[2], float(in_plane @ across)]), unloaded_m)
    if held is None:
        return None
    kappa, lengths = held.equilibrium.curvature_per_m, np.linspace(0.0, arcs.total_length_m, points)
    flat = np.array([point_at(arcs, kappa, float(length))[0] for length in lengths])
    out = np.outer(flat[:, 1], across)
    out[:, 2] = flat[:, 0]
    return LoadedLine(out, float(np.linalg.norm(held.reaction_N)))


def _sliding(arcs: Arcs, point_m: Array, unloaded_m: float) -> PuncturedEquilibrium | None:
    """The shape through `point_m` (2,) that slides there without friction; None without equilibrium.

    unloaded_m: the length at which the unloaded catheter comes nearest to the hole.

    Bisection on the arc length s_w up to the hole: where it is too short the hole pulls the catheter on, where it is too
    long it pushes it back. At the answer the reaction along the catheter is zero.
    """
    least = float(np.linalg.norm(point_m))
    low, high = least, min(LONGER * max(least, unloaded_m), arcs.total_length_m)
    if low < SHORTEST_m or high <= low:
        return None
    best: tuple[float, PuncturedEquilibrium] | None = None
    for _ in range(HALVINGS):
        station = 0.5 * (low + high)
        try:
            held = solve_through_puncture(arcs, (0.0, 0.0), station, point_m)
        except InputError:
            return None
        if not held.equilibrium.converged:  # stretched, or buckled
            low, high = (station, high) if station < max(least, unloaded_m) else (low, station)
            continue
        angle = point_at(arcs, held.equilibrium.curvature_per_m, station)[1]
        along = float(held.reaction_N @ (math.cos(angle), math.sin(angle)))
        low, high = (station, high) if along > 0.0 else (low, station)
        if abs(along) < SLIDES_N:
            return held
        if best is None or abs(along) < best[0]:
            best = abs(along), held
    return best[1] if best is not None and best[0] < NEARLY_SLIDES_N else None


def pressed(catheter: Catheter, reach: shape.Reach, joint: Array, contact_force_N: Array, points: int) -> LoadedLine | None:
    """The catheter whose tip presses with `contact_force_N` (3,) on tissue, base frame; None without equilibrium.

    Raises: InputError where the catheter has no [cosserat] parameters, or the force is too great for the model.
    """
    insertion, roll, curvature = (float(value) for value in joint)
    offsets = np.linspace(reach.length_m + insertion, 0.0, points)
    found = solve_cosserat(catheter, insertion, curvature, -contact_force_N, stations_m=offsets, roll_rad=roll)
    if not found.converged:
        return None
    return LoadedLine(np.asarray(found.station_positions_m), float(np.linalg.norm(contact_force_N)))


def aimed(tip: Callable[[Array], Array], joint: Array, goal_m: Array, scale_m: Array) -> Array | None:
    """The joint (3,) near `joint` whose loaded tip, `tip`, is at `goal_m` (3,), by Newton; None where none is found.

    scale_m (3,): motion of the tip, about, per unit of each joint.
    """
    last = joint.copy()
    for _ in range(AIM_STEPS):
        here = tip(last)
        off = goal_m - here
        if not np.isfinite(off).all():
            return None
        if float(np.linalg.norm(off)) < AIMED_m:
            return last
        slope = np.column_stack([(tip(last + step) - here) * AIM_PROBE_m**-1 for step in np.diag(AIM_PROBE_m / scale_m)])
        if not np.isfinite(slope).all():
            return None
        # Near the axis the roll moves nothing: the smallest step that does it.
        way = np.linalg.lstsq(slope, off, rcond=1e-3)[0]
        last = last + way * min(1.0, AIM_LONGEST_m / max(float(np.linalg.norm(way)), 1e-12)) / scale_m
    return None
