"""Tip and body contact at once: both forces and the place from three poses; what two poses leave open is said."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from host.estimation.sensor_noise import PoseSensor
from host.estimation.several_contacts import ALONG_SHAFT_SD_N, ActuationPrior, estimate_contacts
from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from host.mechanics.rod_loads import PointLoad
from host.mechanics.rotations import quaternion_of_vector, quaternion_product, rotation_matrix
from protocol.catheter import load_catheter
from protocol.errors import InputError

STEEROCATH = load_catheter("steerocath_t")
INSERTION_m, CURVATURE_per_m = 0.0, 18.0
POSITION_STD_m, ANGLE_STD_rad = 0.1e-3, 0.0015
TIP_N, PLACE_m = np.array([0.03, 0.06, -0.12]), 0.030


NOMINAL = np.array([INSERTION_m, CURVATURE_per_m, 0.0])


def bent(joint: NDArray, stations_m: list[float], tip_N: NDArray, body_N: NDArray) -> CosseratSolution:
    """The catheter at insertion (m), curvature (1/m) and roll (rad) under both forces, base frame."""
    loads = [PointLoad(PLACE_m, body_N)] if body_N.any() else []
    insertion_m, curvature_per_m, roll_rad = (float(value) for value in joint)
    return solve_cosserat(
        STEEROCATH, insertion_m, curvature_per_m, tip_N, "base", stations_m=stations_m, roll_rad=roll_rad, point_loads=loads
    )


def across_the_shaft(size_N: float, joint: NDArray = NOMINAL, along_N: float = 0.0) -> NDArray:
    """A force of the body across the bent shaft, in the bending plane away from the bend, and `along_N` along the shaft."""
    force = np.array([0.0, size_N, 0.0])
    for _ in range(8):
        tangent = rotation_matrix(bent(joint, [PLACE_m], TIP_N, force).station_quaternions_wxyz[0])[:, 2]
        across = force - float(force @ tangent) * tangent
        force = size_N / np.linalg.norm(across) * across + along_N * tangent
    return force


BODY_N = across_the_shaft(0.15)
PRIOR = ActuationPrior(np.zeros(3), np.diag(np.square([0.3e-3, 0.2, 0.02])))


def sensors(
    offsets: list[float], tip_N: NDArray, body_N: NDArray, seed: int | None, joint: NDArray = NOMINAL
) -> list[PoseSensor]:
    found = bent(joint, offsets, tip_N, body_N)
    assert found.converged
    rng = np.random.default_rng(seed)
    out = []
    for offset, p, q in zip(offsets, found.station_positions_m, found.station_quaternions_wxyz, strict=True):
        if seed is not None:
            p = p + POSITION_STD_m * rng.standard_normal(3)
            q = quaternion_product(q, quaternion_of_vector(ANGLE_STD_rad * rng.standard_normal(3)))
        noise = np.eye(3) * POSITION_STD_m**2, np.eye(3) * ANGLE_STD_rad**2
        out.append(PoseSensor(offset, p, q, *noise))
    return out


def test_both_forces_and_the_place_from_three_poses() -> None:
    seen = sensors([0.0, 0.022, 0.045], TIP_N, BODY_N, None)
    found = estimate_contacts(STEEROCATH, INSERTION_m, CURVATURE_per_m, seen, actuation=PRIOR)
    assert found.converged and found.chi_square < 5.0  # what friction and the actuation's prior pull
    assert abs(found.body_offset_m - PLACE_m) < 0.002
    assert np.abs(found.tip_force_N - TIP_N).max() < 0.02 and np.abs(found.body_force_N - BODY_N).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_the_place_is_found_in_noise(seed: int) -> None:
    seen = sensors([0.0, 0.022, 0.045], TIP_N, BODY_N, seed)
    found = estimate_contacts(STEEROCATH, INSERTION_m, CURVATURE_per_m, seen, actuation=PRIOR)
    assert found.converged and found.observable and abs(found.body_offset_m - PLACE_m) < 0.005


def normalized_square(seed: int) -> float:
    """Squared error in units of the stated covariance, in a world drawn from what is known beforehand.

    Drawn are the errors of insertion, curvature and roll, the friction at the body, and the tracker's noise.
    """
    rng = np.random.default_rng([seed, 77])
    joint = NOMINAL + np.sqrt(np.diag(PRIOR.covariance)) * rng.standard_normal(3)
    body_N = across_the_shaft(0.15, joint, ALONG_SHAFT_SD_N * rng.standard_normal())
    seen = sensors([0.0, 0.022, 0.045], TIP_N, body_N, seed, joint)
    found = estimate_contacts(STEEROCATH, INSERTION_m, CURVATURE_per_m, seen, actuation=PRIOR)
    error = np.array([*(found.tip_force_N - TIP_N), *(found.body_force_N - body_N), found.body_offset_m - PLACE_m])
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.slow
def test_the_covariance_covers_the_errors_in_noise() -> None:
    """Seven components in 40 worlds: 95 % of the values of chi square with 280 degrees of freedom are in these bounds."""
    assert 235.5 < sum(normalized_square(seed) for seed in range(100, 140)) < 328.2


def test_what_is_not_observable_is_said() -> None:
    free = estimate_contacts(
        STEEROCATH, INSERTION_m, CURVATURE_per_m, sensors([0.0, 0.022, 0.045], TIP_N, np.zeros(3), 1), actuation=PRIOR
    )
    assert not free.observable and any("not observable" in warning for warning in free.warnings)
    unsure = ActuationPrior(np.zeros(3), np.diag(np.square([2e-3, 3.0, 0.3])))
    for offsets in ([0.0, 0.010], [0.0, 0.006, 0.012]):  # two, and three that are nearer to the tip than the contact
        found = estimate_contacts(
            STEEROCATH, INSERTION_m, CURVATURE_per_m, sensors(offsets, TIP_N, BODY_N, 2), actuation=unsure
        )
        assert not found.observable and any("not observable" in warning for warning in found.warnings), offsets


@pytest.mark.parametrize(("count", "insertion_m", "key"), [(1, INSERTION_m, "sensors"), (2, -0.065, "insertion_m")])
def test_bad_input_is_refused_in_one_line(count: int, insertion_m: float, key: str) -> None:
    seen = sensors([0.0, 0.022], TIP_N, np.zeros(3), None)[:count]
    with pytest.raises(InputError, match=key):
        estimate_contacts(STEEROCATH, insertion_m, CURVATURE_per_m, seen)
