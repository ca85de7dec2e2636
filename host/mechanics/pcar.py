"""The planar catheter as tangent circular arcs (chapter 2): shape, statics, Jacobians, for any number of arcs.

Frame: x along the catheter's axis at the sheath's exit, y in the bending plane, angles from x towards y. The kernels
behind this face are in `pcar_kernels`; `solve_many` is the array form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.mechanics import pcar_kernels as kernels
from host.mechanics.rod import finite, number
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]
NO_DRAG: Array = np.zeros((0, 2))
UNLOADED = kernels.Load(0.0, 0.0, NO_DRAG)


class Status(Enum):
    """Result of the solution of the statics."""

    CONVERGED = kernels.CONVERGED
    FOLD = kernels.FOLD  # the branch folds back before full load: no answer
    NOT_CONVERGED = kernels.NOT_CONVERGED  # the limit of evaluations was reached


@dataclass(frozen=True)
class Arcs:
    """The arcs outside the sheath, proximal first, each array (n,). An arc still inside has length zero."""

    length_m: Array
    EI_N_m2: Array
    unloaded_curvature_per_m: Array
    cubic_stiffening_m2: Array
    distal: NDArray[np.bool_]  # arcs of the distal shaft, which the pull-wire bends
    length_by_insertion: Array  # d length / d insertion: not zero only for the parts of the arc at the exit

    @property
    def shaft(self) -> kernels.Shaft:
        """The same as the kernels take it."""
        return kernels.Shaft(self.length_m, self.EI_N_m2, self.cubic_stiffening_m2, self.unloaded_curvature_per_m)

    @property
    def total_length_m(self) -> float:
        """Return the length (m) outside the sheath."""
        return float(self.length_m.sum())


@dataclass(frozen=True)
class Equilibrium:
    """A static shape. An arc without length bears the curvature with which it would leave the sheath."""

    curvature_per_m: Array  # (n,)
    tip_position_m: Array  # (2,)
    tip_angle_rad: float
    status: Status
    stable: bool  # second variation of the energy positive
    iterations: int  # evaluations of the model
    load_share: float  # share of the load that was reached on the branch; 1 where converged

    @property
    def converged(self) -> bool:
        """Whether the shape is the one on the branch from the unloaded shape, at full load."""
        return self.status is Status.CONVERGED


def arcs_of(catheter: Catheter, insertion_m: float, curvature_per_m: float, longest_arc_m: float = math.inf) -> Arcs:
    """The arcs of `catheter` outside the sheath.

    Arguments: `insertion_m`, length of body outside the sheath; negative: that much of the distal shaft is inside.
    `curvature_per_m`, unloaded curvature of the distal shaft. Arcs longer than `longest_arc_m` are cut into equal
    parts, which bends the model towards the continuous rod. Raises: InputError. Source: (2.6), Table 2.1.
    """
    if catheter.pcar is None:
        raise InputError("catheter", catheter.name, "a catheter with a [pcar] table: its planar stiffness is not known")
    insertion_m = number("insertion_m", insertion_m, "a finite length in m")
    curvature_per_m = number("curvature_per_m", curvature_per_m, "a finite curvature in 1/m")
    if not -catheter.distal_length_m < insertion_m:
        raise InputError("insertion_m", insertion_m, f"more than -{catheter.distal_length_m}, the length of the shaft")
    if not longest_arc_m > 0.0:
        raise InputError("longest_arc_m", longest_arc_m, "a positive length in m")
    inside = max(0.0, -insertion_m)
    length: list[float] = []
    origin: list[int] = []
    for index, full in enumerate((max(0.0, insertion_m), *catheter.pcar.distal_arcs_m)):
        outside = full if index == 0 else max(0.0, full - inside)
        inside = inside if index == 0 else max(0.0, inside - full)
        parts = max(1, math.ceil(outside / longest_arc_m - 1e-9))
        length += [outside / parts] * parts
        origin += [index] * parts
    lengths, origins = np.array(length), np.array(origin)
    at_exit = origins == origins[int(np.argmax(lengths > 0.0))]
    cubic = catheter.constitutive.cubic_stiffening_m2 if catheter.constitutive else 0.0
    return Arcs(
        lengths,
        np.array(catheter.pcar.EI_N_m2)[origins],
        np.where(origins > 0, curvature_per_m, 0.0),
        np.full(lengths.size, cubic),
        origins > 0,
        at_exit / at_exit.sum(),
    )


def _force(force_N: ArrayLike) -> Array:
    return finite("force_N", force_N, (2,), "two finite numbers in N")


def _drag(arcs: Arcs, drag_N_per_m: ArrayLike | None) -> Array:
    if drag_N_per_m is None:
        return NO_DRAG
    drag = np.ascontiguousarray(np.broadcast_to(np.asarray(drag_N_per_m, dtype=float), (arcs.length_m.size, 2)))
    if not np.isfinite(drag).all():
        raise InputError("drag_N_per_m", "NaN or infinity", "finite numbers in N/m")
    return drag


def _load(force_N: ArrayLike, arcs: Arcs, drag_N_per_m: ArrayLike | None) -> kernels.Load:
    force = _force(force_N)
    return kernels.Load(float(force[0]), float(force[1]), _drag(arcs, drag_N_per_m))


def solve(arcs: Arcs, force_N: ArrayLike, drag_N_per_m: ArrayLike | None = None) -> Equilibrium:
    """Static shape under a tip force, on the branch that starts at the unloaded shape.

    Arguments: `force_N` (2,) in the base frame; `drag_N_per_m` (2,) or (n, 2), force per length on each arc.
    Both grow together from zero. Result: `Equilibrium`; where the branch folds back, `converged` is False and the
    shape is the last one reached. Raises: InputError. Source: (2.8), with the mean moment of each arc.
    """
    external, shaft = _load(force_N, arcs, drag_N_per_m), arcs.shaft
    work, kappa = np.empty((kernels.ROWS, arcs.length_m.size)), np.empty(arcs.length_m.size)
    status, evaluations, share = kernels.load_path(shaft, external, kappa, work)
    x, y, angle = kernels.evaluate(arcs.length_m, kappa, external, share, work)
    negative = kernels.factorize(shaft, kappa, work)
    return Equilibrium(kappa, np.array([x, y]), angle, Status(status), negative == 0, evaluations, share)


# Layout of a row that `solve_many` writes.
TIP_X, TIP_Y, TIP_ANGLE, LOAD_SHARE, UNSTABLE, STATUS, FOUND = range(7)


@njit(cache=True, nogil=True, error_model="numpy")
def solve_many(
    length: Array, EI: Array, cubic: Array, kappa0: Array, force: Array, drag: Array, kappa: Array, found: Array
) -> None:
    """Array form of `solve`: N cases of n arcs, all arguments plain arrays, nothing is checked.

    Arguments: `length`, `kappa0` (N, n); `EI`, `cubic` (n,); `force` (N, 2); `drag` (n, 2) or (0, 2). Results, written
    in place: `kappa` (N, n); `found` (N, 6): tip x, y (m) and angle (rad), load share, negative pivots, status.
    """
    work = np.empty((kernels.ROWS, length.shape[1]))
    for i in range(length.shape[0]):
        shaft = kernels.Shaft(length[i], EI, cubic, kappa0[i])
        external = kernels.Load(force[i, 0], force[i, 1], drag)
        status, _, share = kernels.load_path(shaft, external, kappa[i], work)
        x, y, angle = kernels.evaluate(length[i], kappa[i], external, share, work)
        found[i, TIP_X], found[i, TIP_Y], found[i, TIP_ANGLE], found[i, LOAD_SHARE] = x, y, angle, share
        found[i, UNSTABLE] = kernels.factorize(shaft, kappa[i], work)
        found[i, STATUS] = status


def shortened(arcs: Arcs, station_m: float) -> Arcs:
    """The arcs up to arc length `station_m` from the sheath's exit; those beyond have length zero. Raises InputError."""
    ends = np.cumsum(arcs.length_m)
    if not 0.0 <= station_m <= ends[-1] * (1.0 + 1e-12):
        raise InputError("station_m", station_m, f"0 to {float(ends[-1])}")
    return replace(arcs, length_m=np.clip(station_m - (ends - arcs.length_m), 0.0, arcs.length_m))


