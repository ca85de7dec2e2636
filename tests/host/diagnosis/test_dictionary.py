"""Simple forms predict_residual what no listed effect explains, where the outputs can show it; noise is foretold by none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.estimation.fit import Fit, Problem
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.symbolic.dictionary import PredictedPart, forms_at, is_curve, predict_residual
from tests.host.diagnosis import planted, rig_cases

MICROMETRES = 25e-6  # of insertion: a quarter of the poses' noise


def fitted(case: tuple[Path, list[Path]]) -> tuple[Problem, Fit]:
    problem = prepare(read_nominal(case[0]), case[1])[1]
    return problem, fit_nominal(problem)


def places(problem: Problem, fit: Fit) -> list[PredictedPart]:
    return predict_residual(problem, fit)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_noise_is_foretold_by_nothing(tmp_path: Path, seed: int) -> None:
    assert not any(place.sure for place in places(*fitted(planted.transmission(tmp_path, "", seed))))


def test_a_product_of_channels_is_read_off(tmp_path: Path) -> None:
    (place,) = places(*fitted(planted.transmission(tmp_path, "unlisted", 1)))
    assert place.sure and place.port is not None and place.port.name == "cable"
    assert place.forms[0][0].text == "motor*load"
    assert place.forms[0][1] == pytest.approx(0.15, rel=0.1)  # at the input, before the gain


@pytest.mark.slow
def test_micrometres_that_only_the_force_shows_are_seen(tmp_path: Path) -> None:
    problem, fit = fitted(rig_cases.write(tmp_path, rig_cases.Truth(), 0, duration_s=12.0))
    assert not any(place.sure for place in places(problem, fit))
    for segment, residual in zip(problem.segments, fit.residuals, strict=True):
        roll, knob = segment.inputs["handle_roll"], segment.inputs["handle_knob"]
        shape = np.sin(roll) * knob
        moved = MICROMETRES * shape / np.std(shape)
        residual += problem.model.sensitivity(segment, fit.values, "insertion", []) * moved
    best = max(places(problem, fit), key=lambda place: place.log_likelihood)
    assert best.sure and best.subsystem == "insertion"
    assert "handle_roll" in best.forms[0][0].text and "handle_knob" in best.forms[0][0].text


def test_forms_are_told_as_they_are_computed(tmp_path: Path) -> None:
    problem, fit = fitted(planted.transmission(tmp_path, "", 1))
    segment, port = problem.segments[0], problem.model.ports[0]
    motor, load = segment.inputs["motor"], segment.inputs["load"]
    forms = {form.text: form.evaluate(segment) for form in forms_at(problem, fit, port)}
    assert np.array_equal(forms["motor*load"], motor * load)
    assert np.array_equal(forms["sin(2*motor)*abs(load)"], np.sin(2.0 * motor) * np.abs(load))
    assert all(np.isfinite(values).all() and values.shape == motor.shape for values in forms.values())
    assert len({text.replace(" ", "") for text in forms}) == len(forms)
    assert "rate(motor)" not in forms  # a lag or a damping says it, but for how a motion was smoothed


def test_data_without_time_have_no_rates(tmp_path: Path) -> None:
    problem, fit = fitted(planted.transmission(tmp_path, "", 1, timed=False))
    assert not any("rate" in form.text or "lag" in form.text for form in forms_at(problem, fit, problem.model.ports[0]))


@pytest.mark.parametrize(
    ("text", "curve"),
    [
        ("x*abs(x)", True),
        ("((0.31 * tanh((x / 0.0066))) + 1.2e-05)", True),
        ("x^3", True),
        ("x", False),
        ("x*y", False),
        ("x*rate(x)", False),
        ("lag(x, 0.2)", False),
        ("play(x, 0.1)", False),
        ("sin(3*x)", False),
    ],
)
def test_an_equation_of_its_own_signal_alone_is_a_static_curve(text: str, curve: bool) -> None:
    assert is_curve(text, "x") is curve


@pytest.mark.slow
def test_a_curve_at_an_input_without_a_gain_is_named_and_its_slope_is_free() -> None:
    """The curve is steeper at the ends than the simulator's unit gain, so that no bend of the same slope fits it."""

    def recorded(seed: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([91, seed])
        t = np.arange(0.0, 20.0, 0.02)
        x = np.sin(2.0 * np.pi * np.outer(t, [0.11, 0.23, 0.47]) + rng.uniform(0.0, 6.28, 3)).sum(axis=1)
        curved = 1.6 * x - 0.6 * 0.5 * np.arcsinh(x / 0.5)
        return {"t": t, "x": x, "y": 2.0 * curved + 0.3 + 0.02 * rng.standard_normal(t.size)}

    def straight(inputs: dict[str, Any], parameters: dict[str, float], time_s: Any) -> dict[str, Any]:
        return {"y": 2.0 * inputs["x"] + parameters["offset"]}

    nominal = {
        "name": "lever",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {"x": {"column": "x", "unit": "m"}, "y": {"column": "y", "unit": "m"}},
        "callable": {"function": straight, "inputs": ["x"], "outputs": ["y"], "subsystem": "lever"},
        "parameters": {"offset": 0.2},
    }
    verdict = sd.diagnose([recorded(k) for k in (1, 2, 3)], nominal)
    assert [(effect["id"], effect["subsystem"]) for effect in verdict.effects] == [("static_nonlinearity", "lever")]
    left = verdict.as_dict()["fit"]
    assert left["rmse_after"] < 0.1 * left["rmse_before"]
