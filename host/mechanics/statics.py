"""The static shape of a catheter under a tip force: one function over both models, one case or many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics import pcar
from host.mechanics.cosserat import FRAMES, CosseratSolution, CosseratSolutions, solve_cosserat, solve_cosserat_cases
from host.mechanics.rod import checked_catheter, checked_stations, checked_workers, column, number, real
from host.mechanics.threads import in_threads
from protocol.catheter import Catheter
from protocol.errors import InputError, one_of

Array = NDArray[np.float64]

MODELS = ("cosserat", "pcar")
CASES_PER_THREAD = 64  # fewer are solved faster than a thread starts
NOT_FOR_PCAR = "the default: the planar model has the base frame alone, no roll and no start"


class PcarSolution(NamedTuple):
    """A planar shape, or n of them with a first axis of n. Not converged: the shape is NaN.

    Frame: x along the catheter's axis at the sheath's exit, y in the bending plane, angles from x towards y.
    """

    tip_position_m: Array  # (2,)
    tip_angle_rad: Array  # ()
    station_positions_m: Array  # (k, 2)
    station_angles_rad: Array  # (k,)
    arc_curvatures_per_m: Array  # (arcs,) body first
    arc_lengths_m: Array  # (arcs,)
    converged: Any  # bool, or (n,)
    stable: Any  # bool, or (n,): the second variation of the energy is positive
    load_reached: Any  # 1 where converged; else the share of the load at which the branch ends


@overload
def solve(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    force_N: ArrayLike = ...,
    frame: str = ...,
    *,
    model: Literal["cosserat"] = ...,
    stations_m: Sequence[float] | Array = ...,
    roll_rad: float = ...,
    start: CosseratSolution | None = ...,
    workers: int | None = ...,
) -> CosseratSolution | CosseratSolutions: ...
@overload
def solve(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    force_N: ArrayLike = ...,
    frame: str = ...,
    *,
    model: Literal["pcar"],
    stations_m: Sequence[float] | Array = ...,
    workers: int | None = ...,
) -> PcarSolution: ...


def solve(  # noqa: PLR0913 - keyword arguments of a public function, each documented
    catheter: Catheter,
    insertion_m: Any,
    curvature_per_m: Any,
    force_N: Any = None,
    frame: str = "base",
    *,
    model: str = "cosserat",
    stations_m: Sequence[float] | Array = (),
    roll_rad: float = 0.0,
    start: CosseratSolution | None = None,
    workers: int | None = None,
) -> CosseratSolution | CosseratSolutions | PcarSolution:
    """Find the static shape of a catheter under a force at its tip.

    The equilibrium is the one on the branch that starts at the unloaded shape when the force grows in proportion from
    zero. Where that branch folds back before full load, there is no answer: `converged` is False.

    Parameters:
        catheter: as `load_catheter` returns it.
        insertion_m: length of catheter body outside the sheath, m; negative while part of the distal shaft is inside.
            One number, or (n,) for n cases.
        curvature_per_m: unloaded curvature of the distal shaft, 1/m; positive bends towards -e2. One number, or (n,).
        force_N: force on the tip, N: (3,), or (n, 3) for n cases. Planar model: (2,) or (n, 2). Default: no force.
        frame: "base" (force held in the base frame) or "tip" (it turns with the tip).
        model: "cosserat", a rod in space, or "pcar", circular arcs in the bending plane.
        stations_m: arc lengths (k,) back from the tip, m, where the pose is wanted too.
        roll_rad: roll of the handle, rad.
        start: a solution nearby, to begin from and to stay next to (one case only). It is used where it is near enough.
        workers: threads for n cases; default one for each core.

    Returns:
        CosseratSolution for one case: `tip_position_m` (3,), `tip_quaternion_wxyz` (4,), `station_positions_m` (k, 3),
        `station_quaternions_wxyz` (k, 4), `force_tip_N` (3,), `converged`, `stable`, `jacobian_force` (6, 3), ...
        CosseratSolutions for n cases: the same names, a first axis of n.
        PcarSolution for the planar model: `tip_position_m` (2,), `tip_angle_rad`, `converged`, `stable`, ...
        Positions are right to 1e-8 m (cosserat) within the loads of a catheter.

    Raises:
        InputError: a value is not finite, out of its range or of a wrong shape; names the argument.

    Source:
        Thesis, sections 3.1 and 3.2 (rod), (2.8) (arcs), both with the errata.

    Examples:
        >>> solve(load_catheter("livewire"), 0.01, 10.0, [0.0, 0.05, 0.0]).tip_position_m  # doctest: +SKIP
    """
    checked_catheter(catheter)
    one_of("frame", frame, FRAMES)
    one_of("model", model, MODELS)
    if start is not None and not isinstance(start, CosseratSolution):
        raise InputError("start", type(start).__name__, "a solution of this function for one case, or None")
    workers = checked_workers(workers)
    if not isinstance(insertion_m, float):
        insertion_m = real("insertion_m", insertion_m, "a finite length in m, or one for each case")
    if not isinstance(curvature_per_m, float):
        curvature_per_m = real("curvature_per_m", curvature_per_m, "a finite curvature in 1/m, or one for each case")
    if model == "cosserat":
        force = (0.0, 0.0, 0.0) if force_N is None else force_N
        if not (_many(force) or _is_array(insertion_m) or _is_array(curvature_per_m)):
            return solve_cosserat(
                catheter, insertion_m, curvature_per_m, force, frame, 0.0, stations_m, roll_rad=roll_rad, start=start
            )
        if start is not None:
            raise InputError("start", "a solution", "none: n cases each start from their unloaded shape")
        return solve_cosserat_cases(
            catheter, insertion_m, curvature_per_m, force, frame, stations_m, roll_rad=roll_rad, workers=workers
        )
    if frame != "base":
        raise InputError("frame", frame, NOT_FOR_PCAR)
    if number("roll_rad", roll_rad, "a finite angle in rad") != 0.0:
        raise InputError("roll_rad", roll_rad, NOT_FOR_PCAR)
    if start is not None:
        raise InputError("start", "a solution", NOT_FOR_PCAR)
    force = (0.0, 0.0) if force_N is None else force_N
    if not (_many(force) or _is_array(insertion_m) or _is_array(curvature_per_m)):
        return _one_planar(catheter, insertion_m, curvature_per_m, force, checked_stations(stations_m))
    return _many_planar(catheter, insertion_m, curvature_per_m, force, checked_stations(stations_m), workers)


def _is_array(value: float | Array) -> bool:
    return not isinstance(value, float) and value.ndim > 0


def _many(force: Any) -> bool:
    """Whether a force has a row for each of n cases."""
    ndim = getattr(force, "ndim", None)
    if ndim is not None:
        return bool(ndim == 2)
    return isinstance(force, list | tuple) and len(force) > 0 and hasattr(force[0], "__len__")


def _one_planar(catheter: Catheter, insertion_m: float, curvature_per_m: float, force: Any, stations: Array) -> PcarSolution:
    arcs = pcar.arcs_of(catheter, insertion_m, curvature_per_m)
    found = pcar.solve(arcs, force)
    if not found.converged:
        nan = np.full((len(stations), 2), np.nan)
        kappa = np.full(arcs.length_m.size, np.nan)
        position, angle = np.full(2, np.nan), np.float64(np.nan)
        return PcarSolution(
            position, np.asarray(angle), nan, nan[:, 0], kappa, arcs.length_m, False, False, found.load_share
        )
    positions, angles = _planar_stations(arcs, found.curvature_per_m, stations)
    return PcarSolution(
        found.tip_position_m,
        np.asarray(found.tip_angle_rad),
        positions,
        angles,
        found.curvature_per_m,
        arcs.length_m,
        True,
        found.stable,
        1.0,
    )


def _planar_stations(arcs: pcar.Arcs, kappa: Array, stations: Array) -> tuple[Array, Array]:
    """Positions (k, 2) and angles (k,) at arc lengths back from the tip; inside the sheath the catheter is straight."""
    positions, angles = np.zeros((len(stations), 2)), np.zeros(len(stations))
    for i, back in enumerate(stations):
        ahead = arcs.total_length_m - back
        if ahead >= 0.0:
            positions[i], angles[i] = pcar.point_at(arcs, kappa, ahead)
        else:
            positions[i, 0] = ahead
    return positions, angles


def _many_planar(
    catheter: Catheter, insertion_m: Any, curvature_per_m: Any, force_N: Any, stations: Array, workers: int | None
) -> PcarSolution:
    forces = real("force_N", force_N, "finite forces (n, 2) in N")
    if forces.ndim not in (1, 2) or forces.shape[-1] != 2 or not np.isfinite(forces).all():
        raise InputError("force_N", f"shape {forces.shape}", "finite forces (n, 2) in N")
    sizes = [np.size(value) for value in (insertion_m, curvature_per_m) if _is_array(value)]
    count = len(forces) if forces.ndim == 2 else max(sizes)
    if count == 0:
        raise InputError("force_N", "no case", "at least one")
    forces = np.ascontiguousarray(np.broadcast_to(forces, (count, 2)))
    insertion = column("insertion_m", insertion_m, count, "a finite length in m")
    curvature = column("curvature_per_m", curvature_per_m, count, "a finite curvature in 1/m")
    arcs = [pcar.arcs_of(catheter, d, k0) for d, k0 in zip(insertion.tolist(), curvature.tolist(), strict=True)]
    length = np.array([a.length_m for a in arcs])
    kappa0 = np.array([a.unloaded_curvature_per_m for a in arcs])
    kappa, found = np.empty_like(length), np.empty((count, pcar.FOUND))
    EI, cubic = arcs[0].EI_N_m2, arcs[0].cubic_stiffening_m2

    def work(part: slice) -> None:
        pcar.solve_many(length[part], EI, cubic, kappa0[part], forces[part], pcar.NO_DRAG, kappa[part], found[part])

    in_threads(work, count, workers, CASES_PER_THREAD)
    converged = found[:, pcar.STATUS] == pcar.Status.CONVERGED.value
    positions, angles = np.empty((count, len(stations), 2)), np.empty((count, len(stations)))
    if len(stations):
        for i in range(count):
            positions[i], angles[i] = _planar_stations(arcs[i], kappa[i], stations)
    for array in (found[:, : pcar.LOAD_SHARE], kappa, positions, angles):
        array[~converged] = np.nan
    return PcarSolution(
        found[:, : pcar.TIP_ANGLE],
        found[:, pcar.TIP_ANGLE],
        positions,
        angles,
        kappa,
        length,
        converged,
        converged & (found[:, pcar.UNSTABLE] == 0),
        np.where(converged, 1.0, found[:, pcar.LOAD_SHARE]),
    )
