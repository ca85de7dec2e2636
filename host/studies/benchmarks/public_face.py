"""Calls of `seldinger.solve` and `seldinger.estimate_force` from Python, compared with one call of the same kernels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from host.estimation import estimate_force
from host.estimation.sensor_noise import ORIENTATION_STD_rad, POSITION_STD_m, chi_square_limit
from host.estimation.spatial import FAIR_DEVIATIONS
from host.estimation.spatial_residuals import ROWS_OF_CASE, SENSORS_OF_CASE
from host.mechanics import solve
from host.mechanics.cosserat import rod_record
from host.mechanics.cosserat_kernels import BODY_LENGTH, SHAFT_LENGTH
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from host.studies.benchmarks.estimation import EstimateCalls, problem, weights
from host.studies.benchmarks.runner import Report, Row, alternate, row_of
from host.studies.benchmarks.spatial_cases import SENSOR_OFFSETS_m, SpatialCase, direction, reference, sensed
from host.studies.benchmarks.statics import cold_side
from protocol.catheter import Catheter, load_catheter, shipped_catheters

Array = NDArray[np.float64]

CASES_PER_CATHETER = 15
LARGEST_LOAD_NUMBER = 14.0  # F L^2 / EI: 0.25 N on the stiffest catheter of the package, 0.04 N on the softest
INSERTION_m = 0.01
CASE = 4  # both poses of two sensors, as the rig has them


class FaceCase:
    """One catheter under one tip force, with the poses that a tracker would report of it."""

    def __init__(self, catheter: Catheter, curvature_per_m: float, truth: SpatialCase, rng: np.random.Generator) -> None:
        self.catheter, self.curvature_per_m, self.truth = catheter, curvature_per_m, truth
        positions, quaternions = sensed(truth)
        self.positions = positions + POSITION_STD_m * rng.normal(size=positions.shape)
        turns = [quaternion_of_vector(ORIENTATION_STD_rad * rng.normal(size=3)) for _ in quaternions]
        self.quaternions = np.array([quaternion_product(q, turn) for q, turn in zip(quaternions, turns, strict=True)])
        used = int(SENSORS_OF_CASE[CASE])
        self.sensors = list(
            zip(SENSOR_OFFSETS_m[:used].tolist(), self.positions[:used], self.quaternions[:used], strict=True)
        )


def face_cases(seed: int) -> list[FaceCase]:
    """Random curvatures and forces on each catheter with spatial stiffnesses, load numbers to LARGEST_LOAD_NUMBER."""
    rng = np.random.default_rng(seed)
    cases: list[FaceCase] = []
    for name in shipped_catheters():
        catheter = load_catheter(name)
        if catheter.cosserat is None:
            continue
        kept = len(cases) + CASES_PER_CATHETER
        while len(cases) < kept:
            curvature = float(rng.uniform(0.0, 45.0))
            rod = rod_record(catheter, INSERTION_m, curvature)
            length = float(rod[SHAFT_LENGTH] + rod[BODY_LENGTH])
            size = rng.uniform(0.0, LARGEST_LOAD_NUMBER) / (rod[:3].max() * length**2)
            truth = reference(rod, size * direction(rng))
            if truth is not None:
                cases.append(FaceCase(catheter, curvature, truth, rng))
    return cases


def repeated(call: Callable[[], object]) -> Callable[[int], object]:
    """Return a function that calls `call` a given number of times."""

    def run(repeats: int) -> object:
        for _ in range(repeats):
            call()
        return None

    return run


def public_solve(seed: int, _report: Report) -> list[Row]:
    """`seldinger.solve` with a force in the base frame, compared with the rod's kernel on the same rods."""
    cases = face_cases(seed)
    ours = [
        repeated(lambda c=case: solve(c.catheter, INSERTION_m, c.curvature_per_m, c.truth.force_base_N))  # type: ignore[misc]
        for case in cases
    ]
    kernels = [cold_side(case.truth) for case in cases]
    ours[0](1)
    timed = alternate(ours, [lambda k=kernel: k(1) for kernel in kernels])  # type: ignore[misc]
    return [row_of("public_solve", f"load numbers to {LARGEST_LOAD_NUMBER:g}", "the kernel, called once", timed, seed)]


def public_estimate(seed: int, _report: Report) -> list[Row]:
    """`seldinger.estimate_force`, case 4, with the tracker's noise, compared with the estimator's kernel."""
    cases = face_cases(seed)
    fair = chi_square_limit(int(ROWS_OF_CASE[CASE]) - 3, FAIR_DEVIATIONS)
    rows = []
    for variant, near in (("cold", False), ("warm", True)):
        starts = [case.truth.force_tip_N if near else np.zeros(3) for case in cases]
        ours = [repeated(_estimate(case, start if near else None)) for case, start in zip(cases, starts, strict=True)]
        kernels = [
            EstimateCalls(problem(CASE, case.truth, case.positions, case.quaternions, weights(CASE)), start, fair)
            for case, start in zip(cases, starts, strict=True)
        ]
        ours[0](1), kernels[0](1)
        timed = alternate(ours, [lambda k=kernel: k(1) for kernel in kernels])  # type: ignore[misc]
        rows.append(row_of("public_estimate", f"case {CASE}, {variant}", "the kernel, called once", timed, seed))
    return rows


def _estimate(case: FaceCase, previous: Array | None) -> Callable[[], object]:
    return lambda: estimate_force(
        case.catheter, INSERTION_m, case.curvature_per_m, case.sensors, CASE, previous_force_N=previous
    )
