"""Handle to catheter: play and windup of the vessel, dead zones of the knob, stages and encoders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim import vessel
from sim.effects import PlantedEffect
from sim.plant import Plant, PlantConfig
from sim.stages import SimulatedStages, StagesConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

FREE = PlantConfig(tissue=TissueConfig(point_m=(0.0, 0.0, 1.0)))


def sweep(
    axis: int, amplitude: float, rate_rad_per_s: float, config: PlantConfig = FREE, dt_s: float = 1e-3
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Input and truths over the second of two sine periods on one axis."""
    plant, stage, inputs = Plant(config), np.zeros(3), []
    truths: dict[str, list[float]] = {"insertion_m": [], "roll_rad": [], "curvature_per_m": []}
    steps = int(4 * np.pi / rate_rad_per_s / dt_s)
    for n in range(steps):
        stage[axis] = amplitude * np.sin(rate_rad_per_s * n * dt_s)
        plant.step(dt_s, stage)
        if n > steps // 2 and n % 5 == 0:
            truth = plant.truth()
            inputs.append(stage[axis])
            for name, values in truths.items():
                values.append(truth[name])
    return np.array(inputs), {name: np.array(values) for name, values in truths.items()}


@pytest.mark.parametrize("amplitude", [0.0075, 0.010])
@pytest.mark.parametrize("rate", [0.5, 1.5, 5.0])
def test_insertion_play_is_as_wide_as_stated_at_any_rate_and_amplitude(amplitude: float, rate: float) -> None:
    handle, out = sweep(0, amplitude, rate)
    lost = handle - (out["insertion_m"] - VesselConfig().home_insertion_m)
    assert lost.max() - lost.min() == pytest.approx(0.0031, abs=2e-5)
    assert np.ptp(out["insertion_m"]) == pytest.approx(2 * amplitude - 0.0031, abs=2e-5)


def test_play_traces_the_same_loop_slow_and_fast() -> None:
    loops = []
    for rate in (0.5, 1.0, 4.0):
        handle, out = sweep(0, 0.008, rate)
        rising = np.gradient(handle) > 0
        order = np.argsort(handle[rising])
        loops.append(np.interp(np.linspace(-0.007, 0.007, 50), handle[rising][order], out["insertion_m"][rising][order]))
    assert np.abs(np.array(loops) - loops[0]).max() < 3e-5


def test_the_vessel_holds_the_body_against_less_than_its_friction_only() -> None:
    config = VesselConfig()
    p, s = vessel.parameters(config), vessel.start(config, 0.0, 0.0)
    for force, holds in ((-0.5, True), (-0.95, True), (-1.5, False)):
        before = float(s.body_m)
        for _ in range(1000):
            vessel.push(p, s, 0.0, force, 5e-4)
        assert (abs(s.body_m - before) < 1e-9) == holds, force
    assert s.body_m == pytest.approx(config.home_insertion_m - 0.00155, abs=1e-4), "pushed back to the end of the play"


@pytest.mark.parametrize("rate", [0.5, 1.5])
def test_roll_arrives_with_its_slope_and_without_play(rate: float) -> None:
    handle, out = sweep(1, np.radians(40.0), rate)
    slope = float(handle @ out["roll_rad"] / (handle @ handle))
    assert slope == pytest.approx(0.48, abs=1e-3)
    assert np.abs(out["roll_rad"] - slope * handle).max() < 0.48 * 0.004 * np.radians(40.0) * rate


def test_a_side_force_winds_the_shaft_back() -> None:
    wall = TissueConfig(point_m=(0.0005, 0.0, 0.0), normal=(1.0, 0.0, 0.0))
    plant = Plant(replace(FREE, tissue=wall, heart=replace(FREE.heart, beat_m=0.0, respiration_m=0.0)))
    for n in range(3000):
        plant.step(1e-3, (0.008, 0.0, min(0.7, 1e-3 * n)))
    truth = plant.truth()
    torque = float(truth["base_moment_Nm"][2])
    assert abs(torque) > 1e-7
    assert truth["roll_rad"] == pytest.approx(torque / (6e-4 / 0.48), rel=1e-3)


def test_dead_zones_of_the_knob_lie_where_stated() -> None:
    knob, out = sweep(2, np.radians(90.0), 0.5)
    curvature, degrees = out["curvature_per_m"], np.degrees(knob)
    assert np.abs(degrees[np.abs(curvature) < 1e-9]).max() == pytest.approx(4.0, abs=0.3)
    assert np.abs(degrees[np.abs(curvature) > 45.0 - 1e-9]).min() == pytest.approx(84.0, abs=0.3)
    assert curvature.max() == pytest.approx(45.0) and curvature.min() == pytest.approx(-45.0)


