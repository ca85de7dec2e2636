"""Planted effects of shape, contact, sensors and base leave their marks on the whole plant."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects import CATALOGUE, PlantedEffect
from sim.heart import HeartConfig
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

STILL = HeartConfig(beat_m=0.0, respiration_m=0.0)
FAR = TissueConfig(point_m=(0.0, 0.0, 1.0))
KNOB, HOLD_M = 0.517, 0.00548


def plant_with(*effects: PlantedEffect, tissue: TissueConfig = FAR, heart: HeartConfig = STILL, seed: int = 0) -> Plant:
    """The demo's catheter without play, with effects."""
    return Plant(
        PlantConfig(
            vessel=VesselConfig(play_width_m=0.0), tissue=tissue, heart=heart, effects=effects, start_stage=(0.0, 0.0, KNOB)
        ),
        seed,
    )


def run(plant: Plant, seconds: float, insertion_m: float = 0.0, roll_rad: float = 0.0, knob_rad: float = KNOB) -> np.ndarray:
    """Hold the stages, moved over at most 0.3 s, and return the tip's last position."""
    start, goal = plant._stage.copy(), np.array([insertion_m, roll_rad, knob_rad])
    count = round(seconds * 1000)
    for n in range(count):
        plant.step(1e-3, start + (goal - start) * min(1.0, (n + 1) / min(300, count)))
    return plant.sensor_pose(0.0)[0]


def test_gravity_pulls_one_way_whatever_the_roll() -> None:
    sags = []
    for roll in (0.0, 2.0, 4.0):
        effect = PlantedEffect("gravity_load", "shape", {"weight_N_per_m": 0.2, "tip_weight_N": 0.01, "x": 1.0, "y": 0.0})
        sags.append(run(plant_with(effect), 1.0, roll_rad=roll) - run(plant_with(), 1.0, roll_rad=roll))
    assert all(sag[0] > 5e-5 for sag in sags)


def test_drag_follows_exposed_length_and_beats() -> None:
    swings = []
    for insertion in (0.0, 0.02):
        effect = PlantedEffect("flow_drag", "shape", {"frequency_Hz": 2.0})
        loaded, free = plant_with(effect), plant_with()
        run(loaded, 1.0, insertion), run(free, 1.0, insertion)
        track = []
        for _ in range(1000):
            loaded.step(1e-3, (insertion, 0.0, KNOB))
            free.step(1e-3, (insertion, 0.0, KNOB))
            track.append(loaded.sensor_pose(0.0)[0][1] - free.sensor_pose(0.0)[0][1])
        spectrum = np.abs(np.fft.rfft(track))
        assert int(np.argmax(spectrum[1:])) + 1 in (2, 4)
        swings.append(-np.mean(track))
    assert swings[1] > 5 * swings[0] > 0


def test_second_contact_sets_in_at_its_clearance_and_follows_its_spring() -> None:
    effect = PlantedEffect("second_contact", "shape", {"place_m": 0.012, "clearance_m": 0.0015, "stiffness_N_per_m": 200.0})
    touched, free = plant_with(effect), plant_with()
    assert np.allclose(run(touched, 1.0, knob_rad=0.3), run(free, 1.0, knob_rad=0.3), atol=1e-12)
    bent, alone = run(touched, 2.0, knob_rad=1.3), run(free, 2.0, knob_rad=1.3)
    assert np.linalg.norm(bent - alone) > 3e-4
    force = -float(touched.truth()["base_force_N"][1])
    joints = touched._parts.chain_state.joint[: touched._parts.chain_state.cells]
    lateral = np.interp(0.012, joints[::-1, 2], -joints[::-1, 1])
    assert abs(force) == pytest.approx(200.0 * (lateral - 0.0015), rel=1e-3)


def test_hardening_gives_less_than_the_linear_shaft() -> None:
    soft, hard = (
        plant_with(*effects, tissue=TissueConfig())
        for effects in ((), (PlantedEffect("nonlinear_stiffness", "shape", {"cubic_m2": 0.002}),))
    )
    for insertion in (0.0046, 0.0052):
        run(soft, 1.0, insertion), run(hard, 1.0, insertion)
    assert hard.contact_force_N[2] > soft.contact_force_N[2] * 1.02


def test_softening_lowers_the_force_of_a_held_catheter_over_time() -> None:
    plant, forces = plant_with(PlantedEffect("softening", "shape", {"rate_per_s": 0.02}), tissue=TissueConfig()), []
    for _ in range(5):
        run(plant, 2.0, 0.0048)
        forces.append(plant.contact_force_N[2])
    assert np.all(np.diff(forces) < 0)


def test_creep_lets_the_force_of_a_held_catheter_fall_and_level_off() -> None:
    plant, forces = (
        plant_with(PlantedEffect("creep_relaxation", "shape", {"time_constant_s": 1.0}), tissue=TissueConfig()),
        [],
    )
    for _ in range(6):
        run(plant, 1.0, 0.0050)
        forces.append(plant.contact_force_N[2])
    falls = -np.diff(forces)
    assert np.all(falls > 0) and falls[-1] < 0.2 * falls[0]


