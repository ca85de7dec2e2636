"""What was planted is named, and where nothing was planted nothing is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.pipeline import Diagnosis, diagnose
from host.diagnosis.report.verdict import as_json
from tests.host.diagnosis import planted, rig_cases


def run(case: tuple[Path, list[Path]], without: frozenset[str] = frozenset()) -> Diagnosis:
    """Diagnosis without a word."""
    return diagnose(read_nominal(case[0]), case[1], lambda what, part: None, without)


def names(result: Diagnosis) -> list[str]:
    """Ids of the effects found, strongest first."""
    return [effect["id"] for effect in as_json(result, 0.0)["effects"]]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_planted_nothing_said(tmp_path: Path, seed: int) -> None:
    result = run(planted.transmission(tmp_path, "none", seed))
    assert result.verdict == "nothing_missing" and names(result) == [] and result.located == []


@pytest.mark.parametrize("seed", range(2))
def test_silent_on_axis_and_impedance_too(tmp_path: Path, seed: int) -> None:
    for make in (planted.axis, planted.impedance):
        assert run(make(tmp_path, "none", seed)).verdict == "nothing_missing"


def test_backlash_with_its_width(tmp_path: Path) -> None:
    result = run(planted.transmission(tmp_path, "backlash", 1))
    (effect,) = as_json(result, 0.0)["effects"]
    assert effect["id"] == "backlash" and effect["subsystem"] == "cable"
    width = effect["parameters"]["width_rad"]
    assert width["value"] == pytest.approx(0.02, rel=0.05) and width["ci95"][0] < 0.02 < width["ci95"][1] * 1.05


def test_compliance_with_its_size(tmp_path: Path) -> None:
    (effect,) = as_json(run(planted.transmission(tmp_path, "compliance", 2)), 0.0)["effects"]
    assert effect["id"] == "compliance"
    assert effect["parameters"]["compliance_rad_per_N_m"]["value"] == pytest.approx(0.02, rel=0.05)


def test_latency_is_not_taken_for_a_lag(tmp_path: Path) -> None:
    effect = as_json(run(planted.transmission(tmp_path, "latency", 3)), 0.0)["effects"][0]
    assert effect["id"] == "latency" and effect["parameters"]["delay_s"]["value"] == pytest.approx(0.11, rel=0.03)


def test_rate_effects_are_no_candidates_without_a_time_line(tmp_path: Path) -> None:
    result = run(planted.transmission(tmp_path, "backlash", 1, timed=False))
    assert names(result)[:1] == ["backlash"]
    tried = {trial.candidate.effect.id for step in result.found.steps for trial in step.trials}
    assert not tried & {"latency", "rate_lag", "creep_relaxation", "viscous_friction"}


def test_an_effect_left_out_of_the_library_is_not_named(tmp_path: Path) -> None:
    result = run(planted.transmission(tmp_path, "backlash", 1), frozenset({"backlash", "presliding_friction"}))
    assert not {"backlash", "presliding_friction"} & set(names(result))
    assert result.verdict != "nothing_missing"


def test_physics_of_no_list_is_told_by_an_equation(tmp_path: Path) -> None:
    nominal, files = planted.transmission(tmp_path, "unlisted", 1)
    result = run((nominal, files))
    verdict = as_json(result, 0.0)
    (effect,) = verdict["effects"]
    assert verdict["verdict"] == "missing_physics" and effect["id"] == "unlisted"
    assert verdict["probability_none_raw"] > effect["probability_raw"] - 1e-9  # none of the vocabulary is what is missing
    assert "motor" in effect["equation"] and "load" in effect["equation"]
    assert verdict["fit"]["rmse_after"] < 1.2 * 2e-3 < 0.2 * verdict["fit"]["rmse_before"]


def test_cubic_spring(tmp_path: Path) -> None:
    effect = as_json(run(planted.axis(tmp_path, "cubic", 1)), 0.0)["effects"][0]
    assert effect["id"] == "nonlinear_stiffness"
    assert effect["parameters"]["cubic_N_per_m3"]["value"] == pytest.approx(150.0, rel=0.1)


def test_coulomb_friction(tmp_path: Path) -> None:
    effect = as_json(run(planted.axis(tmp_path, "coulomb", 1)), 0.0)["effects"][0]
    assert effect["id"] in ("coulomb_friction", "presliding_friction")
    assert effect["parameters"]["force_N"]["value"] == pytest.approx(1.2, rel=0.1)


def test_lugre_bristle_is_presliding_friction(tmp_path: Path) -> None:
    effect = as_json(run(planted.impedance(tmp_path, "lugre", 1)), 0.0)["effects"][0]
    assert effect["id"] == "presliding_friction"
    assert effect["parameters"]["force_N"]["value"] == pytest.approx(0.3, rel=0.1)


@pytest.mark.long
def test_rig_backlash_is_found_in_its_place(tmp_path: Path) -> None:
    def play(q: np.ndarray, t: np.ndarray) -> np.ndarray:
        y = q.copy()
        for i in range(1, q.size):
            gap = q[i] - y[i - 1]
            y[i] = y[i - 1] + (gap - 8e-4 * np.sign(gap) if abs(gap) > 8e-4 else 0.0)
        return y

    result = run(rig_cases.write(tmp_path, rig_cases.Truth(insertion=play), 1, duration_s=15.0))
    effect = as_json(result, 0.0)["effects"][0]
    assert (effect["id"], effect["subsystem"]) == ("backlash", "insertion")
    assert effect["parameters"]["width_m"]["value"] == pytest.approx(1.6e-3, rel=0.1)


@pytest.mark.long
def test_rig_silent(tmp_path: Path) -> None:
    result = run(rig_cases.write(tmp_path, rig_cases.Truth(), 0, duration_s=12.0))
    assert result.verdict == "nothing_missing" and names(result) == []
