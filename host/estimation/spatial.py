"""Force at the tip from poses along the catheter: the six sensor cases of chapter 5, weighted, with covariance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation.position_curve import every_force, has_chord
from host.estimation.sensor_noise import (
    ORIENTATION_STD_rad,
    PoseSensor,
    POSITION_STD_m,
    SurfacePrior,
    checked_covariance,
    checked_quaternion,
    chi_square_limit,
    residual_covariance,
    whitening,
)
from host.estimation.spatial_kernels import (
    BAD_INPUT,
    CAREFUL,
    COVARIANCE,
    FOUND,
    LARGEST_STD_N,
    RESIDUAL,
    MeasuredPose,
    Scratch,
    Search,
    Sensors,
    estimate,
    new_scratch,
    sample_of,
    unweighted,
)
from host.estimation.spatial_residuals import ROWS_OF_CASE
from host.estimation.spatial_search import best_of, estimate_sample, search
from host.mechanics.rod import finite, number, rod_record
from host.mechanics.rotations import conjugate, quaternion_of_vector, quaternion_product, rotation_matrix
from host.mechanics.tip_shooting import load_number
from protocol.catheter import Catheter
from protocol.errors import InputError

__all__ = ["PoseSensor", "SpatialEstimate", "SurfacePrior", "estimate_cosserat"]

Array = NDArray[np.float64]

LARGEST_FORCE_N = 0.5
GATE = 6.0  # root mean square of the weighted residuals above which no force is said to explain the poses
FAIR_DEVIATIONS, ODD_DEVIATIONS = 4.0, 3.1  # chi square that ends the search for a better force; that draws a warning
TINY = 1e-6  # weighted cost per residual that no noise leaves
SOFT = 25.0  # load number of the largest force above which the search is made denser; of the force found, warned of
WEAK_STD_N = 0.02
ONE_TO_ONE = (2, 4, 6)
MOST_SOLUTIONS = 8
CONTRADICTING_RESIDUAL = 0.2  # dimensionless; the tracker's noise leaves about 0.005
DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
NO_STARTS = np.zeros((0, 3))
START_SHARES = (0.3, 0.1, 0.02, 0.6)  # of the largest force, the most useful first


@dataclass(slots=True, eq=False)
class SpatialEstimate:
    """Force on the tip in the tip frame, its covariance, and whether a force explains the poses."""

    force_N: Array  # (3,) in the tip frame
    covariance_N2: Array  # (3, 3)
    converged: bool
    residual: float  # dimensionless, thesis' cost at the answer: root of |position error / shaft length|^2 + |turn|^2
    iterations: int  # sweeps along the rod
    chi_square: float  # weighted squared residual; its expected value is the degrees of freedom
    degrees_of_freedom: int
    notes: tuple[str, ...] = ()
    others_N: Array | None = None  # (k, 3) every force found that explains the poses, where there may be several
    force_frame: str = "tip"

    @property
    def solutions_N(self) -> Array:
        """Every force (k, 3) found that explains the poses: one in cases 2, 4, 6; none where it did not converge."""
        if self.others_N is not None:
            return self.others_N
        return self.force_N[None, :].copy() if self.converged else np.zeros((0, 3))

    @property
    def weakest_direction(self) -> Array:
        """Unit vector (3,) in the tip frame along which the force is known worst."""
        return np.asarray(self._principal()[1][:, -1])

    @property
    def weakest_std_N(self) -> float:
        """Standard deviation of the force along `weakest_direction`."""
        return float(np.sqrt(self._principal()[0][-1]))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about what to doubt; empty where nothing is."""
        said = list(self.notes)
        if not self.converged:
            said.append(f"no force explains these poses: residual {self.residual:.3g}, weighted cost {self.chi_square:.3g}")
        elif self.chi_square > chi_square_limit(self.degrees_of_freedom, ODD_DEVIATIONS):
            said.append(
                f"larger residual than noise leaves (chi square {self.chi_square:.3g} for {self.degrees_of_freedom} degrees "
                "of freedom): calibration, insertion or curvature is off, or the contact is not at the tip"
            )
        if self.weakest_std_N > WEAK_STD_N:
            arrow = ", ".join(f"{v:+.2f}" for v in self.weakest_direction)
            said.append(
                f"weakly observed: along [{arrow}] of the tip frame the force is only known to +-{self.weakest_std_N:.2g} N"
            )
        return tuple(said)

    @property
    def quieter_than_noise(self) -> bool:
        """Whether the residual is not zero and yet far below what the sensors' noise leaves (chance 0.001)."""
        return bool(quieter_than_noise(self.chi_square, self.degrees_of_freedom))

    def _principal(self) -> tuple[Array, Array]:
        values, directions = np.linalg.eigh(0.5 * (self.covariance_N2 + self.covariance_N2.T))
        return values, directions


