"""Planar force from the tip's pose (chapter 4): one pose, a tracked stream, or a whole recording.

Frame and angles as in `host.mechanics.pcar`; forces are those on the catheter's tip, in the base frame. The estimate
is the maximum-likelihood one, weighted by the sensor's covariance; `two_stage` is the thesis' own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation import planar_kernels as kernels
from host.estimation.sensor_noise import SurfacePrior
from host.mechanics.pcar import Arcs, arcs_of
from host.mechanics.pcar_kernels import ROWS, Shaft
from host.mechanics.rod import column
from host.mechanics.threads import in_threads
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

POSITION_STD_m, ANGLE_STD_rad = 0.29e-3, math.radians(0.2)  # Aurora's precision, per axis
CONVERGED_CHI_SQUARE = 36.0  # six standard deviations of the one direction that no force explains
WEAK_STD_N = 0.02  # beyond this a direction of the force is called weakly observed
CASES_PER_THREAD = 16  # fewer are done before a thread has started
UNSEEN_STD_N = 10.0  # stands for "not observed at all" in a covariance


def tip_covariance(position_std_m: float = POSITION_STD_m, angle_std_rad: float = ANGLE_STD_rad) -> Array:
    """Covariance (3, 3) of a measured planar pose (x, y, angle): m2, rad2."""
    return np.diag([position_std_m**2, position_std_m**2, angle_std_rad**2])


DEFAULT_COVARIANCE = tip_covariance()
DEFAULT_WEIGHT = np.diag(1.0 / np.diag(DEFAULT_COVARIANCE))


@dataclass(frozen=True)
class PlanarEstimate:
    """Force on the tip in the base frame, its covariance, and whether a force explains the pose."""

    force_N: Array  # (2,) base frame
    covariance_N2: Array  # (2, 2)
    converged: bool  # the iteration ended, and a force explains the pose
    residual: float  # dimensionless: sqrt((position error / length outside)^2 + angle error^2)
    chi_square: float  # weighted squared residual; about 1 where model and covariance are right
    iterations: int
    curvature_per_m: Array  # (n,) shape of the answer
    weakest_direction: Array  # (2,) unit vector
    weakest_std_N: float
    warnings: tuple[str, ...]


def _prior_vector(prior: SurfacePrior | None) -> Array:
    if prior is None:
        return np.zeros(5)
    normal = np.asarray(prior.normal, dtype=float)
    size = float(np.hypot(*normal)) if normal.shape == (2,) else 0.0
    if not (math.isfinite(size) and size > 0.0):
        raise InputError("prior.normal", str(prior.normal), "two finite numbers, not both zero")
    if not prior.tangential_std_N > 0.0:
        raise InputError("prior.tangential_std_N", prior.tangential_std_N, "a positive force in N")
    tangent = np.array([-normal[1], normal[0]]) / size
    information = np.outer(tangent, tangent) / prior.tangential_std_N**2
    return np.array([0.0, 0.0, information[0, 0], information[0, 1], information[1, 1]])


def _checked_covariance(covariance: ArrayLike | None) -> tuple[Array, Array]:
    if covariance is None:
        return DEFAULT_COVARIANCE, DEFAULT_WEIGHT
    matrix = np.ascontiguousarray(covariance, dtype=float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
        raise InputError("covariance", str(covariance), "a symmetric 3 x 3 matrix of finite numbers")
    if not np.linalg.eigvalsh(matrix).min() > 0.0:
        raise InputError("covariance", str(covariance), "a positive definite matrix")
    return matrix, np.linalg.inv(matrix)


def _covariance_of(row: Array) -> tuple[Array, Array, float]:
    """Covariance, weakest direction and its standard deviation; unseen directions get `UNSEEN_STD_N`."""
    information = np.array([[row[kernels.INFO_XX], row[kernels.INFO_XY]], [row[kernels.INFO_XY], row[kernels.INFO_YY]]])
    if not np.isfinite(information).all():
        return np.eye(2) * UNSEEN_STD_N**2, np.array([1.0, 0.0]), UNSEEN_STD_N
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / np.maximum(values, UNSEEN_STD_N**-2)
    covariance = (vectors * variances) @ vectors.T
    return 0.5 * (covariance + covariance.T), vectors[:, 0], float(math.sqrt(variances[0]))


def estimate(
    arcs: Arcs,
    pose: ArrayLike,
    covariance: ArrayLike | None = None,
    prior: SurfacePrior | None = None,
    previous: PlanarEstimate | None = None,
    thorough: bool = False,
) -> PlanarEstimate:
    """The force that best explains one tip pose.

    Arguments: `arcs` outside the sheath; `pose` (3,) x (m), y (m), angle (rad); `covariance` (3, 3) of the pose, by
    default that of the tracker's data sheet; `previous`, a warm start (the last estimate of a stream), from which the
    branch is continued; `thorough`: try every start even where the first explains the pose.
    Result: `PlanarEstimate`. Raises: InputError. Source: chapter 4, with covariance and weights added.
    """
    measured = np.ascontiguousarray(pose, dtype=float)
    if measured.shape != (3,) or not np.isfinite(measured).all():
        raise InputError("pose", str(pose), "three finite numbers: x (m), y (m), angle (rad)")
    matrix, weight = _checked_covariance(covariance)
    prior_vector = _prior_vector(prior)
    work, row = np.empty((ROWS, arcs.length_m.size)), np.empty(kernels.COLUMNS)
    pose_measured = kernels.Measurement(measured, matrix, weight, prior_vector)
    if previous is not None and previous.curvature_per_m.size == arcs.length_m.size:
        kappa = previous.curvature_per_m.copy()
        start = (float(previous.force_N[0]), float(previous.force_N[1]))
        kernels.likelihood(arcs.shaft, pose_measured, start, kappa, work, row)
        if row[kernels.ENDED] == 1.0 and row[kernels.CHI_SQUARE] < CONVERGED_CHI_SQUARE:
            return _result(arcs, kappa, row)
    kappa = np.empty(arcs.length_m.size)
    enough = 0.0 if thorough else kernels.SECOND_START_CHI_SQUARE
    kernels.estimate_cold(arcs.shaft, pose_measured, enough, kappa, work, row)
    return _result(arcs, kappa, row)


def _result(arcs: Arcs, kappa: Array, row: Array) -> PlanarEstimate:
    covariance, weakest, weakest_std = _covariance_of(row)
    position = math.hypot(row[kernels.ERROR_X], row[kernels.ERROR_Y]) / arcs.total_length_m
    residual = math.hypot(position, row[kernels.ERROR_ANGLE])
    chi_square = float(row[kernels.CHI_SQUARE])
    ended = bool(row[kernels.ENDED] == 1.0)
    warnings = []
    if weakest_std > WEAK_STD_N:
        warnings.append(
            f"force weakly observed along ({weakest[0]:+.2f}, {weakest[1]:+.2f}): standard deviation {weakest_std:.3g} N"
        )
    if not ended:
        warnings.append(f"no force up to {kernels.FORCE_LIMIT_N:g} N explains the pose")
    elif not chi_square <= CONVERGED_CHI_SQUARE:
        warnings.append(f"no force explains the pose: chi square {chi_square:.3g}, wanted at most {CONVERGED_CHI_SQUARE}")
    return PlanarEstimate(
        row[:2].copy(),
        covariance,
        ended and chi_square <= CONVERGED_CHI_SQUARE,
        residual,
        chi_square,
        int(row[kernels.EVALUATIONS]),
        kappa,
        weakest,
        weakest_std,
        tuple(warnings),
    )


class PlanarTracker:
    """Tracking mode: each estimate starts from the one before, and starts again from none where that one did not
    converge.
    """

    def __init__(
        self,
        catheter: Catheter,
        covariance: ArrayLike | None = None,
        prior: SurfacePrior | None = None,
        longest_arc_m: float = math.inf,
    ) -> None:
        self._catheter, self._covariance, self._prior = catheter, covariance, prior
        self._longest_arc_m = longest_arc_m
        self._previous: PlanarEstimate | None = None

    def update(self, insertion_m: float, curvature_per_m: float, pose: ArrayLike) -> PlanarEstimate:
        """The force at the next sample. Arguments as in `arcs_of` and `estimate`. Raises: InputError."""
        arcs = arcs_of(self._catheter, insertion_m, curvature_per_m, self._longest_arc_m)
        found = estimate(arcs, pose, self._covariance, self._prior, self._previous)
        self._previous = found if found.converged else None
        return found


class RecordingEstimate(NamedTuple):
    """Forces of N samples, arrays by sample."""

    force_N: Array  # (N, 2)
    covariance_N2: Array  # (N, 2, 2)
    converged: NDArray[np.bool_]  # (N,)
    residual: Array  # (N,)


def estimate_recording(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    pose: ArrayLike,
    covariance: ArrayLike | None = None,
    workers: int | None = None,
) -> RecordingEstimate:
    """Independent-batch mode: every sample from its own unloaded shape, in parallel.

    Arguments: `insertion_m`, `curvature_per_m` (N,) or scalar; `pose` (N, 3) x, y, angle; `covariance` (3, 3) of each
    pose; `workers`, threads that share the samples, by default one for each core. A pose with NaN gives a sample that is
    not converged. Raises: InputError.
    """
    measured = np.ascontiguousarray(pose, dtype=float)
    if measured.ndim != 2 or measured.shape[1] != 3:
        raise InputError("pose", f"shape {measured.shape}", "(N, 3)")
    matrix, weight = _checked_covariance(covariance)
    count = measured.shape[0]
    insertion = column("insertion_m", insertion_m, count, "a finite length in m")
    curvature = column("curvature_per_m", curvature_per_m, count, "a finite curvature in 1/m")
    template = arcs_of(catheter, 0.0, 0.0)
    length = _lengths(catheter, insertion)
    unloaded = np.where(template.distal, curvature[:, None], 0.0)
    kappa, rows = np.empty_like(length), np.empty((count, kernels.COLUMNS))

    def run(part: slice) -> None:
        shafts = Shaft(length[part], template.EI_N_m2, template.cubic_stiffening_m2, unloaded[part])
        poses = kernels.Measurement(measured[part], matrix, weight, np.zeros((1, 5)))
        kernels.estimate_many(shafts, poses, kappa[part], rows[part])

    in_threads(run, count, workers, CASES_PER_THREAD)
    return _recording_result(rows, length.sum(axis=1))


def _lengths(catheter: Catheter, insertion_m: Array) -> Array:
    if catheter.pcar is None:
        raise InputError("catheter", catheter.name, "a catheter with a [pcar] table: its planar stiffness is not known")
    if not (insertion_m > -catheter.distal_length_m).all():
        wanted = f"more than -{catheter.distal_length_m}, the length of the shaft"
        raise InputError("insertion_m", float(insertion_m.min()), wanted)
    full = np.array(catheter.pcar.distal_arcs_m)
    before = np.concatenate([[0.0], np.cumsum(full)[:-1]])
    inside = np.maximum(0.0, -insertion_m)[:, None]
    distal = full - np.clip(inside - before, 0.0, full)
    return np.ascontiguousarray(np.column_stack([np.maximum(0.0, insertion_m), distal]))


def _recording_result(rows: Array, length: Array) -> RecordingEstimate:
    xx, xy, yy = rows[:, kernels.INFO_XX], rows[:, kernels.INFO_XY], rows[:, kernels.INFO_YY]
    information = np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)
    information = np.where(np.isfinite(information), information, 0.0)
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / np.maximum(values, UNSEEN_STD_N**-2)
    covariance = np.einsum("nik,nk,njk->nij", vectors, variances, vectors)
    position = np.hypot(rows[:, kernels.ERROR_X], rows[:, kernels.ERROR_Y]) / length
    converged = (rows[:, kernels.ENDED] == 1.0) & (rows[:, kernels.CHI_SQUARE] <= CONVERGED_CHI_SQUARE)
    return RecordingEstimate(rows[:, :2].copy(), covariance, converged, np.hypot(position, rows[:, kernels.ERROR_ANGLE]))


def two_stage(arcs: Arcs, pose: ArrayLike) -> tuple[Array, bool]:
    """The thesis' estimate: curvatures that reach the pose, then the force of least static misfit, (4.3) and (4.4).

    Arguments: `pose` (3,) x (m), y (m), angle (rad). Result: force (2,) N and whether the curvatures converged. With
    noise it differs from the maximum-likelihood estimate; kept for comparison.
    """
    work, kappa = np.empty((ROWS, arcs.length_m.size)), np.empty(arcs.length_m.size)
    measured = np.ascontiguousarray(pose, dtype=float)
    converged, fx, fy = kernels.two_stage(arcs.shaft, measured, tip_covariance(), kappa, work)
    return np.array([fx, fy]), bool(converged)
