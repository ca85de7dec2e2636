"""Random spatial inputs of the benchmarks, and the answers to hold them against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.mechanics import sections
from host.mechanics.base_force import robust_branch
from host.mechanics.branch import CONVERGED
from host.mechanics.cosserat_kernels import ALL_TANGENTS, ROW, WORK, sweep
from host.mechanics.rotations import conjugate

Array = NDArray[np.float64]

LENGTH_m = 0.070
REFERENCE_BEND = 0.1  # of the reference sweeps: 1e-13 m on these inputs
NO_STATIONS = np.zeros(0)
SENSOR_OFFSETS_m = np.array([0.0, 0.030, 0.050])


class SpatialCase(NamedTuple):
    """One input with its answer: rod record (9,), force in both frames (3,) N, tip pose in the base frame."""

    rod: Array
    force_base_N: Array
    force_tip_N: Array
    tip_position_m: Array
    tip_quaternion_wxyz: Array


def random_rod(rng: np.random.Generator) -> Array:
    """A shaft alone: stiffnesses 1e-4 to 4e-4 N m2, 70 mm, curvature 0 to 45 1/m."""
    compliance = 1.0 / rng.uniform(1e-4, 4e-4, 3)
    return np.concatenate([compliance, compliance, [LENGTH_m, 0.0, rng.uniform(0.0, 45.0)]])


def direction(rng: np.random.Generator) -> Array:
    """A unit vector, all directions alike."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def reference(rod: Array, force: Array) -> SpatialCase | None:
    """The case with its answer from the robust solver at high accuracy; None where the branch folds back."""
    x, out = np.zeros(3), np.zeros((1, ROW))
    status, *_ = robust_branch(rod, force, NO_STATIONS, REFERENCE_BEND, x, out)
    return SpatialCase(rod, force, x, -out[0, :3], conjugate(out[0, 6:10])) if status == CONVERGED else None


def random_cases(count: int, seed: int, largest_number: float | None = None) -> list[SpatialCase]:
    """Inputs with an answer: 0.02 to 0.25 N in the base frame, or load numbers F L2 / EI up to `largest_number`."""
    rng = np.random.default_rng(seed)
    cases: list[SpatialCase] = []
    while len(cases) < count:
        rod = random_rod(rng)
        size = (
            rng.uniform(0.02, 0.25)
            if largest_number is None
            else (rng.uniform(0.0, largest_number) / (rod[:3].max() * LENGTH_m**2))
        )
        case = reference(rod, size * direction(rng))
        if case is not None:
            cases.append(case)
    return cases


def sensed(case: SpatialCase) -> tuple[Array, Array]:
    """Noiseless poses at SENSOR_OFFSETS_m: positions (3, 3), quaternions (3, 4), base frame."""
    rows = np.zeros((4, ROW))
    sweep(case.rod, case.force_tip_N, SENSOR_OFFSETS_m, REFERENCE_BEND, ALL_TANGENTS, rows, np.zeros(WORK))
    positions, quaternions = np.empty((3, 3)), np.empty((3, 4))
    for i in range(3):
        sections.section_pose(rows[-1], rows[i], 0.0, positions[i], quaternions[i])
    return positions, quaternions
