"""Tip against tissue: the laws hold to the digit, contact comes and goes calmly, the demo's numbers are as stated."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.heart import HeartConfig
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

STILL = HeartConfig(beat_m=0.0, respiration_m=0.0)
NO_PLAY = VesselConfig(play_width_m=0.0)
KNOB = 0.517  # 14.5 1/m, the demo's bend
HOLD_M = 0.00548  # stage reading that presses 0.2 N on the wall at rest


def pressed(tissue: TissueConfig, heart: HeartConfig = STILL, stage_m: float = HOLD_M, steps: int = 2000) -> Plant:
    """The demo's catheter, brought to the wall and left there."""
    plant = Plant(PlantConfig(vessel=NO_PLAY, tissue=tissue, heart=heart, start_stage=(0.0, 0.0, KNOB)))
    for n in range(steps):
        plant.step(1e-3, (stage_m * min(1.0, n / 800), 0.0, KNOB))
    return plant


def test_force_is_the_springs_law_at_every_step_and_never_pulls() -> None:
    plant = pressed(TissueConfig(), HeartConfig())
    touching = 0
    for n in range(3000):
        plant.step(1e-3, (HOLD_M + 0.002 * np.sin(0.01 * n), 0.2 * np.sin(0.003 * n), KNOB))
        truth = plant.truth()
        assert plant.contact_force_N[2] == pytest.approx(1000.0 * max(0.0, truth["depth_m"]), abs=1e-12)
        assert truth["depth_m"] == pytest.approx(truth["tip_m"][2] - 0.025 + truth["heart_m"], abs=1e-12)
        touching += truth["depth_m"] > 0
    assert 500 < touching < 2950, "the case should make and break contact"


def test_stiffness_and_reserve_of_the_demo() -> None:
    plant, forces, insertions = pressed(TissueConfig(), stage_m=0.004), [], []
    for n in range(300):
        for _ in range(20):
            plant.step(1e-3, (0.004 + 1e-5 * n, 0.0, KNOB))
        forces.append(plant.contact_force_N[2])
        insertions.append(plant.truth()["insertion_m"])
    stiffness = np.gradient(np.array(forces), np.array(insertions))
    at = int(np.argmax(np.array(forces) >= 0.2))
    assert 60.0 < stiffness[at] < 150.0
    touching = (np.array(forces) > 0) & (np.arange(300) < int(np.argmax(np.array(forces) > 0.28)))
    assert max(forces) > 0.28 and np.all(stiffness[touching] > 30.0)


def test_a_still_catheter_feels_the_beat_by_a_tenth_of_a_newton() -> None:
    plant = pressed(TissueConfig(), HeartConfig(start_s=2.0))
    assert plant.contact_force_N[2] == pytest.approx(0.2, abs=0.01)
    forces = []
    for _ in range(6000):
        plant.step(1e-3, (HOLD_M, 0.0, KNOB))
        forces.append(plant.contact_force_N[2])
    assert 0.08 < np.std(forces) < 0.15 and max(forces) < 0.4


def test_touching_fast_on_a_stiff_wall_does_not_ring() -> None:
    plant = Plant(
        PlantConfig(
            vessel=NO_PLAY, tissue=TissueConfig(stiffness_N_per_m=20000.0), heart=STILL, start_stage=(0.0, 0.0, KNOB)
        )
    )
    forces = []
    for n in range(1500):
        plant.step(1e-3, (min(0.05 * n * 1e-3, HOLD_M), 0.0, KNOB))
        forces.append(float(plant.contact_force_N[2]))
    settled = np.array(forces[400:])
    assert np.abs(np.diff(settled)).max() < 1e-4 and settled[-1] > 0.1
    first = int(np.argmax(np.array(forces) > 0))
    assert np.all(np.array(forces[first:]) > 0), "no bouncing"


@pytest.mark.parametrize("tissue", [TissueConfig(exponent=1.5), TissueConfig(exponential_depth_m=2e-4)])
def test_nonlinear_tissue_stiffens_with_depth(tissue: TissueConfig) -> None:
    forces, depths = [], []
    for stage in (0.0045, 0.005, 0.0055):
        truth = pressed(tissue, stage_m=stage).truth()
        forces.append(truth["contact_force_N"][2])
        depths.append(truth["depth_m"])
    slopes = np.array(forces) / np.array(depths)
    assert slopes[0] < slopes[1] < slopes[2]


def test_hunt_crossley_and_relaxation_part_loading_from_unloading() -> None:
    for tissue in (
        TissueConfig(hunt_crossley_s_per_m=30.0),
        TissueConfig(viscosity_N_s_per_m=2.0),
        TissueConfig(relaxing_N_per_m=500.0, relaxation_s=0.3),
    ):
        plant = pressed(tissue, HeartConfig(respiration_m=0.0))
        work = 0.0
        last = plant.truth()["depth_m"]
        for _ in range(500):
            plant.step(1e-3, (HOLD_M, 0.0, KNOB))
            truth = plant.truth()
            work += truth["contact_force_N"][2] * (truth["depth_m"] - last)
            last = truth["depth_m"]
        assert work > 1e-7, tissue


