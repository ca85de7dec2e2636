"""Contact of the body, watched: three sensors find it and its place, and a beating wall at the tip raises nothing."""

from __future__ import annotations

import numpy as np
import pytest

from host.studies.benchmarks.body_contact import CASES, THREE, TWO, clean, run
from protocol.rig_file import SIMULATED_RIG, load_rig


@pytest.mark.slow
def test_three_sensors_find_the_place_to_five_millimetres() -> None:
    case = next(case for case in CASES if case.offsets_m == THREE)
    found = run(load_rig(SIMULATED_RIG), 7, case, 5.0)
    last = found.reports[-1]
    assert found.true_force_N > 0.05 and found.warned_s < 1.0
    assert last.place == "body" and last.body_offset_m is not None
    assert abs(last.body_offset_m - found.true_offset_m) < 0.005
    assert last.body_force_N is not None
    assert np.linalg.norm(last.body_force_N) == pytest.approx(found.true_force_N, rel=0.3)


@pytest.mark.parametrize("offsets_m", [TWO, THREE])
def test_a_beating_wall_at_the_tip_is_no_contact_of_the_body(offsets_m: tuple[float, ...]) -> None:
    reports, force_N, touched = clean(load_rig(SIMULATED_RIG), 8, 6.0, offsets_m)
    assert force_N > 0.05 and len(reports) > 20
    assert not touched and {report.place for report in reports} == {"tip"}
