"""Forces over a grid of directions: none wrong in silence, no jumps with a wrong stiffness, no fit that is none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from host.estimation.spatial import estimate_cosserat
from host.studies.benchmarks import force_grid
from tests.host.test_spatial_estimation import LIVEWIRE, STEEROCATH, INSERTION_m, posed, sensors_of


def test_a_search_that_ends_beyond_the_largest_force_is_not_a_perfect_fit() -> None:
    """The fine steps once gave up at 0.504 N with a cost of zero, within a hundredth of the limit: believed, and wrong."""
    force = np.array([-0.17442154, 0.17442154, -0.08978029])
    found = estimate_cosserat(LIVEWIRE, INSERTION_m, 30.0, 4, sensors_of(posed(LIVEWIRE, 30.0, force, "tip")))
    assert found.converged and np.abs(found.force_N - force).max() < 1e-6 and found.residual < 1e-6


@pytest.mark.parametrize("name", ["livewire", "steerocath_t"])
@pytest.mark.parametrize("case", [2, 4, 6])
def test_a_coarse_grid_of_forces_has_none_wrong_in_silence(name: str, case: int) -> None:
    count = force_grid.grid(name, case, 4, sizes=(0.05, 0.2), curvatures=(10.0, 45.0))
    assert count.exact == 32 and not count.wrong and not count.refused and not count.warned


def test_ten_percent_of_stiffness_makes_no_jump() -> None:
    """Fig. 5.6, every direction started anew: the error stays of the size of the stiffness error."""
    p = STEEROCATH.cosserat
    assert p is not None
    stiffer = replace(STEEROCATH, cosserat=replace(p, EI1=1.1 * p.EI1, EI2=1.1 * p.EI2))
    for case in (2, 4, 6):
        for alpha in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False):
            force = 0.2 * np.array([math.cos(alpha), 0.0, math.sin(alpha)])
            found = estimate_cosserat(STEEROCATH, INSERTION_m, 10.0, case, sensors_of(posed(stiffer, 10.0, force, "tip")))
            assert np.linalg.norm(found.force_N - force) < 0.07