def test_changeover_holds_the_curvature_after_a_stop_and_only_there() -> None:
    config = replace(FREE, knob=replace(FREE.knob, changeover_rad=np.radians(5.0)))
    knob, out = sweep(2, np.radians(88.0), 0.5, config)
    opening = (np.gradient(knob) > 0) & (knob > 0)
    closing = (np.gradient(knob) < 0) & (knob > 0)

    def at(mask: np.ndarray, degrees: float) -> float:
        order = np.argsort(knob[mask])
        return float(np.interp(np.radians(degrees), knob[mask][order], out["curvature_per_m"][mask][order]))

    assert at(closing, 80.0) > at(opening, 80.0) + 1.0
    assert at(closing, 40.0) == pytest.approx(at(opening, 40.0), abs=0.05)


def test_stage_positions_are_edges_over_steps_per_unit() -> None:
    stages = SimulatedStages()
    for _ in range(100):
        position = stages.advance(1e-3, [0] * 16 + [1, 2, 2], [1] * 16 + [-1, 1, 1])
    assert position == pytest.approx([1600 / 320000, -100 * 2 * np.pi / 12800, 200 * 2 * np.pi / 12800])
    assert stages.encoder_counts.tolist() == stages.step_counts.tolist() == [1600, -100, 200]


def test_screw_error_repeats_every_turn_and_hides_from_the_encoder() -> None:
    stages = SimulatedStages(StagesConfig(screw_error_unit=(2e-5, 0.0, 0.0)))
    errors = []
    for _ in range(1280):
        position = stages.advance(1e-3, [0], [1])
        errors.append(position[0] - stages.encoder_counts[0] / 320000)
    assert max(errors) == pytest.approx(2e-5, rel=1e-3)
    assert errors[:640] == pytest.approx(errors[640:], abs=1e-9)


def test_a_heavy_rotor_lags_and_rings_then_arrives() -> None:
    stages = SimulatedStages(StagesConfig(rotor_Hz=(40.0, 0.0, 0.0)))
    track = [stages.advance(1e-3, [0] * (16 if n < 50 else 0), [1] * (16 if n < 50 else 0))[0] for n in range(400)]
    assert track[10] < 11 * 16 / 320000 - 1e-5
    assert max(track) > 800 / 320000 + 1e-6
    assert track[-1] == pytest.approx(800 / 320000, abs=1e-9)


def gaps_of(stages: SimulatedStages, slices: int, edges: list[int]) -> list[float]:
    """Steps that the insertion rotor is behind its field, after each of so many milliseconds with these edges."""
    gaps = []
    for _ in range(slices):
        stages.advance(1e-3, [0] * len(edges), edges)
        gaps.append(float((stages.step_counts - stages.encoder_counts)[0]))
    return gaps


def test_a_jammed_rotor_stands_until_its_time_or_its_steps_are_over_and_loses_what_is_commanded_only() -> None:
    stages = SimulatedStages()
    stages.jam(0, 1000.0, 0.05)
    assert gaps_of(stages, 20, []) == [0.0] * 20
    assert gaps_of(stages, 20, [1, 1]) == [2.0 * k for k in range(1, 21)]
    assert gaps_of(stages, 5, [-1]) == [39.0, 38.0, 37.0, 36.0, 35.0]
    assert set(gaps_of(stages, 100, [1, 1])[10:]) == {45.0} and stages.lost_steps.tolist() == [45.0, 0.0, 0.0]
    stages.jam(0, 7.0, 10.0)
    assert gaps_of(stages, 6, [-1, -1]) == [43.0, 41.0, 39.0, 38.0, 38.0, 38.0]


@pytest.mark.parametrize("steps", [-100.0, 100.0])
def test_a_slipping_rotor_falls_back_at_its_speed_and_no_further(steps: float) -> None:
    stages = SimulatedStages()
    stages.slip(0, steps, 1.0, 0.025)
    gaps = gaps_of(stages, 30, [1])
    assert gaps[:3] == [np.sign(steps) * k * 8.0 for k in (1, 2, 3)] and gaps[-1] == steps
    stages.slip(0, steps, 0.005, 0.025)
    assert gaps_of(stages, 30, [1])[-1] == pytest.approx(steps + np.sign(steps) * 40.0, abs=8.0)


def test_missed_steps_part_command_and_encoder_for_good() -> None:
    stages = SimulatedStages(effects=(PlantedEffect("missed_steps", "insertion", {"steps": 37.0}, start_s=0.05),))
    gaps = []
    for _ in range(200):
        stages.advance(1e-3, [0, 0], [1, 1])
        gaps.append(int((stages.step_counts - stages.encoder_counts)[0]))
    assert set(gaps[:48]) == {0} and set(gaps[51:]) == {37}
