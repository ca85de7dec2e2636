"""Benchmarks of force estimation: the six cases compared with scipy, noise with its bound, whole recordings."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares

from host.estimation.sensor_noise import (
    ORIENTATION_STD_rad,
    POSITION_STD_m,
    chi_square_limit,
    residual_covariance,
    whitening,
)
from host.estimation.spatial import FAIR_DEVIATIONS, LARGEST_FORCE_N, start_grid
from host.estimation.spatial_kernels import (
    QUICK,
    MeasuredPose,
    Scratch,
    cost_at,
    estimate,
    keep,
    new_scratch,
    sample_of,
)
from host.estimation.spatial_residuals import ROWS_OF_CASE, SENSORS_OF_CASE
from host.estimation.spatial_search import best_of
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from host.studies.benchmarks.runner import PairedTimes, Report, Row, alternate, row_of
from host.studies.benchmarks.spatial_cases import LENGTH_m, SENSOR_OFFSETS_m, SpatialCase, direction, random_cases, sensed

Array = NDArray[np.float64]

CASES = 60
AWAY = 0.02  # of a warm start
RIGHT_N = 1e-3
NOISY_CASES, NOISY_DRAWS = 30, 40
BATCH = 12000
NO_STARTS, NO_PRIOR = np.zeros((0, 3)), np.zeros((0, 3))


@njit(cache=True, nogil=True)
def _estimates(p: MeasuredPose, start: Array, starts: Array, fair: float, x: Array, s: Scratch, repeats: int) -> None:
    for _ in range(repeats):
        x[:] = start
        best_of(p, LARGEST_FORCE_N, starts, fair, x, s)


def weights(case: int) -> Array:
    """Whitening (m, m) of equal sensors with the tracker's noise."""
    count = int(SENSORS_OF_CASE[case])
    unit = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    stds = (POSITION_STD_m, ORIENTATION_STD_rad)
    return whitening(residual_covariance(case, unit, *([std**2 * np.eye(3)] * count for std in stds)))


def unweighted(case: int) -> Array:
    """What stands for the whitening in the thesis' costs: positions over the shaft's length, vector parts as they are."""
    rows, positions = int(ROWS_OF_CASE[case]), 0 if case >= 5 else 3
    return np.diag([1.0 / LENGTH_m] * positions + [0.5] * (rows - positions))


def problem(case: int, sample: SpatialCase, positions: Array, quaternions: Array, W: Array) -> MeasuredPose:
    """The sample as the kernels take it, from poses of all three sensors."""
    count = int(SENSORS_OF_CASE[case])
    return sample_of(
        sample.rod,
        SENSOR_OFFSETS_m[:count],
        case,
        np.ascontiguousarray(positions[:count]),
        np.ascontiguousarray(quaternions[:count]),
        W,
        QUICK,
        NO_PRIOR,
    )


class EstimateCalls:
    """One sample on our side; `force` is what the last run left."""

    def __init__(self, p: MeasuredPose, start: Array, fair: float) -> None:
        self.p, self.start, self.fair, self.force = p, start, fair, np.zeros(3)
        self.starts, self.scratch = start_grid(LARGEST_FORCE_N), new_scratch(len(p.stations))

    def __call__(self, repeats: int) -> None:
        """Estimate the sample's force `repeats` times in compiled code."""
        _estimates(self.p, self.start, self.starts, self.fair, self.force, self.scratch, repeats)


class EstimatePeer:
    """The same sample for scipy: Levenberg-Marquardt of MINPACK with differences, on our model at our accuracy."""

    def __init__(self, p: MeasuredPose, start: Array) -> None:
        self.p, self.start, self.force, self.scratch = p, start, np.zeros(3), new_scratch(len(p.stations))
        self.rows = int(ROWS_OF_CASE[p.case])

    def _residual(self, x: Array) -> Array:
        cost_at(self.p, x, QUICK, False, self.scratch)
        return self.scratch.z[: self.rows].copy()

    def __call__(self) -> None:
        """Estimate the sample's force once."""
        self.force = least_squares(self._residual, self.start, method="lm", x_scale=0.1, max_nfev=400).x


def _row(case: int, variant: str, cases: list[SpatialCase], starts: list[Array], seed: int) -> Row:
    W, rows = weights(case), int(ROWS_OF_CASE[case])
    fair = chi_square_limit(max(rows - 3, 0), FAIR_DEVIATIONS)
    problems = [problem(case, c, *sensed(c), W) for c in cases]
    ours = [EstimateCalls(p, start, fair) for p, start in zip(problems, starts, strict=True)]
    peers = [EstimatePeer(p, start) for p, start in zip(problems, starts, strict=True)]
    ours[0](1), peers[0]()
    timed: PairedTimes = alternate(ours, peers)
    truth = np.array([c.force_tip_N for c in cases])
    errors = [np.linalg.norm(np.array([side.force for side in sides]) - truth, axis=1) for sides in (ours, peers)]
    right = [e < RIGHT_N for e in errors]
    kept = [e[r] if r.any() else np.array([np.inf]) for e, r in zip(errors, right, strict=True)]
    return row_of(
        f"estimate_case_{case}",
        variant,
        "scipy least_squares, lm, same model",
        timed,
        seed,
        force_error_N=float(np.median(kept[0])),
        force_error_max_N=float(kept[0].max()),
        peer_force_error_N=float(np.median(kept[1])),
        peer_force_error_max_N=float(kept[1].max()),
        right=int(right[0].sum()),
        peer_right=int(right[1].sum()),
    )