def point_at(arcs: Arcs, curvature_per_m: ArrayLike, station_m: float) -> tuple[Array, float]:
    """Position (2,) (m) and angle (rad) at arc length `station_m` from the sheath's exit, (2.2)-(2.4)."""
    length = shortened(arcs, station_m).length_m
    work = np.empty((kernels.ROWS, length.size))
    x, y, angle = kernels.evaluate(length, np.asarray(curvature_per_m, dtype=float), UNLOADED, 0.0, work)
    return np.array([x, y]), angle


def shape(arcs: Arcs, curvature_per_m: ArrayLike, points: int = 101) -> Array:
    """`points` positions from the sheath's exit to the tip, evenly spaced along the arcs; (points, 2), m."""
    stations = np.linspace(0.0, arcs.total_length_m, points)
    return np.array([point_at(arcs, curvature_per_m, min(s, arcs.total_length_m))[0] for s in stations])


def _evaluated(arcs: Arcs, curvature_per_m: ArrayLike, force: Array, drag: Array) -> tuple[Array, Array]:
    work = np.empty((kernels.ROWS, arcs.length_m.size))
    kappa = np.asarray(curvature_per_m, dtype=float)
    kernels.evaluate(arcs.length_m, kappa, kernels.Load(float(force[0]), float(force[1]), drag), 1.0, work)
    kernels.arms(work)
    return kappa, work