def test_friction_stays_in_its_cone_and_holds_the_tip() -> None:
    free, held = (pressed(TissueConfig(friction=mu)) for mu in (0.0, 0.4))
    assert abs(held.sensor_pose(0.0)[0][1] - free.sensor_pose(0.0)[0][1]) > 2e-4
    for n in range(2000):
        held.step(1e-3, (HOLD_M, 0.5 * np.sin(0.004 * n), KNOB + 0.2 * np.sin(0.006 * n)))
        force = held.contact_force_N
        assert np.hypot(force[0], force[1]) <= 0.4 * force[2] + 1e-12


def test_torque_is_the_forces_moment_about_the_walls_point() -> None:
    plant = pressed(TissueConfig(friction=0.3))
    arm = plant.sensor_pose(0.0)[0] - np.array([0.0, 0.0, 0.025])
    assert plant.contact_torque_Nm == pytest.approx(np.cross(arm, plant.contact_force_N))


def test_regular_heart_is_two_sines() -> None:
    plant = Plant(PlantConfig(vessel=NO_PLAY))
    for n in range(1, 4001):
        plant.step(1e-3, (0.0, 0.0, 0.0))
        t = n * 1e-3
        assert plant.truth()["heart_m"] == pytest.approx(
            0.001 * np.sin(4 * np.pi * t) + 0.0004 * np.sin(0.66 * np.pi * t), abs=1e-9
        )


def test_irregular_heart_varies_from_beat_to_beat_by_seed_and_never_jumps() -> None:
    config = PlantConfig(vessel=NO_PLAY, heart=HeartConfig(irregularity=0.1, premature_share=0.2, respiration_m=0.0))
    tracks = []
    for seed in (1, 1, 2):
        plant, track = Plant(config, seed), []
        for _ in range(20000):
            plant.step(1e-3, (0.0, 0.0, 0.0))
            track.append(plant._parts.heart_state.displacement_m)
        tracks.append(np.array(track))
    assert np.array_equal(tracks[0], tracks[1]) and not np.array_equal(tracks[0], tracks[2])
    starts = np.flatnonzero((tracks[0][:-1] < 0) & (tracks[0][1:] >= 0))
    assert np.std(np.diff(starts)) > 30
    assert np.abs(np.diff(tracks[0])).max() < 4e-5


def test_bad_wall_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tissue\.normal"):
        Plant(PlantConfig(tissue=TissueConfig(normal=(0.0, 0.0, 0.0))))


STAGES = st.tuples(st.floats(-1e300, 1e300), st.floats(-1e300, 1e300), st.floats(-1e300, 1e300))
MODEST = st.tuples(st.floats(-0.02, 0.06), st.floats(-3, 3), st.floats(-1.6, 1.6))


@settings(max_examples=40)
@given(
    st.lists(st.one_of(STAGES, MODEST), min_size=1, max_size=12), st.sampled_from([1e-4, 1e-3, 0.01]), st.floats(0.0, 1.0)
)
def test_finite_for_any_finite_stages(targets: list[tuple[float, float, float]], dt_s: float, friction: float) -> None:
    plant = Plant(PlantConfig(tissue=TissueConfig(friction=friction, hunt_crossley_s_per_m=10.0)))
    for target in targets:
        for _ in range(15):
            plant.step(dt_s, target)
            position, quaternion = plant.sensor_pose(0.0)
            assert np.all(np.isfinite(position)) and np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-9)
            assert np.linalg.norm(position) < 0.27
            assert np.all(np.isfinite(plant.contact_force_N)) and plant.contact_force_N[2] >= 0.0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_refused_by_name_and_moves_nothing(bad: float) -> None:
    plant = Plant()
    for axis in range(3):
        stage = [0.0, 0.0, 0.0]
        stage[axis] = bad
        with pytest.raises(ValueError, match=rf"stage_position\[{axis}\]"):
            plant.step(1e-3, stage)
    with pytest.raises(ValueError, match="dt_s"):
        plant.step(bad, (0.0, 0.0, 0.0))
    assert plant.time_s == 0.0


def test_same_inputs_same_numbers() -> None:
    def track(seed: int) -> np.ndarray:
        plant = Plant(replace(PlantConfig(), heart=HeartConfig(irregularity=0.1)), seed)
        rows = []
        for n in range(1500):
            plant.step(1e-3, (0.008 * min(1.0, n / 500), 0.3 * np.sin(0.01 * n), 0.5))
            rows.append(np.r_[plant.sensor_pose(0.0)[0], plant.contact_force_N])
        return np.array(rows)

    assert np.array_equal(track(5), track(5))
    assert not np.array_equal(track(5), track(6))


def test_the_kernels_give_the_same_numbers_without_the_compiler() -> None:
    program = (
        "from sim.plant import Plant, PlantConfig\n"
        "from sim.effects import CATALOGUE, PlantedEffect\n"
        "some = [PlantedEffect(i, p) for p in CATALOGUE for i in CATALOGUE[p] if i not in ('saturation', 'missed_steps')]\n"
        "plant = Plant(PlantConfig(effects=tuple(some)), 4)\n"
        "for n in range(12):\n"
        "    plant.step(1e-3, (0.0006 * n, 0.1, 0.4))\n"
        "    pose, wrench = plant.measured_pose(0), plant.measured_wrench()\n"
        "print(*(f'{v:.9f}' for v in (*plant.sensor_pose(0.0)[0], *pose.position_m, *wrench[0])))\n"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"NUMBA_DISABLE_JIT": disable},
            text=True,
            capture_output=True,
            check=True,
        ).stdout
        for disable in ("0", "1")
    ]
    assert outputs[0] == outputs[1] != ""