def test_plastic_set_stays_after_an_overload() -> None:
    plant = plant_with(PlantedEffect("plastic_set", "shape", {"yield_per_m": 6.0, "share": 0.4}), tissue=TissueConfig())
    before = run(plant, 1.0)
    assert np.allclose(before, run(plant_with(), 1.0), atol=1e-12)
    run(plant, 2.0, 0.012)
    assert np.linalg.norm(run(plant, 2.0) - before) > 2e-4


@pytest.mark.parametrize("name", ["coulomb_friction", "presliding_friction"])
def test_friction_in_the_shaft_keeps_it_from_coming_back(name: str) -> None:
    tips = {}
    for effects in ((), (PlantedEffect(name, "shape"),)):
        plant = plant_with(*effects)
        up = run(plant, 2.0, knob_rad=0.2), run(plant, 2.0, knob_rad=KNOB)
        down = run(plant, 2.0, knob_rad=0.8), run(plant, 2.0, knob_rad=KNOB)
        tips[len(effects)] = np.linalg.norm(down[1] - up[1])
    assert tips[0] < 1e-9 and tips[1] > 1e-4


def test_viscous_shaft_lags_behind_the_knob() -> None:
    slow, nominal = plant_with(PlantedEffect("viscous_friction", "shape", {"time_constant_s": 0.2})), plant_with()
    for plant in (slow, nominal):
        run(plant, 0.3, knob_rad=1.0)
    gap = np.linalg.norm(slow.sensor_pose(0.0)[0] - nominal.sensor_pose(0.0)[0])
    rest = np.linalg.norm(run(slow, 3.0, knob_rad=1.0) - run(nominal, 3.0, knob_rad=1.0))
    assert gap > 1e-3 and rest < 1e-6


def test_contact_effects_show_in_contact_only() -> None:
    for name in CATALOGUE["contact"]:
        effect = PlantedEffect(name, "contact", {"rate_per_s": 0.1} if name == "softening" else {})
        free, nominal = plant_with(effect, heart=HeartConfig()), plant_with(heart=HeartConfig())
        assert np.array_equal(run(free, 1.0), run(nominal, 1.0)), name
        differences = []
        touching, nominal = (plant_with(*e, tissue=TissueConfig(), heart=HeartConfig()) for e in ((effect,), ()))
        run(touching, 1.0, HOLD_M), run(nominal, 1.0, HOLD_M)
        for _ in range(1000):
            for plant in (touching, nominal):
                plant.step(1e-3, (HOLD_M, 0.0, KNOB))
            differences.append(np.linalg.norm(touching.contact_force_N - nominal.contact_force_N))
        assert np.max(differences) > 1e-3, name


def test_base_motion_moves_all_poses_together() -> None:
    moved, nominal = (
        plant_with(PlantedEffect("base_motion", "base", {"x_rad": 0.0, "z_m": 0.002, "rise_s": 0.2})),
        plant_with(),
    )
    run(moved, 1.0), run(nominal, 1.0)
    for tool in (0, 1):
        shift = moved.measured_pose(tool).position_m - nominal.measured_pose(tool).position_m
        assert shift == pytest.approx([0.0, 0.001, 0.002], abs=1e-7)


