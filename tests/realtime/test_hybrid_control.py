"""Position and force control closed over the simulated plant: hold, touch, reversals, frames, any loop rate."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocol.enums import CommandKind, Phase
from protocol.rig_file import Rig, parse_rig
from realtime.control import backlash, constraint_frame, force_predictor, free_tip, hybrid, inverse_kinematics
from realtime.control.configure import tick_parameters
from realtime.control.records import (
    BACKLASH_STATE,
    FORCE_PREDICTOR_STATE,
    FORCE_SOURCE_STATE,
    HISTORY,
    HYBRID_STATE,
    new,
)
from realtime.core.intake import rotation
from sim.heart import HeartConfig
from sim.ideal_rig import IdealRig, IdealTrace
from sim.plant import PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

WALL_m = np.array((0.0, -0.0107, 0.025))
WANTED_N = 0.2
STILL = HeartConfig(beat_m=0.0, respiration_m=0.0)


def changed(rig: Rig, section: str = "control", **values: object) -> Rig:
    data = rig.effective()
    data[section] = {**data[section], **values}
    return parse_rig(data)


def bench(rig: Rig, heart: HeartConfig, seed: int = 0, normal: tuple = (0.0, 0.0, -1.0)) -> IdealRig:
    """The tip 3 mm before the wall, the play taken up forward."""
    out, transmission = np.zeros(3), rig.transmission
    out[:] = inverse_kinematics.apply(tick_parameters(rig)[0].kinematics, WALL_m - (0.0, 0.0, 0.003), 0.0)
    handle = (out[0] - transmission.insertion_at_home_m) / transmission.insertion_slope + 0.5 * 0.0031
    return IdealRig(
        rig,
        PlantConfig(
            start_stage=(float(handle), 0.0, float(out[2])),
            vessel=VesselConfig(start_in_play=1.0),
            heart=heart,
            tissue=TissueConfig(point_m=tuple(WALL_m), normal=normal),
        ),
        seed,
    )  # type: ignore[arg-type]


def pressed(rig: Rig, heart: HeartConfig, seconds: float = 10.0, seed: int = 0) -> IdealTrace:
    return bench(rig, heart, seed).press(WANTED_N, WALL_m, seconds).since_contact()


def rms_N(trace: IdealTrace, after_s: float = 4.0) -> float:
    kept = trace.force_N[trace.time_s > after_s]
    assert kept.size > 1000
    return float(np.sqrt(np.mean((kept - WANTED_N) ** 2)))


def still_catheter_N(rig: Rig) -> float:
    """RMS force about its mean with the stages held still in contact."""
    run = bench(rig, HeartConfig())
    run.press(WANTED_N, WALL_m, 3.0)
    run._command(CommandKind.HOLD)
    return float(np.std(run.run(6.0).force_N))


def test_force_on_a_beating_wall_against_thesis_and_still_catheter(rig: Rig) -> None:
    ours = pressed(rig, HeartConfig())
    assert np.all(ours.phase == Phase.CONTACT) and np.min(ours.force_N) > 0.0
    assert rms_N(ours) < 0.25 * still_catheter_N(rig)
    assert rms_N(ours) < 0.5 * rms_N(pressed(changed(rig, law="thesis"), HeartConfig()))
    assert np.mean(ours.force_N[ours.time_s > 4.0]) == pytest.approx(WANTED_N, abs=0.005)


def test_an_irregular_beat_never_breaks_the_touch(rig: Rig) -> None:
    trace = pressed(rig, HeartConfig(irregularity=0.1, premature_share=0.05), 12.0)
    assert np.min(trace.force_N) > 0.0 and rms_N(trace) < 0.02


@pytest.mark.parametrize("heart", [STILL, HeartConfig()], ids=["still", "beating"])
def test_touching_is_gentle(rig: Rig, heart: HeartConfig) -> None:
    trace = pressed(rig, heart, 4.0)
    assert np.max(trace.force_N) < WANTED_N + 0.05


@pytest.mark.parametrize("play_m", [0.0025, 0.0037])
def test_a_play_known_to_06_mm_is_enough(rig: Rig, play_m: float) -> None:
    trace = pressed(changed(rig, "transmission", insertion_backlash_m=play_m), HeartConfig(), 12.0)
    assert np.min(trace.force_N) > 0.0 and rms_N(trace, 6.0) < 0.25 * 0.078


@pytest.mark.parametrize("loop_hz", [500, 2000])
def test_gains_hold_at_any_loop_rate(rig: Rig, loop_hz: int) -> None:
    trace = pressed(changed(rig, loop_hz=loop_hz), HeartConfig(), 8.0)
    assert np.min(trace.force_N) > 0.0 and rms_N(trace) < 0.01


def test_changes_of_phase_have_no_bump(rig: Rig) -> None:
    """Through approach, touch, hold and release the stages stay within their limits, and the force does not kick."""
    run = bench(rig, HeartConfig())
    stages = [run.press(WANTED_N, WALL_m, 5.0).stage]
    run._command(CommandKind.HOLD)
    stages.append(run.run(0.5).stage)
    after = run.press(WANTED_N, WALL_m, 1.0)
    speed = np.diff(np.concatenate([*stages, after.stage]), axis=0) * 1000
    limit = run.params[0].stage
    assert np.all(np.abs(speed) <= limit.max_speed * (1 + 1e-3) + 1e3 / limit.steps_per_unit)
    assert np.all(np.abs(np.diff(speed, axis=0)) * 1000 <= limit.max_accel + 4e6 / limit.steps_per_unit)
    assert np.max(after.force_N) < WANTED_N + 0.15 and after.phase[-1] == Phase.CONTACT


def test_the_wall_s_normal_is_learned_from_the_force(rig: Rig) -> None:
    tilt = np.radians(10.0)
    run = bench(rig, STILL, normal=(0.0, float(np.sin(tilt)), float(-np.cos(tilt))))
    run.inputs[0].command.normal[:] = (0.0, 0.0, -1.0)
    run.press(0.15, WALL_m, 8.0)
    learned = run.state[0].normal
    assert run.outputs[0].phase == Phase.CONTACT
    assert np.degrees(np.arccos(learned @ (0.0, np.sin(tilt), -np.cos(tilt)))) < 2.0


def test_positions_are_reached_without_overshoot(rig: Rig) -> None:
    run = bench(rig, STILL)
    start = WALL_m - (0.0, 0.0, 0.003)
    for goal in (start + (0.004, 0.002, -0.001), start + (-0.005, -0.001, 0.0015)):
        trace = run.go(goal, 2.0)
        way = goal - trace.tip_m[0]
        assert np.max((trace.tip_m - goal) @ way) / np.linalg.norm(way) < 1e-3
        assert np.linalg.norm(trace.tip_m[-1] - goal) < 0.5e-3


def test_the_handle_starts_across_before_the_body_has_to_turn(rig: Rig) -> None:
    config, state = tick_parameters(changed(rig, play_caution_m=0.0))[0].backlash, new(BACKLASH_STATE)[0]
    backlash.start(config, state, 0.0)
    turned_s = None
    for k in range(500):
        t = 1e-3 * k
        wanted, at_crossing, after_crossing = (0.001 * np.sin(4 * np.pi * (t + ahead)) for ahead in (0.0, 0.065, 0.125))
        state.body_m = max(state.body_m, wanted)
        handle = backlash.apply_ahead(config, state, wanted, at_crossing, after_crossing, 0.0001)
        if turned_s is None and state.direction < 0:
            turned_s = t
            assert handle - wanted == pytest.approx(-config.width_m / 2)
    assert turned_s == pytest.approx(0.125 - 0.0325, abs=0.003)


def test_small_ripple_is_not_worth_a_crossing(rig: Rig) -> None:
    config, state = tick_parameters(changed(rig, play_caution_m=0.0))[0].backlash, new(BACKLASH_STATE)[0]
    backlash.start(config, state, 0.0)
    for k in range(2000):
        wanted, at_crossing, after_crossing = (
            0.00004 * np.sin(4 * np.pi * (1e-3 * k + ahead)) for ahead in (0.0, 0.065, 0.125)
        )
        state.body_m = max(state.body_m, wanted)
        backlash.apply_ahead(config, state, wanted, at_crossing, after_crossing, 0.0001)
    assert state.direction == 1.0


def test_estimated_body_is_the_play_operator_and_the_change_of_width_is_bounded(rig: Rig) -> None:
    config, state = tick_parameters(changed(rig, play_caution_m=0.0))[0].backlash, new(BACKLASH_STATE)[0]
    backlash.start(config, state, 0.0)
    body = [backlash.follow(config, state, h) for h in (0.00155, 0.00355, 0.00155, -0.00155, -0.00255)]
    assert body == pytest.approx([0.0, 0.002, 0.002, 0.0, -0.001])
    assert state.flank == -1.0
    assert backlash.narrow(config, state, 0.0004) == pytest.approx(0.0004)
    assert backlash.narrow(config, state, 1.0) == pytest.approx(0.0006)


@given(insertion=st.floats(-0.09, 0.05), bend=st.floats(-2.1, 2.1), roll=st.floats(-3, 3))
def test_the_free_tip_undoes_the_inverse_kinematics(rig: Rig, insertion: float, bend: float, roll: float) -> None:
    config, tip, back = tick_parameters(rig)[0].kinematics, np.zeros(3), np.zeros(3)
    curvature = bend / min(config.distal_length_m, config.distal_length_m + insertion)
    assume(abs(curvature) < 44 and abs(bend) > 0.05)
    joint = np.array([insertion, roll, inverse_kinematics.knob_of_curvature(config, curvature)])
    tip[:] = free_tip.apply(config, joint)
    back[:] = inverse_kinematics.apply(config, tip, roll)
    assert back == pytest.approx(joint, abs=1e-6)


def test_past_joints_are_interpolated_and_run_out() -> None:
    ring = new(HISTORY)[0]
    assert free_tip.joint_at(ring, 5)[1] == 0.0
    for k in range(1, 400):
        free_tip.remember(ring, 1_000_000 * k, np.array([1.0, 2.0, 3.0]) * k, 1.0 if k < 300 else -1.0)
    joint, flank = free_tip.joint_at(ring, 350_250_000)
    assert flank == -1.0 and joint == pytest.approx(np.array([1.0, 2.0, 3.0]) * 350.25)
    assert free_tip.joint_at(ring, 290_000_000)[1] == 1.0
    assert free_tip.joint_at(ring, 100_000_000)[1] == 0.0


vector = st.tuples(*[st.floats(-5, 5)] * 3).map(np.array)
unit = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


@given(quaternion=unit, value=vector)
def test_forces_turn_with_the_measured_pose(quaternion: np.ndarray, value: np.ndarray) -> None:
    out = np.zeros(3)
    constraint_frame.to_base(quaternion, value, out)
    assert out == pytest.approx(rotation(quaternion) @ value, abs=1e-9)
    assert np.linalg.norm(out) == pytest.approx(np.linalg.norm(value), abs=1e-9)


@given(force=vector, share=st.floats(0, 1))
def test_a_learned_normal_is_unit_and_near_the_commanded_one(force: np.ndarray, share: float) -> None:
    commanded = np.array([0.0, 0.0, -1.0])
    normal = commanded.copy()
    for _ in range(20):
        constraint_frame.follow_force(normal, commanded, force, share)
    assert np.linalg.norm(normal) == pytest.approx(1.0) and normal @ commanded > 0.93


@pytest.mark.parametrize("form", ["pi", "incremental"])
@pytest.mark.parametrize("added_to", ["desired", "tip"])
@given(tip=vector, target=vector, force=st.floats(-1, 1))
def test_the_force_loop_acts_along_the_normal_and_the_position_loop_across(
    rig: Rig, form: str, added_to: str, tip: np.ndarray, target: np.ndarray, force: float
) -> None:
    """Across the normal only the position error. Along it the force loop: alone, or added to the desired position."""
    thesis = changed(rig, law="thesis", form=form, force_added_to=added_to)
    config, normal = tick_parameters(thesis)[0].hybrid, np.array([0.0, 0.6, -0.8])
    across = np.eye(3) - np.outer(normal, normal)
    aim = hybrid.Aim(target, normal, WANTED_N, True)
    out = np.array(hybrid.tip_error(config, new(HYBRID_STATE)[0], tip, aim, force, 1e-3))
    assert across @ out == pytest.approx(across @ (target - tip), abs=1e-9)
    error = WANTED_N - force
    off_m = (target - tip) @ normal if added_to == "desired" else 0.0
    assert off_m - out @ normal == pytest.approx(
        config.force_gain_m_per_N * error + config.force_integral_m_per_N_s * 1e-3 * error, abs=1e-9
    )


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_pi_form_holds_the_force_with_the_gains_of_the_experiments(rig: Rig, factor: float) -> None:
    """(7.6) at 25 ms, K_ip halved and doubled: Fig. 7.24's gains all hold 0.1 N."""
    gains = {"law": "thesis", "form": "pi", "pi_position_integral_per_s": 0.24 * factor}
    trace = bench(changed(rig, **gains), STILL).press(0.1, WALL_m, 14.0).since_contact()
    late = trace.force_N[trace.time_s > 8.0]
    assert abs(late.mean() - 0.1) < 3e-3 and late.std() < 7e-3