def quieter_than_noise(chi_square: ArrayLike, freedom: int) -> NDArray[np.bool_]:
    """Whether residuals are not zero and yet far below what noise leaves: another force may explain the poses exactly.

    chi_square: (n,) or one number; freedom: number of residuals above the three of the force. Chance 0.001 by noise.
    """
    chi_square = np.asarray(chi_square)
    if freedom <= 0:
        return np.zeros(chi_square.shape, bool)
    return (TINY * (freedom + 3) < chi_square) & (chi_square < chi_square_limit(freedom, -ODD_DEVIATIONS))


@lru_cache(maxsize=32)
def start_grid(largest_N: float) -> Array:
    """Forces (104, 3) to start from where the first try fails: 26 directions, four sizes."""
    units = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    return np.vstack([share * largest_N * units for share in START_SHARES])


@lru_cache(maxsize=32)
def dense_grid(largest_N: float) -> Array:
    """Forces (200, 3) between those of `start_grid`: 50 directions on a spiral, four sizes."""
    z = 1.0 - (2.0 * np.arange(50) + 1.0) / 50.0
    turn = np.arange(50) * np.pi * (3.0 - np.sqrt(5.0))
    units = np.column_stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z])
    return np.vstack([share * largest_N * units for share in (0.6, 0.9, 0.3, 0.1)])


def estimate_cosserat(  # noqa: PLR0913 - keyword arguments of a public function, each documented
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    case: int,
    sensors: Sequence[PoseSensor],
    *,
    previous_force_N: ArrayLike | None = None,
    prior: SurfacePrior | None = None,
    roll_rad: float = 0.0,
    largest_force_N: float = LARGEST_FORCE_N,
    thorough: bool = True,
) -> SpatialEstimate:
    """Estimate the tip force, in the tip frame, that explains the poses of one sample best.

    Arguments: insertion_m, curvature_per_m, roll_rad as in `solve_cosserat`; case 1 to 6 (section 5.2): 1 position of
    the first sensor, 2 and its orientation, 3 position of the second relative to the first, 4 and both orientations,
    5 orientation of the second relative to the first, 6 and of the third; sensors, from the tip backwards, as many as
    the case uses (more are left aside); previous_force_N (3,) of the last sample, tip frame: start there and stay on
    its branch; prior: the surface's normal; largest_force_N: no force above it is considered; thorough: look for a
    better force wherever the first one leaves any residual, not only more than noise would (some milliseconds more).
    Result: `converged` False where no force explains the poses; several `solutions_N` where cases 1, 3, 5 leave the
    choice open (then force_N is the smallest of them, in cases 1 and 3 of those that grow from zero with their load,
    unless previous_force_N is given).
    Raises: InputError naming the key. Source: (5.3) to (5.11) with (5.5) corrected, weighted by the sensors' noise.
    """
    rod, count = rod_record(catheter, insertion_m, curvature_per_m), checked_case(case)
    if len(sensors) < count:
        raise InputError("sensors", len(sensors), f"at least {count} for case {case}")
    largest = number("largest_force_N", largest_force_N, "a force in N above 0")
    if largest <= 0.0:
        raise InputError("largest_force_N", largest, "a force in N above 0")
    roll = number("roll_rad", roll_rad, "a finite angle in rad")
    start = np.zeros(FOUND)
    if previous_force_N is not None:
        x = finite("previous_force_N", previous_force_N, (3,), "three finite numbers in N")
        start[:COVARIANCE] = x * min(1.0, largest / max(math.hypot(*x), 1e-300))
    limits = Limits(largest, thorough, case in ONE_TO_ONE, previous_force_N is not None)
    plain = prior is None and all(
        len(sensor) == 3 or (sensor[3] is None and sensor[4] is None) for sensor in sensors[:count]
    )
    if plain and (limits.one_to_one or limits.continued):
        found = _quick(rod, case, sensors, roll, catheter.distal_length_m, limits, start)
        if found is not None and not (limits.one_to_one and found.quieter_than_noise):
            return found
        if found is not None:  # poses as exact as these separate answers that noise would make indistinguishable
            limits = limits._replace(thorough=True)
    sensors = [PoseSensor(*sensor) for sensor in sensors]
    return _careful(sample(rod, case, sensors, prior, roll), catheter.distal_length_m, limits, start[:COVARIANCE])