def measured(effect: PlantedEffect, frames: int = 400, still: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions of the tip as measured, in truth, and missing flags, at 40 Hz while the catheter turns."""
    plant = plant_with(effect, seed=3)
    seen, true, missing = [], [], []
    for frame in range(frames):
        for n in range(25):
            plant.step(1e-3, (0.0, 0.0 if still else 2.0 * np.sin(1e-3 * (25 * frame + n)), KNOB))
        sample = plant.measured_pose(0)
        seen.append(sample.position_m)
        true.append(plant.sensor_pose(0.0)[0])
        missing.append(sample.missing)
    return np.array(seen), np.array(true), np.array(missing)


def test_without_effects_the_sensors_hand_out_the_truth() -> None:
    plant = plant_with(tissue=TissueConfig(), heart=HeartConfig())
    run(plant, 2.0, HOLD_M)
    for tool, offset in ((0, 0.0), (1, 0.030)):
        sample, (position, quaternion) = plant.measured_pose(tool), plant.sensor_pose(offset)
        assert np.allclose(sample.position_m, position, atol=1e-15) and np.allclose(sample.quaternion_wxyz, quaternion)
    force, torque = plant.measured_wrench()
    assert np.array_equal(force, plant.contact_force_N) and np.allclose(torque, plant.contact_torque_Nm)


def test_constant_sensor_errors() -> None:
    seen, true, _ = measured(PlantedEffect("sensor_scale", "pose_sensor", {"gain": 1.04}))
    assert np.allclose(seen, 1.04 * true)
    seen, true, _ = measured(PlantedEffect("sensor_bias", "pose_sensor", {"x_m": 0.001, "z_m": -0.002}))
    assert np.allclose(seen - true, [0.001, 0.0, -0.002])
    seen, true, _ = measured(PlantedEffect("sensor_misalignment", "pose_sensor", {"y_rad": 0.05}))
    assert np.allclose(np.linalg.norm(seen, axis=1), np.linalg.norm(true, axis=1))
    assert np.allclose(seen[:, 0], true[:, 0] * np.cos(0.05) + true[:, 2] * np.sin(0.05))
    seen, true, _ = measured(PlantedEffect("rectified_sensor", "pose_sensor", {"axis": 0.0}))
    assert np.allclose(seen[:, 0], np.abs(true[:, 0])) and true[:, 0].min() < -1e-3


def test_distortion_depends_on_place_alone() -> None:
    seen, true, _ = measured(PlantedEffect("field_distortion", "pose_sensor"), frames=800)
    error = seen - true
    assert np.ptp(error[:, 0]) > 1e-5
    nearest = np.array([np.argmin(np.linalg.norm(true[:251] - true[i], axis=1)) for i in range(251, 503)])
    close = np.linalg.norm(true[nearest] - true[251:503], axis=1) < 5e-5
    assert close.sum() > 50 and np.abs(error[nearest] - error[251:503])[close].max() < 1e-5


def test_late_sensors_show_the_past() -> None:
    seen, true, _ = measured(PlantedEffect("latency", "pose_sensor", {"delay_s": 0.05}))
    assert np.allclose(seen[10:], true[8:-2], atol=1e-9)
    seen, true, _ = measured(PlantedEffect("clock_drift", "pose_sensor", {"rate": 0.02}))
    late = (true - seen)[:, 0] / np.gradient(true[:, 0], 0.025)
    fast = np.abs(np.gradient(true[:, 0], 0.025)) > 0.7 * np.abs(np.gradient(true[:, 0], 0.025)).max()
    slope = np.polyfit(np.arange(400)[fast] * 0.025, late[fast], 1)[0]
    assert slope == pytest.approx(0.02, rel=0.1)


def test_drift_grows_without_motion() -> None:
    seen, true, _ = measured(PlantedEffect("sensor_drift", "pose_sensor", {"x_m_per_s": 1e-4}), still=True)
    error = (seen - true)[:, 0]
    assert np.all(np.diff(error) > 0) and error[-1] == pytest.approx(120 * 1e-4 * (1 - np.exp(-10 / 120)), rel=1e-6)


def test_quantized_dropped_and_wild_samples() -> None:
    seen, _, _ = measured(PlantedEffect("quantization", "pose_sensor", {"step_m": 0.0005}))
    assert np.allclose(seen / 0.0005, np.round(seen / 0.0005))
    seen, true, missing = measured(PlantedEffect("dropout", "pose_sensor", {"share": 0.2, "burst": 4.0}), frames=3000)
    assert missing.mean() == pytest.approx(0.2, abs=0.05)
    assert np.allclose(seen[~missing], true[~missing], atol=1e-15)
    assert np.array_equal(seen[1:][missing[1:]], seen[:-1][missing[1:]])
    seen, true, _ = measured(PlantedEffect("outlier", "pose_sensor", {"share": 0.05}), frames=2000)
    wild = np.linalg.norm(seen - true, axis=1) > 1e-6
    assert wild.mean() == pytest.approx(0.05, abs=0.02)


def test_every_effect_of_the_force_sensor_changes_the_reading_and_nothing_else() -> None:
    for name in CATALOGUE["force_sensor"]:
        plant, nominal = (
            plant_with(*e, tissue=TissueConfig(), heart=HeartConfig())
            for e in ((PlantedEffect(name, "force_sensor", {"axis": 2.0} if name == "periodic_disturbance" else {}),), ())
        )
        differences = []
        for n in range(3000):
            for p in (plant, nominal):
                p.step(1e-3, (HOLD_M * 1.1 * min(1.0, n / 800), 0.0, KNOB))
            if n % 5 == 0:
                differences.append(np.abs(plant.measured_wrench()[0] - nominal.measured_wrench()[0]).max())
        assert np.array_equal(plant.contact_force_N, nominal.contact_force_N), name
        assert np.all(np.isfinite(differences))
        if name != "rectified_sensor":
            assert np.max(differences) > 1e-3, name


@pytest.mark.parametrize("port", list(CATALOGUE))
def test_every_effect_at_every_port_stays_finite_and_repeats(port: str) -> None:
    for name in CATALOGUE[port]:
        ends = []
        for _ in range(2):
            plant = plant_with(PlantedEffect(name, port, start_s=0.2), tissue=TissueConfig(), heart=HeartConfig(), seed=2)
            for n in range(600):
                plant.step(1e-3, (0.012 * np.sin(0.008 * n), 2.0 * np.sin(0.011 * n), 1.5 * np.sin(0.007 * n)))
            ends.append(np.r_[plant.sensor_pose(0.0)[0], plant.contact_force_N, plant.measured_pose(1).position_m])
        assert np.all(np.isfinite(ends[0])) and np.array_equal(ends[0], ends[1]), name


def test_truth_lists_what_was_planted() -> None:
    label = plant_with(PlantedEffect("backlash", "knob", {"width_rad": 0.1}, start_s=2.0)).truth()["effects"]
    assert label == [{"id": "backlash", "subsystem": "knob", "start_s": 2.0, "parameters": {"width_rad": 0.1}}]
