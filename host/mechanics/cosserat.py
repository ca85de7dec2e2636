"""Kirchhoff rod model of the catheter: its shape under a tip force given in the tip frame or in the base frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics import sections
from host.mechanics.branch import CONVERGED, FOLD
from host.mechanics.cosserat_kernels import BODY_LENGTH, SHAFT_LENGTH
from host.mechanics.equilibrium import (
    BASE_FRAME,
    COUNTS,
    FORCE_BASE,
    FORCE_TIP,
    FOUND,
    LOAD,
    MOMENT,
    POSITION,
    QUATERNION,
    STATUS,
    SWEEPS,
    TIP_FRAME,
    UNSTABLE,
    equilibria,
    equilibrium,
    roll_quaternion,
    roll_vector,
)
from host.mechanics.rod import (
    NO_STATIONS,
    checked_force,
    checked_stations,
    largest_force,
    number,
    real,
    rod_record,
    rod_records,
)
from host.mechanics.rod_loads import LoadedRod, PointLoad, checked_loads, solve_loads
from host.mechanics.rotations import rotation_matrix
from host.mechanics.threads import in_threads
from host.mechanics.tip_shooting import QUICK_BELOW, load_number
from protocol.catheter import Catheter
from protocol.errors import InputError

__all__ = ["CosseratSolution", "CosseratSolutions", "PointLoad", "solve_cosserat", "solve_cosserat_cases"]

Array = NDArray[np.float64]

FRAMES = {"tip": TIP_FRAME, "base": BASE_FRAME}
NO_START = np.zeros(0)
NO_LOAD = (0.0, 0.0, 0.0)
REASONS = {CONVERGED: "converged", FOLD: "the branch from the unloaded shape folds back before full load"}
CASES_PER_THREAD = 16  # fewer are solved faster than a thread starts


@dataclass(slots=True, eq=False)
class CosseratSolution:
    """Shape of the catheter and properties of the equilibrium. Not converged: poses and Jacobians are NaN.

    The Jacobians are computed when they are first read; they cost about as much as the solution.
    """

    tip_position_m: Array  # (3,) base frame
    tip_quaternion_wxyz: Array  # (4,) tip -> base
    station_positions_m: Array  # (n, 3) in the order asked
    station_quaternions_wxyz: Array  # (n, 4)
    force_tip_N: Array  # (3,) the tip force in the tip frame
    force_base_N: Array  # (3,) the same in the base frame
    base_moment_Nm: Array  # (3,) beyond the moment that keeps the pre-curvature
    status: int  # `branch.CONVERGED`, FOLD or ITERATIONS
    load_reached: float  # 1 when converged; else the share of the load at which the branch ends
    iterations: int  # sweeps along the rod
    load_steps: int
    unstable_modes: int  # with the forces held in the base frame
    branch: str  # "only" (force in the tip frame), "unloaded" (grown from no load), "start" (next to `start`), "none"
    _rod: Array
    _roll_rad: float
    _thrust_N: float
    _loaded: LoadedRod | None = None
    _jacobians: tuple[Array, Array] | None = None

    @property
    def converged(self) -> bool:
        """Whether an equilibrium at full load was found."""
        return self.status == CONVERGED

    @property
    def stable(self) -> bool:
        """Whether the second variation of the energy is positive, with the forces held in the base frame."""
        return self.status == CONVERGED and self.unstable_modes == 0

    @property
    def reason(self) -> str:
        """Why it did not converge, in words; "converged" where it did."""
        return REASONS.get(self.status, "iterations ran out")

    @property
    def base_force_N(self) -> Array:
        """Force (3,) carried through the sheath's exit; with the tendon's thrust where the shaft is there."""
        carried = self.force_base_N.copy()
        if self._loaded is not None:
            roll_vector(self._roll_rad, self._loaded.base_force_N, carried)
        if self._rod[BODY_LENGTH] == 0.0:
            carried[2] -= self._thrust_N
        return carried

    @property
    def jacobian_force(self) -> Array:
        """Tip position (m) and turn (rad), base frame, by the tip force in the frame it was given in: (6, 3), 1/N."""
        return self._derivatives()[0]

    @property
    def jacobian_actuation(self) -> Array:
        """The same (6, 3) by insertion (m), roll (rad), curvature (1/m), with the forces held in their frame."""
        return self._derivatives()[1]

    def _derivatives(self) -> tuple[Array, Array]:
        if self._jacobians is None:
            self._jacobians = self._work_out_jacobians()
        return self._jacobians

    def _work_out_jacobians(self) -> tuple[Array, Array]:
        if not self.converged:
            return np.full((6, 3), np.nan), np.full((6, 3), np.nan)
        tip_frame = self.branch == "only"
        if self._loaded is not None:
            by_force, by_actuation = self._loaded.jacobian_force, self._loaded.jacobian_actuation
        else:
            base = sections.exact_rows(self._rod, self.force_tip_N, NO_STATIONS)[-1]
            of = sections.jacobians_tip_frame if tip_frame else sections.jacobians_base_frame
            by_force, by_actuation = of(self._rod, base)
        # Found with the handle at zero roll: turned about e3, and with it a force that is held in the base frame.
        c, s = np.cos(self._roll_rad), np.sin(self._roll_rad)
        Z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turn = np.kron(np.eye(2), Z)
        return turn @ by_force @ (np.eye(3) if tip_frame else Z.T), turn @ by_actuation


class CosseratSolutions(NamedTuple):
    """Shapes of n cases, one row each. Where `converged` is False, the poses are NaN."""

    tip_position_m: Array  # (n, 3) base frame
    tip_quaternion_wxyz: Array  # (n, 4) tip -> base
    station_positions_m: Array  # (n, k, 3)
    station_quaternions_wxyz: Array  # (n, k, 4)
    force_tip_N: Array  # (n, 3)
    force_base_N: Array  # (n, 3)
    base_moment_Nm: Array  # (n, 3)
    converged: NDArray[np.bool_]  # (n,)
    stable: NDArray[np.bool_]  # (n,)
    load_reached: Array  # (n,) 1 when converged
    iterations: NDArray[np.int64]  # (n,)
    unstable_modes: NDArray[np.int64]  # (n,)


def solve_cosserat(  # noqa: PLR0913 - keyword arguments of a public function, each documented
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    force_N: ArrayLike = NO_LOAD,
    force_frame: str = "base",
    tendon_tension_N: float = 0.0,
    stations_m: Sequence[float] | Array = (),
    *,
    roll_rad: float = 0.0,
    point_loads: Sequence[PointLoad] = (),
    distributed_N_per_m: ArrayLike = NO_LOAD,
    start: CosseratSolution | None = None,
) -> CosseratSolution:
    """Find the pose of the tip and of stations along the catheter, to 1e-8 m, under a tip force and perhaps more loads.

    Arguments: insertion_m, body outside the sheath (negative: shaft still inside); curvature_per_m of the unloaded
    shaft, positive towards -e2; force_N (3,) at the tip in `force_frame`, "base" or "tip"; tendon_tension_N, which
    acts through the curvature and the base reaction only; stations_m (n,) arc lengths back from the tip (inside the
    sheath the catheter is straight); roll_rad of the handle; point_loads and distributed_N_per_m (3,), both held in
    the base frame, the latter over the exposed length; start: a solution nearby, to begin from and to stay next to.
    Result: on the branch from the unloaded shape as all loads grow together, unless `start` is given and near enough.
    Raises: InputError naming the key. Source: sections 3.1 to 3.2, (3.10), (3.11), (3.18), (3.19) with the errata.
    """
    rod = rod_record(catheter, insertion_m, curvature_per_m)
    if force_frame not in FRAMES:
        raise InputError("force_frame", force_frame, "base or tip")
    frame = FRAMES[force_frame]
    force = checked_force("force_N", force_N, rod)
    tension = number("tendon_tension_N", tendon_tension_N, "a finite tension in N")
    if tension < 0.0:
        raise InputError("tendon_tension_N", tension, "0 or more: a tendon only pulls")
    stations = checked_stations(stations_m)
    roll = number("roll_rad", roll_rad, "a finite angle in rad")
    if len(point_loads) or distributed_N_per_m is not NO_LOAD:
        places, forces, weight = checked_loads(rod, point_loads, distributed_N_per_m)
        if np.any(forces) or np.any(weight):
            if frame == TIP_FRAME:
                raise InputError("force_frame", "tip", "base, where point_loads or distributed_N_per_m are given")
            return _under_loads(rod, (force, places, forces, weight), stations, roll, tension)
    if frame == BASE_FRAME and load_number(rod, _length(force)) > QUICK_BELOW:
        return _under_loads(rod, (force, NO_STATIONS, np.zeros((0, 3)), np.zeros(3)), stations, roll, tension)
    guess = start.force_tip_N if start is not None and start.converged else NO_START
    found, poses = np.empty(FOUND), np.empty((stations.shape[0], 7))
    status, reached, sweeps, steps, unstable, warm = equilibrium(rod, force, frame, roll, guess, stations, found, poses)
    branch = "none" if status != CONVERGED else "only" if frame == TIP_FRAME else "start" if warm else "unloaded"
    return CosseratSolution(
        found[POSITION:QUATERNION],
        found[QUATERNION:FORCE_TIP],
        poses[:, :3],
        poses[:, 3:],
        found[FORCE_TIP:FORCE_BASE],
        found[FORCE_BASE:MOMENT] if status == CONVERGED else force,
        found[MOMENT:LOAD],
        status,
        reached,
        sweeps,
        steps,
        unstable,
        branch,
        rod,
        roll,
        tension,
    )


def _length(v: Array) -> float:
    x, y, z = v.tolist()
    return float((x * x + y * y + z * z) ** 0.5)


def _under_loads(
    rod: Array, loads: tuple[Array, Array, Array, Array], stations: Array, roll_rad: float, tension_N: float
) -> CosseratSolution:
    """Several loads at once; loads: tip force (3,), places (k,), point forces (k, 3), distributed force (3,)."""
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    force, places, forces, weight = loads
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    Z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    found = solve_loads(rod, force @ Z, places, forces @ Z, weight @ Z, np.maximum(total - stations, 0.0))
    converged = found.status == CONVERGED
    positions = found.positions_m.copy()
    positions[:-1, 2] -= np.maximum(stations - total, 0.0)  # inside the sheath the catheter is straight
    quaternions = found.quaternions_wxyz.copy()
    force_tip = rotation_matrix(quaternions[-1]).T @ (force @ Z)
    for q in quaternions:
        roll_quaternion(roll_rad, q, q)
    positions = positions @ Z.T
    return CosseratSolution(
        positions[-1],
        quaternions[-1],
        positions[:-1],
        quaternions[:-1],
        force_tip,
        force,
        Z @ found.base_moment_Nm,
        found.status,
        found.load_reached,
        found.passes,
        found.load_steps,
        found.unstable_modes,
        "unloaded" if converged else "none",
        rod,
        roll_rad,
        tension_N,
        found,
    )


def solve_cosserat_cases(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    forces_N: ArrayLike,
    force_frame: str = "base",
    stations_m: Sequence[float] | Array = (),
    *,
    roll_rad: float = 0.0,
    workers: int | None = None,
) -> CosseratSolutions:
    """Solve many cases, spread over threads; each from its own unloaded shape.

    Arguments: insertion_m (m) and curvature_per_m (1/m), one number or (n,); forces_N (n, 3) in `force_frame`, or (3,)
    where insertion_m or curvature_per_m is (n,); stations_m (k,) arc lengths back from the tip; roll_rad of the
    handle; workers, threads, by default one for each core.
    Result: `CosseratSolutions`, rows in the order given. Raises: InputError naming the key. Source: `solve_cosserat`.
    """
    forces, count = _checked_forces(forces_N, insertion_m, curvature_per_m)
    rods = rod_records(catheter, insertion_m, curvature_per_m, count)
    if force_frame not in FRAMES:
        raise InputError("force_frame", force_frame, "base or tip")
    sizes = np.linalg.norm(forces, axis=1)
    limits = np.array([largest_force(rod) for rod in rods])
    if (sizes > limits).any():
        worst = int(np.argmax(sizes / limits))
        checked_force(f"force_N.{worst}", forces[worst], rods[worst])
    stations = checked_stations(stations_m)
    roll = number("roll_rad", roll_rad, "a finite angle in rad")
    found, poses = np.empty((count, FOUND)), np.empty((count, len(stations), 7))
    counts = np.empty((count, COUNTS), dtype=np.int64)

    def work(part: slice) -> None:
        equilibria(
            rods[part],
            forces[part],
            FRAMES[force_frame],
            roll,
            stations,
            found[part],
            poses[part],
            counts[part],
        )

    in_threads(work, count, workers, CASES_PER_THREAD)
    converged = counts[:, STATUS] == CONVERGED
    return CosseratSolutions(
        found[:, POSITION:QUATERNION],
        found[:, QUATERNION:FORCE_TIP],
        poses[:, :, :3],
        poses[:, :, 3:],
        found[:, FORCE_TIP:FORCE_BASE],
        found[:, FORCE_BASE:MOMENT],
        found[:, MOMENT:LOAD],
        converged,
        converged & (counts[:, UNSTABLE] == 0),
        found[:, LOAD],
        counts[:, SWEEPS],
        counts[:, UNSTABLE],
    )


def _checked_forces(forces_N: ArrayLike, insertion_m: ArrayLike, curvature_per_m: ArrayLike) -> tuple[Array, int]:
    """Forces (n, 3) and n, from whichever of the three arguments has a row for each case."""
    forces = real("force_N", forces_N, "forces (n, 3) in N")
    if forces.ndim not in (1, 2) or forces.shape[-1] != 3:
        raise InputError("force_N", f"shape {forces.shape}", "forces (n, 3) in N")
    if not np.isfinite(forces).all():
        raise InputError("force_N", "NaN or infinity", "finite forces (n, 3) in N")
    counts = [np.size(value) for value in (insertion_m, curvature_per_m) if np.ndim(value)]
    count = len(forces) if forces.ndim == 2 else max(counts, default=1)
    return np.ascontiguousarray(np.broadcast_to(forces, (count, 3))), count
