"""Friction of the pull-wire: the spatial rod's loop, and its identification from a loop of the simulator's own friction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from host.cli.calibrate import calibrate
from host.identification.wire_loop import WireLoop, identify_wire_friction, predicted_bend
from host.mechanics.constitutive import FrictionalRod
from protocol.catheter import ConstitutiveParameters, load_catheter
from protocol.errors import InputError
from sim.effects import PlantedEffect
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig

STEEROCATH, BLAZER = load_catheter("steerocath_t"), load_catheter("blazer_prime_xp")
UP = np.linspace(0.0, 35.0, 36)
LOOP_per_m = np.concatenate([UP, UP[::-1][1:], UP[1:]])


def rod(friction: float) -> FrictionalRod:
    return FrictionalRod(replace(STEEROCATH, constitutive=ConstitutiveParameters(friction, 0.0)), 0.0, body_turning_rad=1.0)


def test_the_rod_without_friction_bends_as_the_tension_says_and_with_it_in_a_loop() -> None:
    assert STEEROCATH.cosserat is not None
    plain, rubbing = rod(0.0), rod(0.15)
    up, down = {}, {}
    for tension in (0.0, 1.0, 2.0, 3.0, 4.0):
        found, tensions = plain.step(tension)
        bend = tension * STEEROCATH.pull_wire_offset_m / STEEROCATH.cosserat.EI1 * STEEROCATH.distal_length_m
        assert np.allclose(tensions, tension) and found.converged
        assert 2.0 * np.arccos(min(abs(found.tip_quaternion_wxyz[0]), 1.0)) == pytest.approx(bend, abs=1e-6)
        up[tension] = float(np.mean(rubbing.step(tension)[1]))
    for tension in (3.0, 2.0, 1.0):
        down[tension] = float(np.mean(rubbing.step(tension)[1]))
    assert all(up[t] < t * np.exp(-0.15) * 1.001 and down[t] > up[t] for t in down)
    with pytest.raises(ValueError, match="constitutive"):
        FrictionalRod(STEEROCATH, 0.0)


def test_friction_and_gain_come_back_from_a_loop_with_noise() -> None:
    rng = np.random.default_rng(2)
    bend = predicted_bend(LOOP_per_m, BLAZER.distal_length_m, 0.08, 1.03) + 0.005 * rng.standard_normal(len(LOOP_per_m))
    found = identify_wire_friction(BLAZER, WireLoop.of(LOOP_per_m, bend))
    assert found.friction_ci95[0] < 0.08 < found.friction_ci95[1] and found.friction_ci95[1] - found.friction_ci95[0] < 0.01
    assert found.gain_ci95[0] < 1.03 < found.gain_ci95[1]
    assert found.rms_rad < 0.007 and found.rms_without_rad > 5.0 * found.rms_rad


def test_calibrate_halves_the_error_on_the_simulator_s_own_friction(tmp_path: Path) -> None:
    """The plant's friction is another law: it acts on the knob's angle, slack included."""
    effect = PlantedEffect("load_dependent_friction", "knob", {"coefficient": 0.05}, 0.0)
    plant = Plant(PlantConfig(tissue=TissueConfig(point_m=(0.0, 0.0, 1.0)), effects=(effect,)), 1)
    knob, rows = plant.config.knob, ["curvature_per_m,bend_rad"]
    gain = knob.curvature_at_stop_per_m / (knob.stop_rad - knob.slack_rad)
    for _ in range(600):
        plant.step(0.002, (0.12, 0.0, 0.0))
    for curvature in 0.7 * LOOP_per_m:  # less than half a turn
        for _ in range(40):
            plant.step(0.002, (0.12, 0.0, knob.slack_rad + curvature / gain))
        w, x, _, _ = plant.sensor_pose(0.0)[1]
        rows.append(f"{curvature},{2.0 * np.arctan2(x, w)}")
    path, out = tmp_path / "loop.csv", tmp_path / "mine.toml"
    path.write_text("\n".join(rows), encoding="utf-8")
    app = typer.Typer()
    app.command()(calibrate)
    asked = [
        str(path),
        "--catheter",
        "blazer_prime_xp",
        "--model",
        "wire",
        "--out",
        str(tmp_path),
        "--name",
        "mine",
        "--json",
    ]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0
    print(done.output)
    written = load_catheter(out)
    assert written.constitutive is not None and written.constitutive.friction_coefficient > 0.02
    columns = np.loadtxt(path, delimiter=",", skiprows=1).T
    found = identify_wire_friction(BLAZER, WireLoop.of(columns[0], columns[1]))
    assert found.rms_rad < 0.5 * found.rms_without_rad


def test_a_loop_that_does_not_come_back_is_refused() -> None:
    with pytest.raises(InputError, match="comes back"):
        WireLoop.of(UP, 0.1 * UP)
    with pytest.raises(InputError, match="samples"):
        WireLoop.of(UP[:5], UP[:5])