def test_the_pi_form_needs_the_force_integral_where_the_desired_position_is_off_the_wall(rig: Rig) -> None:
    """Fig. 7.12: the steady error falls with K_if. The desired position is 3 mm in front of the wall."""
    error_N = []
    for factor in (0.0, 1.0):
        thesis = changed(rig, law="thesis", form="pi", pi_force_integral_m_per_N_s=0.12 * factor)
        trace = bench(thesis, STILL).press(0.1, WALL_m - (0.0, 0.0, 0.003), 18.0).since_contact()
        error_N.append(0.1 - float(trace.force_N[trace.time_s > 12.0].mean()))
    assert error_N[0] > 0.02 and abs(error_N[1]) < 1e-3


def test_the_incremental_form_from_the_desired_position_needs_ten_times_the_force_integral(rig: Rig) -> None:
    """Fig. 7.12 in the other reading: without K_if the force gain alone carries the 3 mm.

    The integral is limited (0.5 N s), so K_if of the rig file carries 1.5 of the 3 mm.
    """
    error_N = []
    for factor in (0.0, 1.0, 10.0):
        gains = {"force_gain_m_per_N": 0.03, "force_integral_m_per_N_s": 0.003 * factor}
        thesis = changed(rig, law="thesis", form="incremental", force_added_to="desired", **gains)
        trace = bench(thesis, STILL).press(0.1, WALL_m - (0.0, 0.0, 0.003), 18.0).since_contact()
        error_N.append(0.1 - float(trace.force_N[trace.time_s > 12.0].mean()))
    assert error_N[0] > error_N[1] + 0.01 and error_N[1] > 0.01 and abs(error_N[2]) < 2e-3


