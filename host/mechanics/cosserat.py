"""Kirchhoff rod model of the catheter: its shape under a tip force given in the tip frame or in the base frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics import sections
from host.mechanics.base_force import solve_cold, solve_warm
from host.mechanics.branch import CONVERGED, FOLD
from host.mechanics.cosserat_kernels import BODY_LENGTH, EXACT, ROW, SHAFT_LENGTH, WORK
from host.mechanics.rod import checked_force, checked_stations, finite, rod_record
from host.mechanics.rod_loads import PointLoad, checked_loads, solve_loads
from host.mechanics.rotations import quaternion_of_vector, quaternion_product, rotation_matrix
from host.mechanics.stability import unstable_modes
from host.mechanics.tip_shooting import QUICK_BELOW, load_number
from protocol.catheter import Catheter
from protocol.errors import InputError

__all__ = ["CosseratSolution", "PointLoad", "solve_cosserat"]

Array = NDArray[np.float64]

NONE = np.zeros(0)
REASONS = {CONVERGED: "converged", FOLD: "the branch from the unloaded shape folds back before full load"}


@dataclass(frozen=True)
class CosseratSolution:
    """Shape of the catheter and what is known about the equilibrium. Not converged: poses and Jacobians are NaN."""

    converged: bool
    reason: str
    tip_position_m: Array  # (3,) base frame
    tip_quaternion_wxyz: Array  # (4,) tip -> base
    station_positions_m: Array  # (n, 3) in the order asked
    station_quaternions_wxyz: Array  # (n, 4)
    force_tip_N: Array  # (3,) the tip force in the tip frame
    force_base_N: Array  # (3,) the same in the base frame
    iterations: int  # sweeps along the rod
    load_steps: int
    load_reached: float  # 1 when converged; else the share of the load at which the branch ends
    branch: str  # "only" (force in the tip frame), "unloaded" (grown from no load), "start" (next to `start`), "none"
    unstable_modes: int  # with the forces held in the base frame
    base_force_N: Array  # (3,) carried through the sheath's exit; with the tendon's thrust where the shaft is there
    base_moment_Nm: Array  # (3,) beyond the moment that keeps the pre-curvature
    jacobian_force: Array  # (6, 3) tip position and turn (base frame) by the tip force in the frame it was given in
    jacobian_actuation: Array  # (6, 3) the same by insertion (m), roll (rad), curvature (1/m), forces held in that frame

    @property
    def stable(self) -> bool:
        """Whether the second variation of the energy is positive, with the forces held in the base frame."""
        return self.converged and self.unstable_modes == 0


def solve_cosserat(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    force_N: ArrayLike = (0.0, 0.0, 0.0),
    force_frame: str = "base",
    tendon_tension_N: float = 0.0,
    stations_m: Sequence[float] | Array = (),
    *,
    roll_rad: float = 0.0,
    point_loads: Sequence[PointLoad] = (),
    distributed_N_per_m: ArrayLike = (0.0, 0.0, 0.0),
    start: CosseratSolution | None = None,
) -> CosseratSolution:
    """Pose of the tip and of stations along the catheter, to 1e-8 m, under a tip force and perhaps more loads.

    Arguments: insertion_m, body outside the sheath (negative: shaft still inside); curvature_per_m of the unloaded
    shaft, positive towards -e2; force_N (3,) at the tip in `force_frame`, "base" or "tip"; tendon_tension_N, which
    acts through the curvature and the base reaction only; stations_m (n,) arc lengths back from the tip (inside the
    sheath the catheter is straight); roll_rad of the handle; point_loads and distributed_N_per_m (3,), both held in
    the base frame, the latter over the exposed length; start: a solution nearby, to begin from and to stay next to.
    Result: on the branch from the unloaded shape as all loads grow together, unless `start` is given and near enough.
    Raises: InputError naming the key. Source: sections 3.1 to 3.2, (3.10), (3.11), (3.18), (3.19) with the errata.
    """
    rod = rod_record(catheter, insertion_m, curvature_per_m)
    if force_frame not in ("base", "tip"):
        raise InputError("force_frame", force_frame, "base or tip")
    force = checked_force("force_N", force_N, rod)
    tension = float(finite("tendon_tension_N", tendon_tension_N, (), "a finite tension in N"))
    if tension < 0.0:
        raise InputError("tendon_tension_N", tension, "0 or more: a tendon only pulls")
    stations = checked_stations(stations_m)
    q_roll = quaternion_of_vector(np.array([0.0, 0.0, float(finite("roll_rad", roll_rad, (), "a finite angle in rad"))]))
    Z = rotation_matrix(q_roll)
    places, forces, weight = checked_loads(rod, point_loads, distributed_N_per_m)
    if force_frame == "tip":
        if np.any(forces) or np.any(weight):
            raise InputError("force_frame", "tip", "base, where point_loads or distributed_N_per_m are given")
        solution = _under_tip_frame_force(rod, force, stations)
    elif np.any(forces) or np.any(weight) or load_number(rod, float(np.linalg.norm(force))) > QUICK_BELOW:
        solution = _under_loads(rod, force @ Z, places, forces @ Z, weight @ Z, stations)
    else:
        solution = _under_base_frame_force(rod, force @ Z, stations, start)
    thrust = np.array([0.0, 0.0, tension if rod[BODY_LENGTH] == 0.0 else 0.0])
    return _rolled(replace(solution, base_force_N=solution.base_force_N - thrust), q_roll, force_frame == "base")


def _under_tip_frame_force(rod: Array, force: Array, stations: Array) -> CosseratSolution:
    ascending, place, inside = sections.exposed(rod, stations)
    rows = sections.exact_rows(rod, force, ascending)
    unstable = unstable_modes(rod, force, np.zeros(WORK))
    return _from_rows(rod, rows, place, inside, force, unstable, *sections.jacobians_tip_frame(rod, rows[-1]))


def _under_base_frame_force(rod: Array, force: Array, stations: Array, start: CosseratSolution | None) -> CosseratSolution:
    x, out, work = np.zeros(3), np.zeros((1, ROW)), np.zeros(WORK)
    found, sweeps, steps, branch = False, 0, 0, "unloaded"
    if start is not None and start.converged:
        x[:] = start.force_tip_N
        found, sweeps = solve_warm(rod, force, NONE, EXACT, x, out, work)
        branch = "start" if found else branch
    if not found:
        status, reached, more, steps, unstable = solve_cold(rod, force, NONE, EXACT, x, out, work)
        sweeps += more
        if status != CONVERGED:
            return _unknown(status, reached, sweeps, steps, unstable, len(stations), force)
    ascending, place, inside = sections.exposed(rod, stations)
    rows = sections.exact_rows(rod, x, ascending)
    solution = _from_rows(
        rod, rows, place, inside, x, unstable_modes(rod, x, work), *sections.jacobians_base_frame(rod, rows[-1])
    )
    return replace(solution, branch=branch, iterations=sweeps, load_steps=steps, force_base_N=force, base_force_N=force)


def _from_rows(
    rod: Array,
    rows: Array,
    place: NDArray[np.int64],
    inside: Array,
    force_tip: Array,
    unstable: int,
    by_force: Array,
    by_actuation: Array,
) -> CosseratSolution:
    n = len(place)
    positions, quaternions = np.empty((n + 1, 3)), np.empty((n + 1, 4))
    sections.tip_pose(rows[-1], positions[n], quaternions[n])
    for i in range(n):
        sections.section_pose(rows[-1], rows[place[i]], inside[i], positions[i], quaternions[i])
    _, moment = sections.base_curvature(rod, rows[-1])
    force_base = rows[-1, 3:6].copy()
    return CosseratSolution(
        True,
        REASONS[CONVERGED],
        positions[n],
        quaternions[n],
        positions[:n],
        quaternions[:n],
        force_tip.copy(),
        force_base,
        1,
        0,
        1.0,
        "only",
        unstable,
        force_base,
        moment,
        by_force,
        by_actuation,
    )


def _under_loads(rod: Array, force: Array, places: Array, forces: Array, weight: Array, stations: Array) -> CosseratSolution:
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    _, _, inside = sections.exposed(rod, stations)
    found = solve_loads(rod, force, places, forces, weight, np.maximum(total - stations, 0.0))
    if found.status != CONVERGED:
        return _unknown(
            found.status, found.load_reached, found.passes, found.load_steps, found.unstable_modes, len(stations), force
        )
    positions = found.positions_m - np.outer(np.append(inside, 0.0), [0.0, 0.0, 1.0])
    force_tip = rotation_matrix(found.quaternions_wxyz[-1]).T @ force
    return CosseratSolution(
        True,
        REASONS[CONVERGED],
        positions[-1],
        found.quaternions_wxyz[-1],
        positions[:-1],
        found.quaternions_wxyz[:-1],
        force_tip,
        force,
        found.passes,
        found.load_steps,
        1.0,
        "unloaded",
        found.unstable_modes,
        found.base_force_N,
        found.base_moment_Nm,
        found.jacobian_force,
        found.jacobian_actuation,
    )


def _unknown(
    status: int, reached: float, sweeps: int, steps: int, unstable: int, stations: int, force: Array
) -> CosseratSolution:
    def nan(*shape: int) -> Array:
        return np.full(shape, np.nan)

    return CosseratSolution(
        False,
        REASONS.get(status, "iterations ran out"),
        nan(3),
        nan(4),
        nan(stations, 3),
        nan(stations, 4),
        nan(3),
        force,
        sweeps,
        steps,
        reached,
        "none",
        unstable,
        nan(3),
        nan(3),
        nan(6, 3),
        nan(6, 3),
    )


def _rolled(solution: CosseratSolution, q_roll: Array, force_turns_too: bool) -> CosseratSolution:
    """The solution found with the handle at zero roll, turned about e3."""
    Z = rotation_matrix(q_roll)
    turn = np.kron(np.eye(2), Z)
    q_stations = [quaternion_product(q_roll, q) for q in solution.station_quaternions_wxyz]
    return replace(
        solution,
        tip_position_m=Z @ solution.tip_position_m,
        base_force_N=Z @ solution.base_force_N,
        tip_quaternion_wxyz=quaternion_product(q_roll, solution.tip_quaternion_wxyz),
        station_positions_m=solution.station_positions_m @ Z.T,
        station_quaternions_wxyz=np.array(q_stations).reshape(-1, 4),
        force_base_N=Z @ solution.force_base_N,
        base_moment_Nm=Z @ solution.base_moment_Nm,
        jacobian_actuation=turn @ solution.jacobian_actuation,
        jacobian_force=turn @ solution.jacobian_force @ (Z.T if force_turns_too else np.eye(3)),
    )