class Limits(NamedTuple):
    """Limits of the search of one estimate: largest force and tolerances."""

    largest_N: float
    thorough: bool
    one_to_one: bool  # the case has one answer
    continued: bool  # starts from a previous force

    def costs(self, rows: int, freedom: int) -> tuple[float, float]:
        """Weighted cost that ends the search for a better force, and the one above which no force explains the poses."""
        return TINY * rows if self.thorough else chi_square_limit(freedom, FAIR_DEVIATIONS), GATE**2 * rows

    def grid(self) -> Array:
        """Forces (n, 3) to start from where the first try fails."""
        return start_grid(self.largest_N) if self.one_to_one else NO_STARTS

    def notes(self, case: int, cost: float, fair: float, number_reached: float) -> list[str]:
        """Remarks on a search from one start or from the grid; number_reached: load number of the force found."""
        notes = []
        if cost > fair and number_reached > SOFT:
            notes.append("large load number: another force may explain these poses as well")
        if not self.one_to_one:
            notes.append(f"case {case} is not one to one: taken the branch next to the previous force")
        return notes


def checked_case(case: int) -> int:
    """Number of sensors that the case uses. Raises InputError."""
    if type(case) is not int or not 1 <= case <= 6:
        if not isinstance(case, int | np.integer) or isinstance(case, bool) or not 1 <= case <= 6:
            raise InputError("case", str(case), "1 to 6")
    return (1, 1, 2, 2, 2, 3)[case - 1]


def _quick(
    rod: Array, case: int, sensors: Sequence[PoseSensor], roll_rad: float, length_m: float, limits: Limits, found: Array
) -> SpatialEstimate | None:
    """The estimate in one compiled call, for sensors of the usual noise; None where `_careful` has to look at it."""
    count = checked_case(case)
    offsets, poses = np.empty(count), np.empty((count, 7))
    try:
        for i in range(count):
            offset, position, quaternion = sensors[i][:3]
            if len(position) != 3 or len(quaternion) != 4:  # type: ignore[arg-type]
                return None
            offsets[i], poses[i, :3], poses[i, 3:] = offset, position, quaternion
    except (TypeError, ValueError):
        return None
    rows = int(ROWS_OF_CASE[case])
    freedom = max(rows - 3, 0)
    fair, acceptable = limits.costs(rows, freedom)
    W, _, _ = equal_sensors(case, POSITION_STD_m, ORIENTATION_STD_rad)
    known = Sensors(case, offsets, W, length_m)
    bounds = Search(limits.largest_N, limits.grid(), fair, acceptable)
    settled, cost, sweeps = estimate_sample(rod, known, poses, roll_rad, bounds, found)
    if settled == BAD_INPUT or not (settled and cost <= fair):
        return None
    residual = float(found[RESIDUAL])
    if not residual <= CONTRADICTING_RESIDUAL:
        return None
    notes = () if limits.one_to_one else tuple(limits.notes(case, cost, fair, 0.0))
    return SpatialEstimate(
        found[:COVARIANCE],
        found[COVARIANCE:RESIDUAL].reshape(3, 3),
        cost <= acceptable,
        residual,
        sweeps,
        cost,
        freedom,
        notes,
    )


def _careful(problem: MeasuredPose, length_m: float, limits: Limits, x: Array) -> SpatialEstimate:
    """The estimate of any sample: several answers, a surface prior, measured covariances, poses that no force explains."""
    scratch = new_scratch(len(problem.stations))
    case, largest = problem.case, limits.largest_N
    rows = int(ROWS_OF_CASE[case]) + len(problem.prior)
    freedom = max(rows - 3, 0)
    fair, acceptable = limits.costs(rows, freedom)
    solutions: Array | None = None
    if limits.one_to_one or limits.continued:
        settled, cost, sweeps = best_of(problem, largest, limits.grid(), fair, x, scratch)
        soft = load_number(problem.whole_rod, largest) > SOFT
        if limits.one_to_one and limits.thorough and cost > acceptable and soft:
            settled, cost, more = best_of(problem, largest, dense_grid(largest), fair, x, scratch)
            sweeps += more
        notes = limits.notes(case, cost, fair, load_number(problem.whole_rod, float(np.linalg.norm(x))))
    else:
        notes = []
        settled, cost, sweeps, solutions = _all_solutions(problem, largest, acceptable, x, scratch)
        if len(solutions) > 1:
            notes.append(f"case {case} is not one to one: {len(solutions)} forces explain these poses, see solutions_N")
    converged = bool(settled and cost <= acceptable and np.all(np.isfinite(x)))
    residual = unweighted(case, length_m, scratch)
    if converged and cost < 1.0 and not residual <= CONTRADICTING_RESIDUAL:
        converged, solutions = False, None  # a cost that the residual at the answer contradicts: no force explains the poses
    covariance: Array = np.linalg.inv(scratch.information + np.eye(3) / LARGEST_STD_N**2).astype(np.float64)
    return SpatialEstimate(x.copy(), covariance, converged, residual, sweeps, float(cost), freedom, tuple(notes), solutions)


