"""Spatial estimation: noiseless poses give the force back, and a wrong force is never called converged."""

import numpy as np
import pytest

from host.estimation.sensor_noise import PoseSensor
from host.estimation.spatial import ForceEstimate, estimate_cosserat
from host.mechanics.catheter import load_catheter
from host.mechanics.cosserat import solve_cosserat

OFFSETS_m = (0.0, 0.03, 0.05)


def estimated(curvature_per_m: float, force_tip_N: list[float], case: int) -> ForceEstimate:
    catheter = load_catheter("livewire")
    solution = solve_cosserat(catheter, 0.01, curvature_per_m, force_tip_N, "tip", 0.0, OFFSETS_m)
    sensors = [PoseSensor(offset, solution.station_positions_m[i], solution.station_quaternions_wxyz[i])
               for i, offset in enumerate(OFFSETS_m)]
    return estimate_cosserat(catheter, 0.01, curvature_per_m, case, sensors)


@pytest.mark.parametrize("case", [2, 4, 6])
@pytest.mark.parametrize("force", [[0.05, 0.02, -0.1], [0.0, 0.08, 0.05], [-0.1, -0.03, -0.05]])
def test_noiseless_poses_give_the_force_back(case: int, force: list[float]) -> None:
    answer = estimated(10.0, force, case)
    assert answer.converged
    assert np.linalg.norm(answer.force_N - np.array(force)) < 1e-6


@pytest.mark.parametrize("case", [2, 4, 6])
def test_a_wrong_force_is_not_called_converged(case: int) -> None:
    force = [-0.17442154, 0.17442154, -0.08978029]
    answer = estimated(30.0, force, case)
    assert not answer.converged or np.linalg.norm(answer.force_N - np.array(force)) < 1e-5