def noise_over_bound(case: int, seed: int, W: Array) -> float:
    """Root mean square force error at the tracker's noise over the Cramer-Rao bound, median over inputs.

    Argument: W (m, m), the weights of the cost that is minimized; the bound is that of the true noise.
    """
    rng = np.random.default_rng(seed + 7)
    ratios = []
    for sample in random_cases(NOISY_CASES, seed):
        positions, quaternions = sensed(sample)
        exact = problem(case, sample, positions, quaternions, weights(case))
        s, x = new_scratch(len(exact.stations)), np.zeros(3)
        cost_at(exact, sample.force_tip_N, QUICK, True, s)
        keep(int(ROWS_OF_CASE[case]), s)
        bound = float(np.trace(np.linalg.inv(s.information)))
        square = 0.0
        for _ in range(NOISY_DRAWS):
            noisy = positions + POSITION_STD_m * rng.normal(size=(3, 3))
            turned = np.array(
                [quaternion_product(q, quaternion_of_vector(ORIENTATION_STD_rad * rng.normal(size=3))) for q in quaternions]
            )
            x[:] = sample.force_tip_N
            estimate(problem(case, sample, noisy, turned, W), 2.0 * LARGEST_FORCE_N, x, s)
            square += float(np.sum((x - sample.force_tip_N) ** 2)) / NOISY_DRAWS
        ratios.append(np.sqrt(square / bound))
    return float(np.median(ratios))


def _case(case: int) -> Callable[[int, Report], list[Row]]:
    def run(seed: int, report: Report) -> list[Row]:
        cases = random_cases(CASES, seed)
        rng = np.random.default_rng(seed + 1)
        near = [c.force_tip_N + AWAY * float(np.linalg.norm(c.force_tip_N)) * direction(rng) for c in cases]
        rows = [_row(case, "cold", cases, [np.zeros(3)] * CASES, seed), _row(case, "warm", cases, near, seed)]
        if case in (2, 4, 6):
            report(f"estimate_case_{case}, noise ...")
            ratios = {
                "noise_over_bound": noise_over_bound(case, seed, weights(case)),
                "peer_noise_over_bound": noise_over_bound(case, seed, unweighted(case)),
                "noise_peer": "thesis' unweighted cost",
            }
            rows[0].update(ratios)
        return rows

    run.__doc__ = f"Case {case} of chapter 5, cold and warm."
    return run


case_1, case_2, case_3, case_4, case_5, case_6 = (_case(number) for number in range(1, 7))


def batch(seed: int, _report: Report) -> list[Row]:
    """Case 4 of noisy recorded poses, each on its own: processor time per pose compared with a loop of single calls."""
    from host.estimation.spatial import PoseSensor, estimate_cosserat
    from host.estimation.spatial_batch import estimate_batch
    from host.mechanics.cosserat import solve_cosserat
    from protocol.catheter import load_catheter

    catheter, rng = load_catheter("steerocath_t"), np.random.default_rng(seed)
    poses: list[tuple[float, Array, Array]] = []
    while len(poses) < CASES:
        force, k0 = rng.uniform(0.02, 0.25) * direction(rng), rng.uniform(0.0, 45.0)
        found = solve_cosserat(catheter, 0.01, k0, force, stations_m=[0.0, 0.03])
        if found.converged:
            poses.append(
                (k0, found.station_positions_m + POSITION_STD_m * rng.normal(size=(2, 3)), found.station_quaternions_wxyz)
            )
    turns = BATCH // CASES
    curvature, positions, quaternions = ([pose[i] for pose in poses] * turns for i in range(3))
    args = (np.array(curvature), 4, [0.0, 0.03], np.array(positions), np.array(quaternions))
    workers = min(2, os.cpu_count() or 1)
    estimate_batch(catheter, 0.01, *args, workers=workers)
    timed, poses_per_s = PairedTimes(), 0.0
    for _ in range(3):
        start, wall = time.process_time(), time.perf_counter()
        estimate_batch(catheter, 0.01, *args, workers=workers)
        timed.ours_s.append((time.process_time() - start) / (turns * CASES))
        poses_per_s = max(poses_per_s, turns * CASES / (time.perf_counter() - wall))
        start = time.process_time()
        for k0, p, q in poses:
            estimate_cosserat(
                catheter, 0.01, k0, 4, [PoseSensor(o, p[j], q[j]) for j, o in enumerate((0.0, 0.03))], thorough=False
            )
        timed.peer_s.append((time.process_time() - start) / CASES)
    row = row_of("estimate_batch", "case 4, processor time a pose", "loop of our single call", timed, seed)
    return [row | {"poses_per_s": poses_per_s, "workers": workers}]
