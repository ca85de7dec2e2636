"""The demo's recordings under the nominal that they describe: planted effects are named, bad files are one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.cli.diagnose import diagnose
from host.diagnosis.live.recorded_rig import RecordedRig
from host.diagnosis.model.nominal import nominal_path, read_nominal
from host.diagnosis.model.rig_recording import knob_gain, rig_of, rig_rows, staleness
from host.run.demo import DemoSettings, run_lockstep
from protocol.errors import InputError

LATE = "rate_lag@pose_sensor"  # the simulated shaft gives way with a retardation of 4 ms, of which the twin knows nothing


def recorded(folder: Path, *effects: str, hold_s: float = 8.0) -> Path:
    settings = DemoSettings(board="native", seed=21, hold_s=hold_s, pace=0.0, directory=folder, effects=effects)
    return run_lockstep(settings).recording


def verdict_of(folder: Path, *files: Path) -> dict[str, Any]:
    diagnose([str(f) for f in files], "rig", out=folder, quiet=True)
    found: dict[str, Any] = json.loads((folder / "verdict.json").read_text())
    return found


def names(verdict: dict[str, Any]) -> list[str]:
    return [f"{e['id']}@{e['subsystem']}" for e in verdict["effects"]]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with nothing planted."""
    return recorded(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def of_plain(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the verdict on the recording without a planted effect."""
    return verdict_of(tmp_path_factory.mktemp("verdict"), plain)


def test_nothing_planted_gives_nothing_but_what_the_simulated_shaft_really_does(of_plain: dict[str, Any]) -> None:
    assert len(of_plain["effects"]) <= 1
    for effect, name in zip(of_plain["effects"], names(of_plain), strict=True):
        assert LATE in {name, *effect["indistinguishable_from"]}
        assert next(iter(effect["parameters"].values()))["value"] == pytest.approx(0.004, abs=0.0015)


def test_nothing_planted_leaves_the_parameters_what_they_are(of_plain: dict[str, Any]) -> None:
    fitted = of_plain["fit"]["nominal_parameters"]
    assert fitted["bending_stiffness_N_m2"]["value"] == pytest.approx(1.9e-4, rel=0.15)
    assert fitted["insertion_offset_m"]["value"] == pytest.approx(-0.089, abs=3e-4)


@pytest.mark.parametrize(
    ("planted", "name", "key", "value"),
    [
        pytest.param("latency@pose_sensor:delay_s=0.05", "latency@pose_sensor", "delay_s", 0.054, marks=pytest.mark.long),
        ("backlash@knob:width_rad=0.06", "backlash@knob", "width_rad", 0.06),
    ],
)
def test_a_planted_effect_is_named_first(tmp_path: Path, planted: str, name: str, key: str, value: float) -> None:
    verdict = verdict_of(tmp_path, recorded(tmp_path, planted))
    assert names(verdict)[0] == name
    assert verdict["effects"][0]["parameters"][key]["value"] == pytest.approx(value, rel=0.2)


def test_rows_are_frames_and_what_is_known_is_off_the_handle(plain: Path) -> None:
    rows, rig = rig_rows(plain), rig_of([plain])
    assert np.allclose(np.diff(rows["time_s"]), 1.0 / rig.tracker.rate_hz, rtol=0.05)
    assert {values.size for values in rows.values()} == {rows["time_s"].size}
    assert np.isfinite(rows["tip_x_m"]).mean() > 0.9 and np.isfinite(rows["force_z_N"]).mean() > 0.9
    assert np.max(rows["force_z_N"]) == pytest.approx(0.2, abs=0.05)
    bent = rows["tip_z_m"] > 0.024
    assert bent.any() and np.all(knob_gain(rig) * rows["handle_knob_rad"][bent] > 5.0)


def test_age_of_the_encoders_is_read_off_the_commands() -> None:
    t = np.arange(0.0, 5.0, 0.004)
    commands = np.array([0.01 * np.sin(3.0 * t), np.zeros_like(t), 0.3 * np.cos(2.0 * t)])
    late = np.array([0.01 * np.sin(3.0 * (t - 0.009)), np.zeros_like(t), 0.3 * np.cos(2.0 * (t - 0.009))])
    assert staleness(t, commands, late, 0.004) == pytest.approx(0.005, abs=2e-4)
    assert staleness(t, 0.0 * commands, 0.0 * late, 0.004) == 0.0


def test_force_is_no_output_of_a_wall_that_moves(plain: Path) -> None:
    spec = read_nominal(nominal_path("rig"))
    spec._files = [plain]
    model = RecordedRig(spec)
    assert not any(output.channel.startswith("force") for output in model.outputs)
    assert "contact" not in {port.name for port in model.ports} and "force_sensor" in {port.name for port in model.ports}


def test_what_is_no_recording_of_a_rig_is_bad_input(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("time_s,x\n0,1\n")
    for path in (table, tmp_path / "none.mcap"):
        with pytest.raises(InputError, match="recording"):
            diagnose([str(path)], "rig", quiet=True)