def kinematic_jacobian(arcs: Arcs, curvature_per_m: ArrayLike) -> Array:
    """d(x, y, angle at the tip) / d(curvatures), (3, n), m2 and m. Exact through zero curvature. Source: (2.15)."""
    _, work = _evaluated(arcs, curvature_per_m, np.zeros(2), NO_DRAG)
    return arcs.length_m * np.stack([-work[kernels.ARM_Y], work[kernels.ARM_X], np.ones(arcs.length_m.size)])


def _second_variation_of_work(arcs: Arcs, curvature_per_m: ArrayLike, force: Array, drag: Array) -> Array:
    _, work = _evaluated(arcs, curvature_per_m, force, drag)
    index = np.arange(arcs.length_m.size)
    matrix = work[kernels.COUPLING][np.maximum.outer(index, index)]
    matrix[index, index] = work[kernels.DIAGONAL]
    return np.asarray(matrix * np.outer(arcs.length_m, arcs.length_m))


def static_residual(
    arcs: Arcs, curvature_per_m: ArrayLike, force_N: ArrayLike, drag_N_per_m: ArrayLike | None = None
) -> Array:
    """External less elastic generalized moment of each arc, (n,), N m2: P_i of (2.9)-(2.11), zero in equilibrium."""
    kappa, work = _evaluated(arcs, curvature_per_m, _force(force_N), _drag(arcs, drag_N_per_m))
    delta = kappa - arcs.unloaded_curvature_per_m
    elastic = arcs.EI_N_m2 * delta * (1.0 + arcs.cubic_stiffening_m2 * delta**2)
    return np.asarray(arcs.length_m * (work[kernels.MOMENT] - elastic))


def tangent_stiffness(
    arcs: Arcs, curvature_per_m: ArrayLike, force_N: ArrayLike, drag_N_per_m: ArrayLike | None = None
) -> Array:
    """Second variation of the energy, -dP / d(curvatures), (n, n), N m3: positive definite in a stable equilibrium."""
    force, drag = _force(force_N), _drag(arcs, drag_N_per_m)
    delta = np.asarray(curvature_per_m, dtype=float) - arcs.unloaded_curvature_per_m
    elastic = arcs.EI_N_m2 * (1.0 + 3.0 * arcs.cubic_stiffening_m2 * delta**2) * arcs.length_m
    return np.diag(elastic) - _second_variation_of_work(arcs, curvature_per_m, force, drag)


@dataclass(frozen=True)
class PoseSensitivity:
    """Derivatives of the pose (x, y, angle) of a point of the catheter at an equilibrium."""

    by_force: Array  # (3, 2): m/N, m/N, rad/N
    by_curvature: Array  # (3,): per 1/m of unloaded curvature of the distal shaft
    by_insertion: Array  # (3,): per m of insertion; where the body just begins to come out, that on the way back


