"""Several base-frame loads on the rod at once: tip force, point forces along it, a distributed force; with Jacobians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.mechanics import multiple_shooting as ms
from host.mechanics.base_force import lay_out
from host.mechanics.branch import CONVERGED, FOLD, LARGEST_GUESS_ERROR, Nodes, follow, newton
from host.mechanics.cosserat_kernels import BODY_LENGTH, COARSE, EXACT, SHAFT_LENGTH
from host.mechanics.riccati import correct, linearize
from host.mechanics.rod import checked_force, finite
from host.mechanics.rotations import rotation_matrix
from host.mechanics.sections import rigid_motion
from host.mechanics.segments import cut, lay_loads, turn_loads
from host.mechanics.tip_shooting import UNIQUE_BELOW, load_number
from protocol.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointLoad:
    """A point force on the rod, held in the base frame. `offset_m`: arc length back from the tip; `force_N`: (3,)."""

    offset_m: float
    force_N: ArrayLike


@dataclass(frozen=True)
class LoadedRod:
    """What `solve_loads` found, base frame. Poses and Jacobians are NaN where `status` is not `branch.CONVERGED`."""

    status: int
    load_reached: float
    passes: int
    load_steps: int
    unstable_modes: int
    positions_m: Array  # (k + 1, 3): at the asked arc lengths, then the tip
    quaternions_wxyz: Array  # (k + 1, 4)
    base_force_N: Array  # (3,): all loads together
    base_moment_Nm: Array  # (3,)
    jacobian_force: Array  # (6, 3): tip position and turn by the tip force
    jacobian_actuation: Array  # (6, 3): by insertion (m), roll (rad), curvature (1/m), loads held


@njit(cache=True, error_model="numpy", nogil=True)
def tip_response(phi: Array, nodes: Array, lane: int, R_tip: Array) -> Array:
    """Change (6,) of the tip's position and orientation, base frame, from the nodes' changes (n + 1, 6) and one lane."""
    out = np.zeros(6)
    n = phi.shape[0]
    for i in range(n):
        for r in range(3):
            out[r] += phi[i, 6 + r, lane]
            for c in range(6):
                out[r] += phi[i, 6 + r, c] * nodes[i, c]
    for r in range(3):
        for c in range(3):
            out[3 + r] += R_tip[r, c] * nodes[n, c]
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def jacobians(segments: Array, nodes: Nodes, curvature: Array, bend: float) -> tuple[Array, Array]:
    """Tip position and turn (6, 3) by the tip force, and (6, 3) by insertion, roll, curvature with the loads held.

    More insertion or roll moves the rod as a body and, seen from the rod, turns the loads the other way.
    """
    n, Q, M = segments.shape[0], nodes.Q, nodes.M
    phi, gap, gain = np.empty((n, 9, 8)), np.empty((n, 6)), np.empty((n, 3, 5))
    step, by_load, work = np.empty((n + 1, 6)), np.empty((n + 1, 6)), np.zeros(ms.WORK)
    by_force, by_actuation = np.empty((6, 3)), np.empty((6, 3))
    R_tip, none, no_places, no_forces = rotation_matrix(Q[n]), np.zeros(3), np.zeros(0), np.zeros((0, 3))
    for column in range(5):
        if column < 3:
            unit = np.zeros(3)
            unit[column] = 1.0
            lay_loads(segments, unit, none, no_places, no_forces, ms.DN_START)
        elif column == 3:
            turn_loads(segments, -curvature)
        else:
            turn_loads(segments, np.array([0.0, 0.0, -1.0]))
        linearize(segments, 1.0, Q, M, bend, phi, gap, work)
        for i in range(n):
            for r in range(6):
                gap[i, r] = phi[i, r, 7]
        correct(Q, phi, gap, step, by_load, gain)
        if column < 3:
            by_force[:, column] = tip_response(phi, by_load, 6, R_tip)
        else:
            by_actuation[:, column - 3] = tip_response(phi, by_load, 6, R_tip)
    by_actuation[:, 2] = tip_response(phi, step, 7, R_tip)
    return by_force, by_actuation


def checked_loads(rod: Array, point_loads: Sequence[PointLoad], distributed: ArrayLike) -> tuple[Array, Array, Array]:
    """Arc lengths from the base (k,), forces (k, 3) and distributed load (3,). Raises InputError."""
    total = float(rod[SHAFT_LENGTH] + rod[BODY_LENGTH])
    places, forces = np.zeros(len(point_loads)), np.zeros((len(point_loads), 3))
    for i, load in enumerate(point_loads):
        offset = float(finite(f"point_loads.{i}.offset_m", load.offset_m, (), "an arc length back from the tip in m"))
        if not 0.0 <= offset < total:
            raise InputError(f"point_loads.{i}.offset_m", offset, f"0 or more, less than the exposed length {total:.6g}")
        places[i], forces[i] = total - offset, checked_force(f"point_loads.{i}.force_N", load.force_N, rod)
    weight = finite("distributed_N_per_m", distributed, (3,), "three finite numbers in N/m")
    checked_force("distributed_N_per_m", weight * total, rod)
    return places, forces, weight


def solve_loads(
    rod: Array, tip_force: Array, places: Array, forces: Array, distributed: Array, arc_lengths: Array
) -> LoadedRod:
    """The rod under several loads held in the base frame, on the branch along which all of them grow together.

    Arguments: rod (9,); tip_force (3,) N; places (k,) arc lengths from the base of the point forces (k, 3) N;
    distributed (3,) N/m over the exposed length; arc_lengths (n,) from the base where the pose is wanted.
    """
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    size = np.linalg.norm(tip_force) + np.linalg.norm(forces, axis=1).sum() + np.linalg.norm(distributed) * total
    marks = np.sort(np.concatenate([[0.0, rod[BODY_LENGTH], total], places, arc_lengths]))
    segments = cut(rod, marks, float(size))
    for column in (ms.N_START, ms.DN_START):
        lay_loads(segments, tip_force, distributed, places, forces, column)
    n = len(segments)
    nodes = Nodes(np.empty((n + 1, 4)), np.empty((n + 1, 3)))
    slope, positions = np.empty((n + 1, 6)), np.empty((n + 1, 3))
    first = min(1.0, UNIQUE_BELOW / max(load_number(rod, float(size)), 1e-12))
    status, reached, passes, steps, unstable = follow(segments, nodes, first, COARSE, LARGEST_GUESS_ERROR)
    work = np.zeros(ms.WORK)
    if status == CONVERGED:
        done, _, more, unstable = newton(segments, 1.0, nodes, EXACT, 1e-10, LARGEST_GUESS_ERROR, slope, work)
        passes, status = passes + more, CONVERGED if done else FOLD
    if status != CONVERGED:
        return _unknown(status, reached, passes, steps, unstable, len(arc_lengths))
    lay_out(segments, 1.0, nodes, EXACT, positions, work)
    ends = np.concatenate([[0.0], np.cumsum(segments[:, ms.LENGTH])])
    asked = [int(np.argmin(np.abs(ends - s))) for s in [*arc_lengths, total]]
    curvature = segments[0, ms.C1 : ms.C1 + 3] * nodes.M[0] + np.array([segments[0, ms.K0], 0.0, 0.0])
    carried = segments[0, ms.N_START : ms.N_START + 3].copy()
    by_force, by_actuation = jacobians(segments, nodes, curvature, EXACT)
    by_actuation[:, :2] += rigid_motion(positions[-1], curvature)
    return LoadedRod(
        status,
        1.0,
        passes,
        steps,
        unstable,
        positions[asked],
        nodes.Q[asked],
        carried,
        nodes.M[0].copy(),
        by_force,
        by_actuation,
    )


def _unknown(status: int, reached: float, passes: int, steps: int, unstable: int, stations: int) -> LoadedRod:
    def nan(*shape: int) -> Array:
        return np.full(shape, np.nan)

    return LoadedRod(
        status,
        reached,
        passes,
        steps,
        unstable,
        nan(stations + 1, 3),
        nan(stations + 1, 4),
        nan(3),
        nan(3),
        nan(6, 3),
        nan(6, 3),
    )
