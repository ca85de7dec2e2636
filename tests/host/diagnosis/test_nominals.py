"""Nominal models beyond the plain: a Python function, effects known already, axes that rest, clocks not begun at zero."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from host.diagnosis.model.nominal import effect_of, read_nominal
from host.diagnosis.models.rig import RigSegment
from host.diagnosis.pipeline import Diagnosis, diagnose
from host.diagnosis.report.page import switches
from host.diagnosis.report.verdict import as_json
from protocol.errors import InputError
from tests.host.diagnosis import noisy_force, planted, rig_cases

CALLABLE = """
name = "lever"
kind = "callable"
[data]
time = "t"
[channels.motor]
column = "motor"
unit = "rad"
[channels.load]
column = "load"
unit = "N m"
[channels.tip]
column = "tip"
unit = "rad"
[callable]
function = "lever:reach"
inputs = ["motor"]
outputs = ["tip"]
load = ["load"]
subsystem = "lever"
[parameters]
gain = 1.0
offset = 0.0
"""
LEVER = """
import numpy as np
def reach(inputs, parameters, time_s):
    return {"tip": parameters["gain"] * np.sin(inputs["motor"]) + parameters["offset"]}
"""


def run(nominal: Path, files: list[Path], *effects: str) -> Diagnosis:
    """Diagnosis without a word, with effects switched on."""
    spec = read_nominal(nominal)
    spec.effect += [effect_of(text) for text in effects]
    return diagnose(spec, files, lambda what, part: None)


def lever(folder: Path, width_rad: float) -> tuple[Path, list[Path]]:
    """A lever behind a gap, recorded three times; its nominal is a Python function that lies beside the TOML."""
    (folder / "lever.py").write_text(LEVER)
    nominal = folder / "lever.toml"
    nominal.write_text(CALLABLE)
    _, files = planted.transmission(folder, "none", 4)
    for k, path in enumerate(files):
        t, motor, load, _ = np.loadtxt(path, delimiter=",", skiprows=1).T
        y = motor.copy()
        for i in range(1, y.size):
            y[i] = min(max(y[i - 1], motor[i] - 0.5 * width_rad), motor[i] + 0.5 * width_rad)
        tip = 0.9 * np.sin(y) + planted.coloured(np.random.default_rng(k), t.size, 1e-3)
        np.savetxt(path, np.column_stack((t, motor, load, tip)), delimiter=",", header="t,motor,load,tip", comments="")
    return nominal, files


def test_a_python_function_is_a_nominal_model(tmp_path: Path) -> None:
    (effect,) = as_json(run(*lever(tmp_path, 0.02)), 0.0)["effects"]
    assert (effect["id"], effect["subsystem"]) == ("backlash", "lever")
    assert effect["parameters"]["width_rad"]["value"] == pytest.approx(0.02, rel=0.05)


def test_nothing_missing_behind_a_python_function(tmp_path: Path) -> None:
    result = run(*lever(tmp_path, 0.0))
    assert result.verdict == "nothing_missing"
    assert result.found.best.values == pytest.approx([0.9, 0.0], abs=0.01)


@pytest.mark.parametrize("function", ["lever", "lever:none", "no_such_module:f"])
def test_a_function_that_is_not_there_is_bad_input(tmp_path: Path, function: str) -> None:
    nominal, files = lever(tmp_path, 0.0)
    nominal.write_text(CALLABLE.replace("lever:reach", function))
    with pytest.raises(InputError, match=re.escape("callable.function")):
        run(nominal, files)


def test_what_the_report_says_to_switch_on_is_not_missed_again(tmp_path: Path) -> None:
    nominal, files = planted.transmission(tmp_path, "backlash", 1)
    option, table = switches(run(nominal, files))
    found = re.fullmatch(r"--effect '(backlash@cable:width_rad=[\d.e-]+)'", option)
    assert found and run(nominal, files, found[1]).verdict == "nothing_missing"
    nominal.write_text(nominal.read_text() + "\n" + table)
    again = run(nominal, files)
    assert again.verdict == "nothing_missing"
    assert again.found.best.values[-1] == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    "text", ["backlash", "backlash@nowhere:width_rad=1", "backlash@cable:width_m=1", "backlash@cable:width_rad=wide"]
)
def test_an_effect_that_cannot_be_is_bad_input(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="effect"):
        run(*planted.transmission(tmp_path, "none", 1), text)


def test_windows_are_in_the_files_own_time_and_of_all_recordings(tmp_path: Path) -> None:
    nominal, files = planted.transmission(tmp_path, "backlash", 1)
    for k, path in enumerate(files):
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        table[:, 0] += 1000.0 + 50.0 * k
        np.savetxt(path, table, delimiter=",", header="t,motor,load,tip", comments="")
    (place,) = as_json(run(nominal, files), 0.0)["located"]
    assert set(place["windows_by_recording"]) == {"r0.csv", "r1.csv", "r2.csv"}
    for k in range(3):
        spans = [s for s in place["windows_s"] if s[0] < 1040.0 + 50.0 * k and s[1] > 1000.0 + 50.0 * k]
        assert spans and all(1000.0 + 50.0 * k <= a < b <= 1040.0 + 50.0 * k for a, b in spans)


@pytest.mark.long
@pytest.mark.parametrize("axis", ["roll", "insertion"])
def test_an_axis_that_rests_hides_nothing_and_breaks_nothing(tmp_path: Path, axis: str) -> None:
    def still(q: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.zeros_like(q)

    def hold(columns: dict[str, np.ndarray], t: np.ndarray) -> None:
        columns[next(name for name in columns if name.startswith(f"handle_{axis}"))][:] = 0.0

    truth = rig_cases.Truth(columns=hold, **{axis: still})
    assert run(*rig_cases.write(tmp_path, truth, 1, duration_s=10.0)).verdict == "nothing_missing"


@pytest.mark.long
def test_a_noisy_force_channel_bends_no_parameter(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)

    def noisy(columns: dict[str, np.ndarray], t: np.ndarray) -> None:
        for axis in "xyz":
            columns[f"force_{axis}_N"] += rig_cases.coloured(rng, (1, t.size), 0.1, 0.3)[0]

    result = run(*rig_cases.write(tmp_path, rig_cases.Truth(columns=noisy), 0, duration_s=15.0))
    values = dict(zip([p.name for p in result.model.parameters], result.found.nominal.values, strict=True))
    assert values["bending_stiffness"] == pytest.approx(rig_cases.EI, rel=0.1)
    assert values["wall_stiffness"] == pytest.approx(1000.0, rel=0.1)
    assert result.verdict == "nothing_missing"


def test_a_force_that_drowns_in_noise_names_nothing(tmp_path: Path) -> None:
    drawn = noisy_force.rig(4711, 3)
    files = noisy_force.write(drawn, 0.1, tmp_path)
    result = noisy_force.judged(tmp_path, files)
    assert all(isinstance(segment, RigSegment) and segment.beyond is not None for segment in result.problem.segments)
    assert result.verdict == "nothing_missing"
    assert result.found.nominal.values[6] == pytest.approx(drawn.system.case.nominal[6], rel=0.3)