def pose_sensitivity(arcs: Arcs, equilibrium: Equilibrium, force_N: ArrayLike, back_m: float = 0.0) -> PoseSensitivity:
    """Exact derivatives of a loaded pose by force and by actuation, for control and for estimation.

    Arguments: `arcs` and `force_N` (2,) of the solved `equilibrium`; `back_m`, arc length back from the tip, where
    the point stays on the catheter as it moves.
    """
    kappa = equilibrium.curvature_per_m
    force = _force(force_N)
    out = arcs.length_m > 0.0
    stiffness = tangent_stiffness(arcs, kappa, force)[np.ix_(out, out)]
    delta = kappa - arcs.unloaded_curvature_per_m
    elastic = arcs.EI_N_m2 * (1.0 + 3.0 * arcs.cubic_stiffening_m2 * delta**2) * arcs.length_m
    part = shortened(arcs, arcs.total_length_m - back_m)
    pose_by_insertion, moment_by_insertion = np.zeros(3), np.zeros(kappa.size)
    for arc in np.flatnonzero(arcs.length_by_insertion):
        share = arcs.length_by_insertion[arc]
        moment_by_insertion += share * by_arc_length(arcs, kappa, force, int(arc))[1]
        pose_by_insertion += share * by_arc_length(part, kappa, force, int(arc))[0]
    right = np.column_stack(
        [kinematic_jacobian(arcs, kappa)[:2].T, np.where(arcs.distal, elastic, 0.0), moment_by_insertion]
    )[out]
    response = kinematic_jacobian(part, kappa)[:, out] @ np.linalg.solve(stiffness, right)
    return PoseSensitivity(response[:, :2], response[:, 2], response[:, 3] + pose_by_insertion)


def by_arc_length(arcs: Arcs, curvature_per_m: ArrayLike, force: Array, arc: int) -> tuple[Array, Array]:
    """Derivatives by the length of one arc, curvatures held: of the tip pose (3,), and of P (n,) of (2.8).

    Arguments: `force` (2,) N at the tip; `arc` the index. An arc that grows moves all beyond it along its end's
    tangent and turns it by the arc's curvature.
    """
    kappa, work = _evaluated(arcs, curvature_per_m, force, NO_DRAG)
    chord = work[kernels.CHORD_X] + 1j * work[kernels.CHORD_Y]
    beyond = np.concatenate([np.cumsum(chord[::-1])[::-1][1:], [0.0]])
    end_angle = np.cumsum(arcs.length_m * kappa)
    tip = np.exp(1j * end_angle[arc]) + 1j * kappa[arc] * beyond[arc]
    mean_arm = work[kernels.ARM_X] + 1j * work[kernels.ARM_Y]
    mean_arm_change = np.where(np.arange(kappa.size) > arc, 1j * kappa[arc] * mean_arm, tip)
    # the mean over the arc itself: d(l phi_1(kappa l))/dl = phi_1 + iu phi_2, turned to the arc's own angle
    lever1 = work[kernels.LEVER1_X, arc] + 1j * work[kernels.LEVER1_Y, arc]
    lever2 = work[kernels.LEVER2_X, arc] + 1j * work[kernels.LEVER2_Y, arc]
    turn = kappa[arc] * arcs.length_m[arc]
    own = 0.5 * np.exp(1j * end_angle[arc])
    if arcs.length_m[arc] > 0.0:
        own = (lever1 + 1j * turn * lever2) / arcs.length_m[arc]
    mean_arm_change[arc] = own + 1j * kappa[arc] * beyond[arc]
    torque = np.conj(force[0] + 1j * force[1])
    moment_change = arcs.length_m * (torque * 1j * mean_arm_change).real
    delta = kappa[arc] - arcs.unloaded_curvature_per_m[arc]
    elastic = arcs.EI_N_m2[arc] * delta * (1.0 + arcs.cubic_stiffening_m2[arc] * delta**2)
    moment_change[arc] += (torque * 1j * mean_arm[arc]).real - elastic
    return np.array([tip.real, tip.imag, kappa[arc]]), moment_change