def test_the_thesis_law_acts_on_a_predicted_force(rig: Rig) -> None:
    """A force that rises steadily, read at 40 Hz, 25 ms late: a tenth of the error of holding the last reading."""
    config, state = tick_parameters(changed(rig, law="thesis"))[0].force_predictor, new(FORCE_PREDICTOR_STATE)[0]
    reading, misses, held = new(FORCE_SOURCE_STATE)[0], [], []
    rate_N_per_s = 0.5
    for now_ms in range(1000):
        if now_ms % 25 == 0:
            reading.stamp_ns = (now_ms - 25) * 1_000_000
            reading.value_N, reading.spread_N2 = rate_N_per_s * (now_ms - 25) * 1e-3, 0.003**2
            force_predictor.apply(config, state, reading)
        if now_ms > 300:
            true_N = rate_N_per_s * now_ms * 1e-3
            misses.append(force_predictor.predict(state, now_ms * 1_000_000) - true_N)
            held.append(reading.value_N - true_N)
    assert np.abs(misses).max() < 0.1 * np.abs(held).mean()


def test_a_contact_elsewhere_softer_is_held_too(rig: Rig) -> None:
    """Nothing of the simulator's stiffness is built in: a wall of 300 N/m instead of 1000."""
    run = bench(rig, HeartConfig())
    softer = replace(run.plant.config, tissue=replace(run.plant.config.tissue, stiffness_N_per_m=300.0))
    trace = IdealRig(rig, softer).press(WANTED_N, WALL_m, 10.0).since_contact()
    assert np.min(trace.force_N) > 0.0 and rms_N(trace) < 0.01


@pytest.mark.parametrize("start_in_play", [-1.0, 0.0, 1.0])
def test_in_free_space_the_insertion_that_forces_are_told_from_is_found(rig: Rig, start_in_play: float) -> None:
    """Where the body stands in its play is not known at arming, and up to the whole play wrong after the first way out."""
    plant = PlantConfig(
        start_stage=(0.045, 0.0, 0.9),
        vessel=VesselConfig(start_in_play=start_in_play),
        tissue=TissueConfig(point_m=(0.0, 0.0, 1.0)),
        heart=STILL,
    )
    run = IdealRig(rig, plant, 1)
    tip = run.plant.sensor_pose(0.0)[0]
    run.go(tip + (0.0, 0.0, 0.012), 4.0)
    truth_m = float(run.plant.truth()["insertion_m"])
    assert run.outputs[0].joint[0] == pytest.approx(truth_m, abs=3e-4)
    if start_in_play < 0.0:
        assert run.state[0].predicted_joint[0] > truth_m + 2e-3
