"""Many samples: a tracker that starts from the last force, and whole recordings spread over threads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.estimation.sensor_noise import UNIT_TOLERANCE, ORIENTATION_STD_rad, POSITION_STD_m
from host.estimation.spatial import LARGEST_FORCE_N, equal_sensors, start_grid
from host.estimation.spatial_kernels import (
    QUICK,
    MeasuredPose,
    Scratch,
    Search,
    Sensors,
    covariance_of,
    estimate,
    new_scratch,
    sample_of,
    unweighted,
)
from host.estimation.spatial_residuals import SENSORS_OF_CASE
from host.estimation.spatial_search import best_of
from host.mechanics.rod import finite, rod_record, rod_records
from host.mechanics.threads import core_count, in_threads
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

FEW_STARTS = slice(0, 26)  # of the grid: one size of force, so that a bad sample costs a few milliseconds at most
CASES_PER_THREAD = 16  # fewer are done before a thread has started
NO_PRIOR = np.zeros((0, 3))


class BatchEstimate(NamedTuple):
    """Forces of n samples in the tip frame; where `converged` is False no force explains the poses."""

    force_N: Array  # (n, 3)
    covariance_N2: Array  # (n, 3, 3)
    converged: NDArray[np.bool_]  # (n,)
    residual: Array  # (n,) dimensionless, as in `SpatialEstimate`
    chi_square: Array  # (n,)


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_next(
    p: MeasuredPose, limits: Search, length_m: float, known: bool, x: Array, covariance: Array, s: Scratch
) -> tuple[bool, float, float]:
    """One sample, from the last force x (3,) if that is `known`, else from none. Returns (converged, residual, cost).

    Written: x, covariance (3, 3). Where the last force leads nowhere fair, the sample is started again without it.
    """
    settled, cost = False, 0.0
    if known:
        settled, cost, _ = estimate(p, limits.largest_N, x, s)
    if not settled or cost > limits.fair:
        x[:] = 0.0
        settled, cost, _ = best_of(p, limits.largest_N, limits.starts, limits.fair, x, s)
    covariance_of(s, covariance)
    return settled and cost <= limits.acceptable, unweighted(p.case, length_m, s), cost


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_rows(
    rods: Array,
    sensors: Sensors,
    positions: Array,
    quaternions: Array,
    limits: Search,
    ordered: bool,
    out: BatchEstimate,
) -> None:
    """Samples one after the other: rods (n, 9), positions (n, k, 3), quaternions (n, k, 4); `out` is written."""
    s, x = new_scratch(sensors.offsets.shape[0]), np.zeros(3)
    known = False
    for i in range(rods.shape[0]):
        p = sample_of(
            rods[i], sensors.offsets, sensors.case, positions[i], quaternions[i], sensors.whitening, QUICK, NO_PRIOR
        )
        out.converged[i], out.residual[i], out.chi_square[i] = estimate_next(
            p, limits, sensors.length_m, known, x, out.covariance_N2[i], s
        )
        out.force_N[i] = x
        known = ordered and out.converged[i]


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


def estimate_batch(  # noqa: PLR0913 - keyword arguments of a public function, each documented
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
    workers: int | None = None,
    largest_force_N: float = LARGEST_FORCE_N,
) -> BatchEstimate:
    """Estimate the tip forces of a recording, spread over threads.

    Arguments: insertion_m, curvature_per_m (n,) or scalars; case 1 to 6; offsets_m (k,) of the sensors the case uses;
    positions_m (n, k, 3), quaternions_wxyz (n, k, 4) in the base frame of zero roll; isotropic noise per axis;
    ordered: neighbours are neighbours in time, so each starts from the one before (needed for cases 1, 3, 5);
    workers: threads, by default one for each core. Raises: InputError naming the key.
    """
    offsets = _checked_offsets(case, offsets_m)
    n = len(np.asarray(positions_m))
    rods = rod_records(catheter, insertion_m, curvature_per_m, n)
    positions, quaternions = _checked_poses(offsets, positions_m, quaternions_wxyz, n)
    W, fair, acceptable = equal_sensors(case, position_std_m, orientation_std_rad)
    out = BatchEstimate(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n))
    sensors = Sensors(case, offsets, W, catheter.distal_length_m)
    limits = Search(largest_force_N, start_grid(largest_force_N)[FEW_STARTS], fair, acceptable)

    def work(part: slice) -> None:
        rows = BatchEstimate(
            out.force_N[part],
            out.covariance_N2[part],
            out.converged[part],
            out.residual[part],
            out.chi_square[part],
        )
        estimate_rows(rods[part], sensors, positions[part], quaternions[part], limits, ordered, rows)

    if ordered:  # neighbours in time stay together: one part for each thread
        threads = core_count() if workers is None else max(1, workers)
        in_threads(work, n, threads, least=-(-n // threads))
    else:
        in_threads(work, n, workers, CASES_PER_THREAD)
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
        W, fair, acceptable = equal_sensors(case, position_std_m, orientation_std_rad)
        self._sensors = Sensors(case, self.offsets_m, W, catheter.distal_length_m)
        self._limits = Search(largest_force_N, start_grid(largest_force_N)[FEW_STARTS], fair, acceptable)
        self._scratch, self._force, self._known = new_scratch(len(self.offsets_m)), np.zeros(3), False

    def forget(self) -> None:
        """The next sample starts without the last force (after a gap, or a change of catheter)."""
        self._known = False

    def update(
        self, insertion_m: float, curvature_per_m: float, positions_m: ArrayLike, quaternions_wxyz: ArrayLike
    ) -> BatchEstimate:
        """One sample: positions_m (k, 3), quaternions_wxyz (k, 4). A batch of one. Raises: InputError naming the key."""
        rod = rod_record(self.catheter, insertion_m, curvature_per_m)
        positions, quaternions = _checked_poses(
            self.offsets_m, np.asarray(positions_m)[None], np.asarray(quaternions_wxyz)[None], 1
        )
        p = sample_of(rod, self.offsets_m, self.case, positions[0], quaternions[0], self._sensors.whitening, QUICK, NO_PRIOR)
        covariance = np.empty((3, 3))
        converged, residual, cost = estimate_next(
            p, self._limits, self.catheter.distal_length_m, self._known, self._force, covariance, self._scratch
        )
        self._known = converged
        return BatchEstimate(
            self._force[None].copy(), covariance[None], np.array([converged]), np.array([residual]), np.array([cost])
        )