@lru_cache(maxsize=32)
def equal_sensors(case: int, position_std_m: float, orientation_std_rad: float) -> tuple[Array, float, float]:
    """Whitening (m, m) for sensors of equal, isotropic noise, and the costs that are fair and acceptable."""
    for key, value in (("position_std_m", position_std_m), ("orientation_std_rad", orientation_std_rad)):
        if not number(key, value, "a number above 0") > 0.0:
            raise InputError(key, value, "a number above 0")
    count, rows = checked_case(case), int(ROWS_OF_CASE[case])
    unit = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    stds = (position_std_m, orientation_std_rad)
    C = residual_covariance(case, unit, *([std**2 * np.eye(3)] * count for std in stds))
    return whitening(C), chi_square_limit(max(rows - 3, 0), FAIR_DEVIATIONS), GATE**2 * rows


def sample(
    rod: Array, case: int, sensors: Sequence[PoseSensor], prior: SurfacePrior | None, roll_rad: float
) -> MeasuredPose:
    """The checked sample, with the handle's roll taken out. Raises InputError naming the key."""
    count = checked_case(case)
    used = list(sensors)[:count]
    offsets = np.array([number(f"sensors.{i}.offset_m", s.offset_m, "an arc length in m") for i, s in enumerate(used)])
    if np.any(offsets < 0.0) or np.any(np.diff(offsets) <= 0.0):
        raise InputError("sensors.offset_m", offsets.tolist(), "0 or more and growing from the tip backwards")
    q_roll = quaternion_of_vector(np.array([0.0, 0.0, roll_rad]))
    Z = rotation_matrix(q_roll)
    positions, quaternions, position_cov, turn_cov = np.empty((count, 3)), np.empty((count, 4)), [], []
    for i, sensor in enumerate(used):
        key = f"sensors.{i}"
        positions[i] = finite(f"{key}.position_m", sensor.position_m, (3,), "three finite numbers in m") @ Z
        quaternions[i] = quaternion_product(
            conjugate(q_roll), checked_quaternion(f"{key}.quaternion_wxyz", sensor.quaternion_wxyz)
        )
        C = checked_covariance(f"{key}.position_covariance_m2", sensor.position_covariance_m2, POSITION_STD_m)
        position_cov.append(Z.T @ C @ Z)
        turn_cov.append(
            checked_covariance(f"{key}.orientation_covariance_rad2", sensor.orientation_covariance_rad2, ORIENTATION_STD_rad)
        )
    W = whitening(residual_covariance(case, quaternions, position_cov, turn_cov))
    return sample_of(rod, offsets, case, positions, quaternions, W, CAREFUL, _prior_rows(prior, Z))


def _prior_rows(prior: SurfacePrior | None, Z: Array) -> Array:
    if prior is None:
        return np.zeros((0, 3))
    normal = finite("prior.normal", prior.normal, (3,), "three finite numbers") @ Z
    std = float(finite("prior.tangential_std_N", prior.tangential_std_N, (), "a force in N above 0"))
    if std <= 0.0:
        raise InputError("prior.tangential_std_N", std, "a force in N above 0")
    size = float(np.linalg.norm(normal))
    if size < 1e-9:
        raise InputError("prior.normal", normal.tolist(), "a direction, not zero")
    across = np.linalg.svd((normal / size)[None, :])[2][1:]
    return np.ascontiguousarray(across / std)


def _all_solutions(
    problem: MeasuredPose, largest: float, acceptable: float, x: Array, scratch: Scratch
) -> tuple[bool, float, int, Array]:
    """Every force found; x (3,) and the scratch are left at the first, or at the best try.

    Those of a position (cases 1 and 3) that grow from zero load come first, then the smallest. The scattered starts look
    for the answers of case 5, and for the nearest force where no force meets the position.
    """
    found = np.zeros((MOST_SOLUTIONS, 3))
    starts = np.vstack([np.zeros((1, 3)), start_grid(largest)])
    count = sweeps = 0
    if has_chord(problem):
        count, sweeps = every_force(problem, largest, acceptable, found, scratch)
    if count:
        solutions = found[:count].copy()
    else:
        count, sweeps = search(problem, largest, starts, acceptable, found, scratch)
        solutions = found[:count][np.argsort(np.linalg.norm(found[:count], axis=1))]
    if count:
        x[:] = solutions[0]
        settled, cost, more = estimate(problem, largest, x, scratch)
    else:
        settled, cost, more = best_of(problem, largest, starts[1:27], 0.0, x, scratch)
    return settled, cost, sweeps + more, solutions
