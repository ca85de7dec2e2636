"""Free motion over the whole workspace: every goal is reached, and no check of the failsafe takes it for a fault."""

import numpy as np
import pytest

from host.studies.control.runs import go_to, random_goals, with_control
from protocol.rig_file import SIMULATED_RIG, load_rig

THESIS = {"law": "thesis", "form": "incremental", "position_integral_per_s2": 0.0, "approach_speed_m_per_s": 0.02}


# With these goals an insertion next to a knob that straightens was once taken for a tracker that moved.
@pytest.mark.parametrize(
    ("law", "seed"),
    [
        pytest.param({}, 5, marks=pytest.mark.long),
        ({}, 101),
        (THESIS, 5),
        pytest.param(THESIS, 101, marks=pytest.mark.long),
    ],
    ids=["predictive-5", "predictive-101", "thesis-5", "thesis-101"],
)
def test_goals_far_apart_are_reached_without_an_alarm(law: dict[str, object], seed: int) -> None:
    rig = with_control(load_rig(SIMULATED_RIG), **law)
    there = go_to(rig, random_goals(rig, 5, seed), seed, seconds=2.6, within_s=2.5)
    assert there.stopped_by == ""
    assert np.max(there.rms_m) < (0.5e-3 if not law else 1.5e-3)
