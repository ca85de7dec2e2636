"""The reproduction of chapters 2 to 5: the contract's keys, verdicts that can go either way, the catheter that stands in."""

from pathlib import Path

import numpy as np
import pytest

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.rod import rod_record
from host.report.figure_page import as_json
from host.studies.reproduction import fine_spatial, mechanics, planar, spatial, spatial_experiments, spatial_force
from host.studies.reproduction.admissible import Admissible, Tried
from host.studies.reproduction.thesis_schemes import conventional, internal_loads, iterates
from protocol.catheter import load_catheter

LIVEWIRE = load_catheter("livewire")


def test_run_writes_a_page_and_the_contract_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planar, "SECTIONS", (planar.figure_2_3,))
    monkeypatch.setattr(spatial, "SECTIONS", (spatial.figure_3_6, spatial.figure_3_7))
    monkeypatch.setattr(spatial_force, "SECTIONS", ())
    monkeypatch.setattr(spatial_experiments, "SECTIONS", ())
    told: list[str] = []
    sections, page = mechanics.run(tmp_path, True, told.append)
    answer = as_json(sections, page)
    assert [s["id"] for s in answer["sections"]] == ["figure_2.3", "figure_3.6", "figure_3.7"]
    assert all(set(s) == {"id", "verdict", "thesis", "ours", "says"} for s in answer["sections"])
    assert [s["verdict"] for s in answer["sections"]] == ["holds"] * 3
    assert told == ["figure 2.3", "figure 3.6", "figure 3.7"]
    assert page.parent == tmp_path and all(f'id="{s.id}"' in page.read_text() for s in sections)


def test_every_section_comes_once_and_in_the_thesis_order() -> None:
    names = [name for name, _ in mechanics.sections_of(False)]
    asked = [part.SECTIONS for part in (planar, spatial, spatial_force, spatial_experiments)]
    assert len(set(names)) == len(names) == sum(map(len, asked))
    chapters = [int(name.split("_")[1]) for name in names]
    assert chapters == sorted(chapters) and set(chapters) == {2, 3, 4, 5}


def test_a_statement_that_is_not_true_is_marked_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spatial, "_OUTSIDE_m", (0.058, 0.058, 0.070))
    found = spatial.figure_3_4(True)
    assert found.verdict == "does_not_hold" and "at none of 12 admissible settings" in found.says


def test_algorithm_3_1_settles_where_part_of_the_shaft_is_in_the_sheath() -> None:
    found = spatial.figure_3_4(True)
    assert found.verdict == "holds" and "28 mm, 45 1/m" in found.says and "whole shaft outside, 10 1/m: -" in found.ours
    assert "F L2 / EI2 = 2.5 with the whole shaft outside" in found.says  # EI2: a force along e1 bends about d2
    by_size = spatial.figure_3_5(True)
    assert by_size.verdict == "holds" and "at 4 of 10 admissible settings: 20 mm; 24 mm; 28 mm; 32 mm" in by_size.says


@pytest.mark.slow
def test_table_3_1_is_solved_for_a_force_along_e1_with_the_shaft_half_inside() -> None:
    tried = {one.setting: one for one in spatial._table_3_1_map().tried}
    assert tried["e1, 32 mm"].holds and tried["e1, 32 mm"].found == "4, 6, 8, 12, 37"
    assert not tried["e1, 45 mm"].holds and not tried["-e2, 24 mm"].holds


def test_admissible_settings_say_where_a_statement_holds() -> None:
    some = Admissible([Tried("a", "1", False), Tried("b", "2", True), Tried("c", "3", True)])
    assert some.holds and some.where == "at 2 of 3 admissible settings: b; c"
    assert some.rows()[0] == ("setting", "found", "holds") and some.rows()[2] == ("b", "2", "yes")
    none, every = Admissible(some.tried[:1]), Admissible(some.tried[1:])
    assert not none.holds and none.where == "at none of 1 admissible settings"
    assert every.holds and every.where == "at all 2 admissible settings"


@pytest.mark.slow
def test_a_tenth_more_stiffness_costs_what_the_thesis_says_on_catheter_2() -> None:
    found = spatial_force.figure_5_6(True)
    assert found.verdict == "holds" and "catheter 2, 30 1/m, EI2 only" in found.says


def test_a_wrong_model_turns_a_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        spatial, "tip_pose_500", lambda rod, force: (np.array([0.0, 0.0, 0.05]), np.array([1.0, 0.0, 0.0, 0.0]))
    )
    assert spatial.figure_3_6(True).verdict == "does_not_hold"


def test_finer_catheter_without_its_differences_is_the_rod(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fine_spatial, "UNEVEN", 0.0)
    monkeypatch.setattr(fine_spatial, "ELECTRODES_STIFFER", 1.0)
    force, offsets = np.array([0.03, -0.02, 0.01]), np.array([0.0, 0.03, 0.05])
    r, q = fine_spatial.fine_poses(LIVEWIRE, 0.01, 10.0, force, offsets)
    rod = solve_cosserat(LIVEWIRE, 0.01, 10.0, force, "tip", stations_m=offsets)
    np.testing.assert_allclose(r, rod.station_positions_m, atol=1e-8)
    np.testing.assert_allclose(np.abs(np.sum(q * rod.station_quaternions_wxyz, axis=1)), 1.0, atol=1e-12)
    held = np.array([0.01, 0.005, 0.0])
    r, _ = fine_spatial.fine_under_base_force(LIVEWIRE, 0.01, 10.0, held, offsets)
    np.testing.assert_allclose(r[0], solve_cosserat(LIVEWIRE, 0.01, 10.0, held).tip_position_m, atol=1e-7)


def test_conventional_problem_and_first_iterate_meet_the_rod() -> None:
    rod, force = rod_record(LIVEWIRE, 0.0, 15.0), np.array([0.02, 0.0, 0.0])
    converged, tip = conventional(rod, force, 101)
    assert converged
    np.testing.assert_allclose(tip, solve_cosserat(LIVEWIRE, 0.0, 15.0, force).tip_position_m, atol=1e-5)
    arc = 0.07 * 15.0
    np.testing.assert_allclose(
        iterates(rod, force, 1)[0][-1], [0.0, (np.cos(arc) - 1.0) / 15.0, np.sin(arc) / 15.0], atol=2e-4
    )


def test_unloaded_shaft_carries_only_its_tension() -> None:
    rod = rod_record(LIVEWIRE, 0.02, 30.0)
    loads = internal_loads(rod, np.zeros(3), 2.0, np.array([0.0, 0.04, 0.08]))
    np.testing.assert_allclose(loads[:, :3], [[0, 0, -2.0], [0, 0, -2.0], [0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(loads[:, 3:], 0.0, atol=1e-12)
