"""The table of the study of force by poses alone: what was lost, what was never reached, and where the wall stands."""

import numpy as np
import pytest

from host.studies.control.pose_only_study import row, tilted_wall
from host.studies.control.runs import Held
from protocol.enums import Phase


def held(force_N: np.ndarray) -> Held:
    return Held(np.arange(len(force_N)) * 1e-3, force_N, np.full(len(force_N), Phase.CONTACT), True)


def test_the_longest_loss_of_touch_is_measured() -> None:
    force = np.full(8000, 0.2)
    force[100:120], force[6000:6065] = 0.0, 0.0
    assert held(force).longest_loss_s() == pytest.approx(0.065)
    assert held(np.full(8000, 0.2)).longest_loss_s() == 0.0


def test_a_row_compares_with_the_still_catheter_and_counts_what_was_lost() -> None:
    steady, lost = np.full(8000, 0.21), np.full(8000, 0.21)
    lost[200:300] = 0.0
    never = Held(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), False)
    assert row([held(steady), held(lost)], [0.04, 0.04]) == (
        "10.0 mN | 10.0 to 10.0 mN | 210 mN | 0.25 | 0.25 | 10 mN | 1 of 2 | 0.100 s |"
    )
    assert row([held(steady), never], [0.04, 0.04]).endswith("10 mN | 1 of 2 | for ever |")
    assert row([never], [0.04]).startswith("wall not reached")


def test_a_tilted_wall_goes_through_the_target_and_is_pressed_along_its_normal() -> None:
    job, wall = tilted_wall(30.0)
    normal = np.array(wall.normal)
    assert normal @ np.array(job.into) == pytest.approx(-1.0) and normal[0] == pytest.approx(0.5)
    assert (np.array(job.target_m) - np.array(wall.point_m)) @ normal == pytest.approx(0.0)
