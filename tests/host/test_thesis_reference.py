"""The thesis' own schemes do what the thesis says of them, and no better."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from host.mechanics import thesis_reference
from host.mechanics.cosserat import solve_cosserat
from protocol.catheter import load_catheter
from tests.host.rod_cases import random_catheter, rod_of, unit

Array = NDArray[np.float64]

OFFSETS = np.array([0.0, 0.03, 0.05])


def test_euler_with_500_elements_is_off_by_a_tenth_of_a_millimetre() -> None:
    rng, errors = np.random.default_rng(0), []
    from host.mechanics.rod import rod_record

    for _ in range(40):
        catheter, k0, force = random_catheter(rng), rng.uniform(0.0, 45.0), rng.uniform(0.02, 0.25) * unit(rng)
        position, _ = thesis_reference.tip_pose_500(rod_record(catheter, 0.0, k0), force)
        errors.append(np.linalg.norm(position - solve_cosserat(catheter, 0.0, k0, force, "tip").tip_position_m))
    assert 3e-5 < np.median(errors) < 3e-4


def test_euler_tends_to_the_rod_at_first_order() -> None:
    rod, force = rod_of("steerocath_t", 0.02, 30.0), np.array([0.05, 0.1, -0.05])
    exact = solve_cosserat(load_catheter("steerocath_t"), 0.02, 30.0, force, "tip").tip_position_m
    errors = []
    for elements in (450, 900, 1800):
        shape = np.empty((elements + 1, 7))
        thesis_reference.euler_sweep(rod, force, 0.0, elements, shape)
        errors.append(np.linalg.norm(shape[-1, :3] - exact))
    assert 1.8 < errors[0] / errors[1] < 2.2 and 1.8 < errors[1] / errors[2] < 2.2


def test_algorithm_3_1_converges_in_a_few_passes_for_small_loads_and_not_for_large_ones() -> None:
    rod = rod_of("steerocath_t", 0.0, 20.0)
    small = thesis_reference.algorithm_3_1(rod, np.array([0.02, 0.0, 0.0]), 0.0, 500, 1e-3)
    large = thesis_reference.algorithm_3_1(rod, np.array([0.0, 0.0, 0.35]), 0.0, 500, 1e-3)
    assert small.converged and small.passes <= 6
    assert not large.converged and large.passes == thesis_reference.MOST_PASSES


@pytest.mark.parametrize("case", [2, 4, 6])
def test_its_estimates_find_the_force_to_a_few_millinewton(case: int) -> None:
    catheter, force = load_catheter("livewire"), np.array([0.02, -0.02, 0.03])
    found = solve_cosserat(catheter, 0.01, 10.0, force, "tip", stations_m=OFFSETS)
    x, sweeps = thesis_reference.estimate(
        rod_of("livewire", 0.01, 10.0), 0.07, case, OFFSETS, found.station_positions_m, found.station_quaternions_wxyz
    )
    error = np.linalg.norm(x - force)
    assert 1e-6 < error < 5e-3 and sweeps < 400


@pytest.mark.parametrize("case", [1, 2, 3, 4, 5, 6])
def test_its_costs_vanish_at_its_own_model(case: int) -> None:
    rod, force = rod_of("livewire", 0.01, 10.0), np.array([0.01, -0.01, 0.02])
    shape = np.empty((501, 7))
    thesis_reference.euler_sweep(rod, force, 0.0, 500, shape)
    nodes = np.rint((0.08 - OFFSETS) / 0.08 * 500).astype(int)
    z = thesis_reference.residual(case, 0.07, shape[nodes, :3], shape[nodes, 3:], (shape[nodes, :3], shape[nodes, 3:]))
    assert np.abs(z).max() < 1e-15
    assert len(z) == {1: 3, 2: 6, 3: 3, 4: 9, 5: 3, 6: 6}[case]
