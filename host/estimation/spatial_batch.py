"""Many samples: a tracker that starts from the last force, and whole recordings spread over threads."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.estimation.sensor_noise import (
    UNIT_TOLERANCE,
    ORIENTATION_STD_rad,
    POSITION_STD_m,
    chi_square_limit,
    residual_covariance,
    whitening,
)
from host.estimation.spatial import FAIR_DEVIATIONS, GATE, LARGEST_FORCE_N, LARGEST_STD_N, start_grid
from host.estimation.spatial_kernels import QUICK, Problem, Scratch, best_of, estimate, new_scratch, unweighted
from host.estimation.spatial_residuals import ROWS_OF_CASE, SENSORS_OF_CASE
from host.mechanics.rod import finite, rod_record
from host.mechanics.small_matrices import inverse3
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

FEW_STARTS = slice(0, 26)  # of the grid: one size of force, so that a bad sample costs a few milliseconds at most
NO_PRIOR = np.zeros((0, 3))


@dataclass(frozen=True)
class BatchEstimate:
    """Forces of n samples in the tip frame; where `converged` is False no force explains the poses."""

    force_N: Array  # (n, 3)
    covariance_N2: Array  # (n, 3, 3)
    converged: NDArray[np.bool_]  # (n,)
    residual: Array  # (n,) dimensionless, as in `ForceEstimate`
    chi_square: Array  # (n,)


@njit(cache=True, error_model="numpy", nogil=True)
def problem_of(
    rod: Array, offsets: Array, case: int, positions: Array, quaternions: Array, W: Array, prior: Array
) -> Problem:
    """`Problem` of one sample, compiled (see `spatial.pose_problem`)."""
    total = rod[6] + rod[7]
    stations, inside = np.minimum(offsets, total), np.maximum(offsets - total, 0.0)
    cut = rod
    if case >= 5 and prior.shape[0] == 0:
        cut = rod.copy()
        last = stations[stations.shape[0] - 1]
        cut[6] = min(rod[6], last)
        cut[7] = max(0.0, last - rod[6])
    return Problem(cut, rod, stations, inside, case, positions, quaternions, W, QUICK, prior)


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_next(
    p: Problem,
    length_m: float,
    largest_N: float,
    starts: Array,
    fair: float,
    believable: float,
    known: bool,
    x: Array,
    covariance: Array,
    s: Scratch,
) -> tuple[bool, float, float]:
    """One sample, from the last force x (3,) if that is `known`, else from none. Returns (converged, residual, cost).

    Written: x, covariance (3, 3). Where the last force leads nowhere fair, the sample is begun anew.
    """
    settled, cost = False, 0.0
    if known:
        settled, cost, _ = estimate(p, largest_N, x, s)
    if not settled or cost > fair:
        x[:] = 0.0
        settled, cost, _ = best_of(p, largest_N, starts, fair, x, s)
    for i in range(3):
        for j in range(3):
            s.A[i, j] = s.information[i, j] + (1.0 / LARGEST_STD_N**2 if i == j else 0.0)
    inverse3(s.A[:3], covariance)
    return settled and cost <= believable, unweighted(p.case, length_m, s), cost


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_rows(
    rods: Array,
    offsets: Array,
    case: int,
    positions: Array,
    quaternions: Array,
    W: Array,
    length_m: float,
    largest_N: float,
    starts: Array,
    fair: float,
    believable: float,
    ordered: bool,
    force: Array,
    covariance: Array,
    converged: NDArray[np.bool_],
    residual: Array,
    cost: Array,
) -> None:
    """Samples one after the other: rods (n, 9), positions (n, k, 3), quaternions (n, k, 4); results written."""
    s, x = new_scratch(offsets.shape[0]), np.zeros(3)
    known = False
    for i in range(rods.shape[0]):
        p = problem_of(rods[i], offsets, case, positions[i], quaternions[i], W, NO_PRIOR)
        converged[i], residual[i], cost[i] = estimate_next(
            p, length_m, largest_N, starts, fair, believable, known, x, covariance[i], s
        )
        force[i] = x
        known = ordered and converged[i]


def _weights(case: int, position_std_m: float, orientation_std_rad: float) -> tuple[Array, float, float]:
    """Whitening for equal, isotropic sensors, and the costs that are fair and believable."""
    for key, value in (("position_std_m", position_std_m), ("orientation_std_rad", orientation_std_rad)):
        if not float(finite(key, value, (), "a number above 0")) > 0.0:
            raise InputError(key, value, "a number above 0")
    count, rows = int(SENSORS_OF_CASE[case]), int(ROWS_OF_CASE[case])
    unit = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    stds = (position_std_m, orientation_std_rad)
    C = residual_covariance(case, unit, *([std**2 * np.eye(3)] * count for std in stds))
    return whitening(C), chi_square_limit(max(rows - 3, 0), FAIR_DEVIATIONS), GATE**2 * rows


def _checked_offsets(case: int, offsets_m: ArrayLike) -> Array:
    if isinstance(case, bool) or case not in range(1, 7):
        raise InputError("case", case, "1 to 6")
    count = int(SENSORS_OF_CASE[case])
    offsets = finite("offsets_m", offsets_m, (count,), f"{count} arc lengths in m for case {case}")
    if np.any(offsets < 0.0) or np.any(np.diff(offsets) <= 0.0):
        raise InputError("offsets_m", offsets.tolist(), "0 or more and growing from the tip backwards")
    return offsets


def _checked_poses(offsets: Array, positions_m: ArrayLike, quaternions_wxyz: ArrayLike, n: int) -> tuple[Array, Array]:
    positions = finite("positions_m", positions_m, (n, len(offsets), 3), "finite positions (samples, sensors, 3) in m")
    q = finite("quaternions_wxyz", quaternions_wxyz, (n, len(offsets), 4), "finite quaternions (samples, sensors, 4)")
    norms = np.linalg.norm(q, axis=2)
    if n and np.abs(norms - 1.0).max() > UNIT_TOLERANCE:
        worst = float(norms.flat[np.abs(norms - 1.0).argmax()])
        raise InputError("quaternions_wxyz", worst, "quaternions of unit length")
    return positions, q / norms[:, :, None]


def estimate_batch(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    case: int,
    offsets_m: ArrayLike,
    positions_m: ArrayLike,
    quaternions_wxyz: ArrayLike,
    *,
    position_std_m: float = POSITION_STD_m,
    orientation_std_rad: float = ORIENTATION_STD_rad,
    ordered: bool = False,
    workers: int = 2,
    largest_force_N: float = LARGEST_FORCE_N,
) -> BatchEstimate:
    """Tip forces of a recording, spread over threads.

    Arguments: insertion_m, curvature_per_m (n,) or scalars; case 1 to 6; offsets_m (k,) of the sensors the case uses;
    positions_m (n, k, 3), quaternions_wxyz (n, k, 4) in the base frame of zero roll; isotropic noise per axis;
    ordered: neighbours are neighbours in time, so each starts from the one before (needed for cases 1, 3, 5);
    workers: threads. Raises: InputError naming the key.
    """
    offsets = _checked_offsets(case, offsets_m)
    n = len(np.asarray(positions_m))
    d, k0 = np.broadcast_to(insertion_m, n), np.broadcast_to(curvature_per_m, n)
    actuation, which = np.unique(np.column_stack([d, k0]), axis=0, return_inverse=True)
    rods = np.array([rod_record(catheter, *row) for row in actuation]).reshape(-1, 9)[which.ravel()]
    positions, quaternions = _checked_poses(offsets, positions_m, quaternions_wxyz, n)
    W, fair, believable = _weights(case, position_std_m, orientation_std_rad)
    out = BatchEstimate(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n))
    starts = start_grid(largest_force_N)[FEW_STARTS]

    def work(part: slice) -> None:
        estimate_rows(
            rods[part],
            offsets,
            case,
            positions[part],
            quaternions[part],
            W,
            catheter.distal_length_m,
            largest_force_N,
            starts,
            fair,
            believable,
            ordered,
            out.force_N[part],
            out.covariance_N2[part],
            out.converged[part],
            out.residual[part],
            out.chi_square[part],
        )

    edges = np.linspace(0, n, max(1, workers) + 1).astype(int)
    with ThreadPoolExecutor(max(1, workers)) as pool:
        list(pool.map(work, [slice(a, b) for a, b in itertools.pairwise(edges)]))
    return out


class ForceTracker:
    """Sample after sample from one set of sensors, each begun from the force before. One thread only."""

    def __init__(
        self,
        catheter: Catheter,
        case: int,
        offsets_m: ArrayLike,
        *,
        position_std_m: float = POSITION_STD_m,
        orientation_std_rad: float = ORIENTATION_STD_rad,
        largest_force_N: float = LARGEST_FORCE_N,
    ) -> None:
        """Arguments as in `estimate_batch`. Raises: InputError naming the key."""
        self.catheter, self.case, self.offsets_m = catheter, case, _checked_offsets(case, offsets_m)
        self._W, self._fair, self._believable = _weights(case, position_std_m, orientation_std_rad)
        self._largest, self._starts = largest_force_N, start_grid(largest_force_N)[FEW_STARTS]
        self._scratch, self._force, self._known = new_scratch(len(self.offsets_m)), np.zeros(3), False

    def forget(self) -> None:
        """The next sample starts anew (after a gap, or a change of catheter)."""
        self._known = False

    def update(
        self, insertion_m: float, curvature_per_m: float, positions_m: ArrayLike, quaternions_wxyz: ArrayLike
    ) -> BatchEstimate:
        """One sample: positions_m (k, 3), quaternions_wxyz (k, 4). A batch of one. Raises: InputError naming the key."""
        rod = rod_record(self.catheter, insertion_m, curvature_per_m)
        positions, quaternions = _checked_poses(
            self.offsets_m, np.asarray(positions_m)[None], np.asarray(quaternions_wxyz)[None], 1
        )
        p = problem_of(rod, self.offsets_m, self.case, positions[0], quaternions[0], self._W, NO_PRIOR)
        covariance = np.empty((3, 3))
        converged, residual, cost = estimate_next(
            p,
            self.catheter.distal_length_m,
            self._largest,
            self._starts,
            self._fair,
            self._believable,
            self._known,
            self._force,
            covariance,
            self._scratch,
        )
        self._known = converged
        return BatchEstimate(
            self._force[None].copy(), covariance[None], np.array([converged]), np.array([residual]), np.array([cost])
        )
