"""Reproductions: report and JSON to contract; the thesis' simulations; the sections that need no rig."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from host.report.figure_page import Section, as_json, write_reproduction
from host.studies.reproduction import control_hybrid, control_kinematics, control_rig
from host.studies.reproduction.thesis_control import (
    PI,
    Gains,
    Setting,
    contact,
    cost,
    heart,
    hybrid,
    planar_inverse,
    step_figures,
)
from host.studies.reproduction.thesis_position import unloaded_tip
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
    slow = Gains(0.25, 0.02, 0.0, 0.0545, 1e-4, 0.0)
    here, without = (step_figures(hybrid(0.25, 600, slow.scaled(K_ip=k), Setting(form=PI)), 0.25) for k in (1.0, 0.0))
    assert here.steady_error_N < 0.7 * without.steady_error_N and here.ringing_N < 1e-3
    assert step_figures(hybrid(0.25, 120, Gains(), Setting(form=PI)), 0.25).ringing_N > 0.02


def test_a_figure_on_the_rig_holds_where_one_reading_bears_it_out() -> None:
    time_s = np.arange(0.0, 10.0, 0.01)
    none = control_rig.RigRun("one", True, time_s, np.full(1000, 0.1), time_s, time_s, np.zeros((1000, 3)), 0.1)
    first, second = control_rig.READINGS[:2]
    figures = [control_rig.RigFigures(r, {"7.24": [none]}, {"7.24": (r is second, "so")}) for r in (first, second)]
    section = control_rig._section(figures, "7.24", "Fig. 7.24", "It is so.", "Ours.")
    assert section.verdict == "holds" and section.says.startswith(f"at 1 of 2 admissible settings: {second.name}")
    assert [row[2] for row in section.rows] == ["holds", "no", "yes"]


def test_contact_rests_where_the_spring_says() -> None:
    run = hybrid(0.2, 60)
    depth_m = run.tip_m[:, 1] - run.wall_m
    pressed = run.force_N > 0
    assert np.allclose(depth_m[pressed] * 1000.0, run.force_N[pressed], atol=1e-5)
    assert np.all(depth_m[~pressed] <= 1e-9)
    assert contact.__doc__ is not None


@pytest.mark.parametrize("bend", [-2.0, -0.5, 1e-9, 0.3, 2.2])
@pytest.mark.parametrize("body", [-0.03, 0.0, 0.02])
def test_planar_inverse_undoes_the_arc(bend: float, body: float) -> None:
    length = 0.07
    out_m = min(length, length + body)
    tip = unloaded_tip(np.array([body, 0.0]), bend / out_m, length)
    curvature, found = planar_inverse(tip[2], -tip[1], length, bend / out_m)
    assert found == pytest.approx(body, abs=1e-7) and curvature * out_m == pytest.approx(bend, abs=1e-6)


def test_heart_is_in_hertz() -> None:
    t = np.arange(0, 3, 0.001)
    assert np.allclose(heart(t, respiration_m=0.0)[:1000], heart(t, respiration_m=0.0)[500:1500], atol=1e-12)
    assert heart(np.array([0.125]), respiration_m=0.0)[0] == pytest.approx(0.001)


def test_the_search_of_gains_does_not_get_worse() -> None:
    assert cost(control_hybrid.best_gains(25)) <= cost(Gains()) + 1e-12


def test_sections_of_the_simulated_figures() -> None:
    sections = {section.id: section for section in [*control_kinematics.sections(), *control_hybrid.sections(True)]}
    assert set(sections) == {
        "fig_7.5",
        "fig_7.6",
        "fig_7.7",
        "fig_7.8",
        "fig_7.9_7.10",
        "fig_7.11",
        "fig_7.12",
        "fig_7.13",
        "fig_7.14",
        "fig_7.15",
        "fig_7.16",
        "fig_7.17",
    }
    for name in ("fig_7.5", "fig_7.8", "fig_7.9_7.10", "fig_7.13", "fig_7.16"):
        assert sections[name].verdict == "holds", sections[name].says
    assert all(section.pictures for section in sections.values())


@pytest.mark.slow
def test_an_experiment_on_the_whole_rig() -> None:
    run = control_rig.experiment(control_rig.thesis_rig(control_rig.SECOND_READING), control_rig.AXIAL, "one", 0.1, 5.0, 1)
    assert run.contact and abs(run.late().mean() - 0.1) < 0.02
    assert abs(float(run.off_m[run.settled].mean())) < 1e-3 and math.isfinite(run.stage.sum())
