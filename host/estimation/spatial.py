"""Force at the tip from poses along the catheter: the six sensor cases of chapter 5, weighted, with covariance."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation.sensor_noise import (
    ORIENTATION_STD_rad,
    PoseSensor,
    POSITION_STD_m,
    checked_covariance,
    checked_quaternion,
    chi_square_limit,
    residual_covariance,
    whitening,
)
from host.estimation.spatial_kernels import CAREFUL, Problem, Scratch, best_of, estimate, new_scratch, search, unweighted
from host.estimation.spatial_residuals import ROWS_OF_CASE, SENSORS_OF_CASE
from host.mechanics.rod import finite, rod_record
from host.mechanics.rotations import conjugate, quaternion_of_vector, quaternion_product, rotation_matrix
from host.mechanics.tip_shooting import load_number
from protocol.catheter import Catheter
from protocol.errors import InputError

__all__ = ["ForceEstimate", "PoseSensor", "SurfacePrior", "estimate_cosserat"]

Array = NDArray[np.float64]

LARGEST_FORCE_N = 0.5
GATE = 6.0  # root mean square of the weighted residuals above which no force is said to explain the poses
FAIR_DEVIATIONS, ODD_DEVIATIONS = 4.0, 3.1  # chi square that ends the search for a better force; that draws a warning
TINY = 1e-6  # weighted cost per residual that no noise leaves
SOFT = 25.0  # load number of the largest force above which the search is made denser; of the force found, warned of
WEAK_STD_N = 0.02
LARGEST_STD_N = 10.0  # what is said of a direction the poses tell nothing about
ONE_TO_ONE = (2, 4, 6)
MOST_SOLUTIONS = 8
CONTRADICTING_RESIDUAL = 0.2  # dimensionless; the tracker's noise leaves about 0.005
DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
START_SHARES = (0.3, 0.1, 0.02, 0.6)  # of the largest force, the most useful first


@dataclass(frozen=True)
class SurfacePrior:
    """The surface touched: force along `normal` (base frame), with a part across it of that standard deviation."""

    normal: ArrayLike
    tangential_std_N: float


@dataclass(frozen=True)
class ForceEstimate:
    """Force on the tip, how sure, and whether to believe it (see `estimate_cosserat`)."""

    force_N: Array  # (3,)
    force_frame: str  # "tip"
    covariance_N2: Array  # (3, 3)
    converged: bool
    residual: float  # dimensionless, thesis' cost at the answer: root of |position error / shaft length|^2 + |turn|^2
    iterations: int  # sweeps along the rod
    chi_square: float  # weighted squared residual; its expected value is the degrees of freedom
    degrees_of_freedom: int
    warnings: tuple[str, ...]
    weakest_direction: Array  # (3,) unit vector in the tip frame
    weakest_std_N: float
    solutions_N: Array  # (k, 3) every force found that explains the poses; one in cases 2, 4, 6
    contact_offset_m: float = 0.0  # where the force acts, back from the tip
    contact_offset_std_m: float = 0.0


def start_grid(largest_N: float) -> Array:
    """Forces (104, 3) to start from where the first try fails: 26 directions, four sizes."""
    units = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    return np.vstack([share * largest_N * units for share in START_SHARES])


def dense_grid(largest_N: float) -> Array:
    """Forces (200, 3) between those of `start_grid`: 50 directions on a spiral, four sizes."""
    z = 1.0 - (2.0 * np.arange(50) + 1.0) / 50.0
    turn = np.arange(50) * np.pi * (3.0 - np.sqrt(5.0))
    units = np.column_stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z])
    return np.vstack([share * largest_N * units for share in (0.6, 0.9, 0.3, 0.1)])


def estimate_cosserat(
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
) -> ForceEstimate:
    """Tip force, in the tip frame, that explains the poses of one sample best.

    Arguments: insertion_m, curvature_per_m, roll_rad as in `solve_cosserat`; case 1 to 6 (section 5.2): 1 position of
    the first sensor, 2 and its orientation, 3 position of the second relative to the first, 4 and both orientations,
    5 orientation of the second relative to the first, 6 and of the third; sensors, from the tip backwards, as many as
    the case uses (more are left aside); previous_force_N (3,) of the last sample, tip frame: start there and stay on
    its branch; prior: the surface's normal; largest_force_N: no force above it is considered; thorough: look for a
    better force wherever the first one leaves any residual, not only more than noise would (some milliseconds more).
    Result: `converged` False where no force explains the poses; several `solutions_N` where cases 1, 3, 5 leave the
    choice open (then force_N is the smallest of them, unless previous_force_N is given).
    Raises: InputError naming the key. Source: (5.3) to (5.11) with (5.5) put right, weighted by the sensors' noise.
    """
    problem, length = sample(catheter, insertion_m, curvature_per_m, case, sensors, prior, roll_rad)
    largest = float(finite("largest_force_N", largest_force_N, (), "a force in N above 0"))
    if largest <= 0.0:
        raise InputError("largest_force_N", largest, "a force in N above 0")
    scratch = new_scratch(len(problem.stations))
    x, notes = np.zeros(3), []
    rows = int(ROWS_OF_CASE[case]) + len(problem.prior)
    freedom = max(rows - 3, 0)
    fair, believable = TINY * rows if thorough else chi_square_limit(freedom, FAIR_DEVIATIONS), GATE**2 * rows
    sweeps, solutions = 0, None
    if previous_force_N is not None:
        x[:] = finite("previous_force_N", previous_force_N, (3,), "three finite numbers in N")
        x *= min(1.0, largest / max(float(np.linalg.norm(x)), 1e-300))
    if case in ONE_TO_ONE or previous_force_N is not None:
        grid = start_grid(largest) if case in ONE_TO_ONE else np.zeros((0, 3))
        settled, cost, sweeps = best_of(problem, largest, grid, fair, x, scratch)
        if case in ONE_TO_ONE and thorough and cost > believable and load_number(problem.whole_rod, largest) > SOFT:
            settled, cost, more = best_of(problem, largest, dense_grid(largest), fair, x, scratch)
            sweeps += more
        if cost > fair and load_number(problem.whole_rod, float(np.linalg.norm(x))) > SOFT:
            notes.append("large load number: another force may explain these poses as well")
        if case not in ONE_TO_ONE:
            notes.append(f"case {case} is not one to one: taken the branch next to the previous force")
    else:
        settled, cost, sweeps, solutions = _all_solutions(problem, largest, believable, x, scratch)
        if len(solutions) > 1:
            notes.append(f"case {case} is not one to one: {len(solutions)} forces explain these poses, see solutions_N")
    converged = bool(settled and cost <= believable and np.all(np.isfinite(x)))
    return _report(problem, scratch, x, cost, freedom, converged, sweeps, length, notes, solutions)


def sample(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    case: int,
    sensors: Sequence[PoseSensor],
    prior: SurfacePrior | None,
    roll_rad: float,
) -> tuple[Problem, float]:
    """The checked `Problem` of one sample, with the handle's roll taken out, and the shaft's length in m."""
    rod = rod_record(catheter, insertion_m, curvature_per_m)
    if isinstance(case, bool) or case not in range(1, 7):
        raise InputError("case", case, "1 to 6")
    count = int(SENSORS_OF_CASE[case])
    if len(sensors) < count:
        raise InputError("sensors", len(sensors), f"at least {count} for case {case}")
    used = list(sensors)[:count]
    offsets = np.array(
        [float(finite(f"sensors.{i}.offset_m", sensor.offset_m, (), "an arc length in m")) for i, sensor in enumerate(used)]
    )
    if np.any(offsets < 0.0) or np.any(np.diff(offsets) <= 0.0):
        raise InputError("sensors.offset_m", offsets.tolist(), "0 or more and growing from the tip backwards")
    roll = float(finite("roll_rad", roll_rad, (), "a finite angle in rad"))
    q_roll = quaternion_of_vector(np.array([0.0, 0.0, roll]))
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
    return pose_problem(rod, offsets, case, positions, quaternions, W, _prior_rows(prior, Z)), catheter.distal_length_m


def pose_problem(
    rod: Array,
    offsets: Array,
    case: int,
    positions: Array,
    quaternions: Array,
    W: Array,
    prior: Array,
    bend: float = CAREFUL,
) -> Problem:
    """`Problem` of checked arrays: stations cut off at the base, the rod behind the last sensor if no more is needed."""
    whole, total = rod, rod[6] + rod[7]
    if case >= 5 and len(prior) == 0:
        rod = rod.copy()
        last = min(offsets[-1], total)
        rod[6], rod[7] = min(rod[6], last), max(0.0, last - rod[6])
    return Problem(
        rod,
        whole,
        np.minimum(offsets, total),
        np.maximum(offsets - total, 0.0),
        case,
        positions,
        quaternions,
        W,
        bend,
        prior,
    )


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
    problem: Problem, largest: float, believable: float, x: Array, scratch: Scratch
) -> tuple[bool, float, int, Array]:
    """Every force found, smallest first; x (3,) and the scratch are left at that one, or at the best try."""
    found = np.zeros((MOST_SOLUTIONS, 3))
    starts = np.vstack([np.zeros((1, 3)), start_grid(largest)])
    count, sweeps = search(problem, largest, starts, believable, found, scratch)
    solutions = found[:count][np.argsort(np.linalg.norm(found[:count], axis=1))]
    if count:
        x[:] = solutions[0]
        settled, cost, more = estimate(problem, largest, x, scratch)
    else:
        settled, cost, more = best_of(problem, largest, starts[1:27], 0.0, x, scratch)
    return settled, cost, sweeps + more, solutions


def _report(
    problem: Problem,
    scratch: Scratch,
    x: Array,
    cost: float,
    freedom: int,
    converged: bool,
    sweeps: int,
    length: float,
    notes: list[str],
    solutions: Array | None,
) -> ForceEstimate:
    information = scratch.information + np.eye(3) / LARGEST_STD_N**2
    covariance: Array = np.linalg.inv(information).astype(np.float64)
    values, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    weakest, direction = float(np.sqrt(values[-1])), directions[:, -1]
    residual = unweighted(problem.case, length, scratch)
    if converged and cost < 1.0 and not residual <= CONTRADICTING_RESIDUAL:
        converged, solutions = False, None  # a cost that the residual at the answer contradicts: no force to believe
    if not converged:
        notes.append(f"no force explains these poses: residual {residual:.3g}, weighted cost {cost:.3g}")
    elif cost > chi_square_limit(freedom, ODD_DEVIATIONS):
        notes.append(
            f"larger residual than noise leaves (chi square {cost:.3g} for {freedom} degrees of freedom): "
            "calibration, insertion or curvature is off, or the contact is not at the tip"
        )
    if weakest > WEAK_STD_N:
        arrow = ", ".join(f"{v:+.2f}" for v in direction)
        notes.append(f"weakly observed: along [{arrow}] of the tip frame the force is only known to +-{weakest:.2g} N")
    kept = solutions if solutions is not None else x[None, :].copy() if converged else np.zeros((0, 3))
    return ForceEstimate(
        x.copy(),
        "tip",
        covariance,
        converged,
        residual,
        sweeps,
        float(cost),
        freedom,
        tuple(notes),
        direction,
        weakest,
        kept,
    )
