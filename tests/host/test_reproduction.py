"""Reproductions: report and JSON to contract; the thesis' simulations; the sections that need no rig."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.rod import rod_record
from host.mechanics.thesis_reference import algorithm_3_1
from host.report.figure_page import Section, as_json, write_reproduction
from host.studies.reproduction import control_hybrid, control_kinematics, control_rig
from host.studies.reproduction.thesis_control import (
    CATHETER,
    PI,
    STARTS,
    Gains,
    Setting,
    ThesisRun,
    cost,
    heart,
    hybrid,
    step_figures,
)
from host.studies.reproduction.thesis_inverse import branch_bends, fitted_polynomials, polynomial_inverse, unit_tip
from host.studies.reproduction.thesis_plant import Instant, contact_by_algorithm_3_1, plant_model, rest
from protocol.catheter import load_catheter
from protocol.errors import InputError

SECTION = Section("fig_1", "Fig. 1", "It is so.", "So it is <here>.", "holds", "1 of 1.")


def test_the_report_stands_alone_and_escapes(tmp_path: Path) -> None:
    page = write_reproduction(tmp_path / "deep" / "page.html", "Title", "Lead.", [SECTION]).read_text()
    assert "Holds." in page and "&lt;here&gt;" in page and 'id="fig_1"' in page
    assert "<script" not in page and 'src="http' not in page


def test_the_json_is_the_contracts(tmp_path: Path) -> None:
    told = as_json([SECTION], tmp_path / "page.html")
    assert set(told) == {"sections", "report"}
    assert set(told["sections"][0]) == {"id", "verdict", "thesis", "ours", "says"}
    json.dumps(told)


@pytest.mark.parametrize("change", [{"verdict": "perhaps"}, {"says": "two\nlines"}, {"says": ""}])
def test_a_section_without_a_verdict_is_refused(change: dict) -> None:
    with pytest.raises(ValueError, match="fig_1"):
        Section(**{**SECTION.__dict__, **change})


def test_an_unknown_part_is_refused() -> None:
    import typer

    from host.cli.reproduce import reproduce

    app = typer.Typer()
    app.command()(reproduce)
    result = CliRunner().invoke(app, ["biology"])
    assert isinstance(result.exception, InputError) and "mechanics or control" in str(result.exception)


def test_the_printed_gains_settle_and_hold_position() -> None:
    for force in (0.1, 0.2, 0.25):
        run = hybrid(force, 60)
        figures = step_figures(run, force)
        assert figures.settling < 12 and figures.steady_error_N < 0.01 * force + 5e-4
        assert abs(run.tip_m[-1, 0] - run.tip_m[0, 0]) < 1e-4


def test_too_much_gain_does_not_settle() -> None:
    assert step_figures(hybrid(0.25, 120, Gains().scaled(K_pp=3.0)), 0.25).settling == 120


def test_the_pi_form_needs_its_integral_gain_and_is_unstable_with_the_printed_optimum() -> None:
    slow, pi = Gains(0.25, 0.02, 0.0, 0.0545, 1e-4, 0.0), Setting(form=PI)
    here, without = (step_figures(hybrid(0.25, 600, slow.scaled(K_ip=k), pi), 0.25) for k in (1.0, 0.0))
    assert here.steady_error_N < 0.7 * without.steady_error_N and here.ringing_N < 1e-3
    assert step_figures(hybrid(0.25, 120, Gains(), pi), 0.25).settling == 120


def test_a_figure_on_the_rig_holds_where_one_reading_bears_it_out() -> None:
    time_s = np.arange(0.0, 10.0, 0.01)
    none = control_rig.RigRun("one", True, time_s, np.full(1000, 0.1), time_s, time_s, np.zeros((1000, 3)), 0.1)
    first, second = control_rig.READINGS[:2]
    figures = [control_rig.RigFigures(r, {"7.24": [none]}, {"7.24": (r is second, "so")}) for r in (first, second)]
    section = control_rig._section(figures, "7.24", "Fig. 7.24", "It is so.", "Ours.")
    assert section.verdict == "holds" and section.says.startswith(f"at 1 of 2 admissible settings: {second.name}")
    assert [row[2] for row in section.rows] == ["holds", "no", "yes"]


@pytest.mark.parametrize(("insertion_m", "curvature"), [(-0.03, 7.0), (-0.02, 30.0), (0.0, -12.0), (0.008, 20.0)])
def test_the_unloaded_rod_is_the_unloaded_arcs(insertion_m: float, curvature: float) -> None:
    at = Instant(curvature, insertion_m, 1.0, 1.0)
    rod, arcs = (rest(plant_model(CATHETER, is_rod), at, at, np.zeros(3)) for is_rod in (True, False))
    assert rod.force_N == arcs.force_N == 0.0
    assert (rod.x, rod.y) == pytest.approx((arcs.x, arcs.y), abs=1e-9)


@pytest.mark.parametrize("start", STARTS, ids=lambda start: start.name)
@pytest.mark.parametrize("more_curvature", [5.0, 12.0, 20.0])
def test_newtons_contact_lies_on_the_tissue(start: Setting, more_curvature: float) -> None:
    at = Instant(start.curvature_per_m + more_curvature, start.insertion_m, start.tip_m[1] + start.gap_m, 1.1)
    carried = np.zeros(3)
    found = rest(plant_model(CATHETER, True), at, at, carried)
    assert found.found and found.force_N > 1e-3
    assert found.y - at.wall_m - found.force_N / 1000.0 == pytest.approx(0.0, abs=1e-9)
    # The same force, laid on the rod of the product, leads the tip to the same place; stiffness scales as the force does.
    alone = solve_cosserat(load_catheter(CATHETER), at.insertion_m, at.curvature, (0.0, found.force_N / at.stiffness, 0.0))
    assert (alone.tip_position_m[2], -alone.tip_position_m[1]) == pytest.approx((found.x, found.y), abs=1e-8)
    assert alone.tip_position_m[0] == pytest.approx(0.0, abs=1e-9)
    # From there it is followed to the next instant as from the unloaded shape.
    ahead = at._replace(curvature=at.curvature + 3.0, insertion_m=at.insertion_m + 0.001)
    followed, fresh = rest(plant_model(CATHETER, True), ahead, at, carried), np.zeros(3)
    assert followed.force_N == pytest.approx(rest(plant_model(CATHETER, True), ahead, ahead, fresh).force_N, abs=1e-7)


def test_algorithm_3_1_in_newtons_method_finds_the_same_contact() -> None:
    at = Instant(Setting().curvature_per_m + 15.0, -0.028, Setting().tip_m[1] + 0.001, 1.0)
    found = rest(plant_model(CATHETER, True), at, at, np.zeros(3))
    coarse, fine = (contact_by_algorithm_3_1(plant_model(CATHETER, True), at, n, e) for n, e in ((500, 1e-3), (4000, 1e-9)))
    assert coarse.found and fine.found and found.force_N > 0.05
    assert abs(coarse.force_N - found.force_N) < 0.01 * found.force_N
    assert abs(fine.force_N - found.force_N) < 0.001 * found.force_N


def test_without_contact_the_tip_is_free_and_a_run_without_equilibrium_fails() -> None:
    run = hybrid(0.2, 60)
    assert run.force_N[0] == 0.0 and run.tip_m[0] == pytest.approx(Setting().tip_m, abs=1e-9)
    assert np.all(np.isfinite(run.force_N)) and not run.failed
    lost = ThesisRun(np.array([0.1, np.inf]), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2))
    assert lost.failed and step_figures(lost, 0.1).ringing_N == math.inf


@pytest.mark.parametrize("bend_deg", [15.0, 45.0, 90.0])
def test_a_whole_shaft_outside_loses_contact_before_the_desired_force(bend_deg: float) -> None:
    whole = Setting(insertion_m=0.0, bend_rad=math.radians(bend_deg))
    assert step_figures(hybrid(0.25, 120, None, whole), 0.25).settling == 120
    rod = rod_record(load_catheter(CATHETER), 0.0, whole.curvature_per_m)
    assert not algorithm_3_1(rod, np.array([0.0, 0.25, 0.0]), 0.0, 500, 1e-3).converged


def test_polynomials_reach_the_printed_error() -> None:
    bend = branch_bends(1)
    fitted = np.polynomial.polynomial.polyval(unit_tip(bend)[1], fitted_polynomials()[1])
    rms_per_m = float(np.sqrt(np.mean((fitted - bend) ** 2))) / 0.070
    assert round(rms_per_m, 2) == 0.26


@pytest.mark.parametrize("bend", [-4.5, -2.8, -2.0, -0.5, 1e-9, 0.3, 2.0, 3.0, 5.0])
@pytest.mark.parametrize("body_m", [0.0, 0.02])
def test_the_polynomial_inverse_undoes_the_arc(bend: float, body_m: float) -> None:
    length_m = 0.07
    along, across = (length_m * float(value) for value in unit_tip(np.array(bend)))
    curvature, found = polynomial_inverse(fitted_polynomials(), along + body_m, across, length_m, bend / length_m)
    assert curvature == pytest.approx(bend / length_m, abs=0.5)
    # (7.1) is exact for the curvature that was found.
    assert found == pytest.approx(along + body_m - length_m * float(np.sinc(curvature * length_m / np.pi)), abs=1e-9)


def test_heart_is_in_hertz() -> None:
    t = np.arange(0, 3, 0.001)
    assert np.allclose(heart(t, respiration_m=0.0)[:1000], heart(t, respiration_m=0.0)[500:1500], atol=1e-12)
    assert heart(np.array([0.125]), respiration_m=0.0)[0] == pytest.approx(0.001)


def test_the_search_of_gains_does_not_get_worse() -> None:
    assert cost(control_hybrid.best_gains(Setting(), 25)) <= cost(Gains()) + 1e-12


def test_sections_of_the_simulated_figures() -> None:
    sections = {section.id: section for section in [*control_kinematics.sections(), *control_hybrid.sections(True)]}
    assert set(sections) == {
        "fig_7.5",
        "fig_7.6",
        "fig_7.7",
        "fig_7.8",
        "fig_7.3",
        "fig_7.9_7.10",
        "fig_7.11",
        "fig_7.12",
        "fig_7.13",
        "fig_7.14",
        "fig_7.15",
        "fig_7.16",
        "fig_7.17",
    }
    for name in ("fig_7.3", "fig_7.5", "fig_7.6", "fig_7.8", "fig_7.9_7.10", "fig_7.13", "fig_7.16"):
        assert sections[name].verdict == "holds", sections[name].says
    assert all(section.pictures for section in sections.values())


@pytest.mark.slow
def test_an_experiment_on_the_whole_rig() -> None:
    run = control_rig.experiment(control_rig.thesis_rig(control_rig.SECOND_READING), control_rig.AXIAL, "one", 0.1, 5.0, 1)
    assert run.contact and abs(run.late().mean() - 0.1) < 0.02
    assert abs(float(run.off_m[run.settled].mean())) < 1e-3 and math.isfinite(run.stage.sum())
