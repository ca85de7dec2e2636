"""Backlash inverse, inverse kinematics, predictor, stage limiter and failsafe, each on its own."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.enums import SafetyAction
from protocol.rig_file import Rig
from realtime.control import backlash, inverse_kinematics, predictor, safety, stage_limiter
from realtime.control.configure import tick_parameters
from realtime.control.records import BACKLASH_STATE, POSE, PREDICTOR_STATE, STAGE_STATE, new


def play(inputs: np.ndarray, width: float) -> np.ndarray:
    out, y = np.empty_like(inputs), inputs[0] - width / 2
    for i, x in enumerate(inputs):
        y = min(max(y, x - width / 2), x + width / 2)
        out[i] = y
    return out


def test_backlash_inverse_undoes_a_play(rig: Rig) -> None:
    config, state = tick_parameters(rig)[0].backlash, new(BACKLASH_STATE)[0]
    config.threshold_m = config.caution_m = 0.0
    wanted = 0.008 * np.sin(np.linspace(0, 12, 3000))
    backlash.start(config, state, wanted[0])
    handle = np.array([backlash.apply(config, state, w) for w in wanted])
    assert np.max(np.abs(play(handle, config.width_m) - wanted)) < 1e-12
    assert np.max(np.abs(handle - wanted)) == pytest.approx(config.width_m / 2)


def test_noise_below_the_threshold_does_not_cross_the_gap(rig: Rig) -> None:
    config, state = tick_parameters(rig)[0].backlash, new(BACKLASH_STATE)[0]
    backlash.start(config, state, 0.0)
    noise = np.random.default_rng(1).uniform(-0.4, 0.4, 500) * config.threshold_m
    handle = [backlash.apply(config, state, x) for x in noise]
    assert np.ptp(handle) < config.threshold_m


def unloaded_tip(insertion_m: float, curvature: float, roll: float, length_m: float) -> np.ndarray:
    arc = min(length_m, length_m + insertion_m)
    straight = max(insertion_m, 0.0)
    bend = curvature * arc
    lateral = arc * bend / 2 if abs(bend) < 1e-6 else (1 - math.cos(bend)) / curvature
    along = arc if abs(bend) < 1e-6 else math.sin(bend) / curvature
    return np.array([lateral * math.sin(roll), -lateral * math.cos(roll), straight + along])


@given(insertion=st.floats(-0.09, 0.05), bend=st.floats(-2.1, 2.1), roll=st.floats(-3, 3))
def test_inverse_kinematics_undoes_the_arc(rig: Rig, insertion: float, bend: float, roll: float) -> None:
    config = tick_parameters(rig)[0].kinematics
    length = config.distal_length_m
    curvature = bend / min(length, length + insertion)
    if abs(curvature) > 44 or abs(bend) < 0.02:
        return
    out = np.zeros(3)
    tip = unloaded_tip(insertion, curvature, roll, length)
    out[:] = inverse_kinematics.apply(config, tip, roll)
    assert out[0] == pytest.approx(insertion, abs=1e-9)
    assert out[1] == pytest.approx(roll, abs=1e-9)
    assert out[2] == pytest.approx(inverse_kinematics.knob_of_curvature(config, curvature), abs=1e-9)


def test_roll_is_kept_on_the_axis_and_continuous_through_it(rig: Rig) -> None:
    config, out, roll, knobs = tick_parameters(rig)[0].kinematics, np.zeros(3), 0.3, []
    for lateral in np.linspace(0.004, -0.004, 161):
        tip = np.array([lateral * math.sin(0.3), -lateral * math.cos(0.3), 0.035])
        out[:] = inverse_kinematics.apply(config, tip, roll)
        assert abs(out[1] - roll) < 1e-9
        roll = out[1]
        knobs.append(out[2])
    assert knobs[0] > 0 > knobs[-1] and np.all(np.diff(knobs) <= 1e-12)


def test_straight_catheter_is_no_singularity(rig: Rig) -> None:
    config, out = tick_parameters(rig)[0].kinematics, np.zeros(3)
    for x in (0.0, 1e-12, 1e-9, 1e-6):
        out[:] = inverse_kinematics.apply(config, np.array([x, 0.0, 0.04]), 0.0)
        assert out[0] == pytest.approx(0.04 - config.distal_length_m, abs=1e-8)


def test_predictor_tracks_a_ramp_without_lag(rig: Rig) -> None:
    config, state, pose = tick_parameters(rig)[0].predictor, new(PREDICTOR_STATE)[0], new(POSE)[0]
    out = np.zeros(3)
    for k in range(80):
        t = 0.025 * k
        pose.count, pose.stamp_ns, pose.arrival_ns = k + 1, int(t * 1e9) + 1, int((t + 0.025) * 1e9)
        pose.position_m[:] = (0.0, 0.0, 0.03 + 0.01 * t)
        pose.quaternion_wxyz[:] = (1, 0, 0, 0)
        assert predictor.apply(config, state, pose) == predictor.ACCEPTED
    predictor.predict(state, pose.arrival_ns, out)
    assert out[2] == pytest.approx(0.03 + 0.01 * (t + 0.025), abs=2e-6)


def test_stage_reaches_its_target_without_overshoot(rig: Rig) -> None:
    config, state = tick_parameters(rig)[0].stage, new(STAGE_STATE)[0]
    path = []
    for _ in range(600):
        stage_limiter.apply(config, state, 0, 0.0031, 1e-3)
        path.append(float(state.position[0]))
    assert max(path) < 0.0031 * 1.001 and path[-1] == pytest.approx(0.0031, abs=1e-6)
    assert next(i for i, x in enumerate(path) if x > 0.0030) < 130


def test_stage_never_leaves_its_travel(rig: Rig) -> None:
    config, state = tick_parameters(rig)[0].stage, new(STAGE_STATE)[0]
    for _ in range(20000):
        stage_limiter.apply(config, state, 0, 1e9, 1e-3)
    assert state.position[0] <= config.max_unit[0]


FLAGS = st.integers(0, 2 ** len(safety.CAUSES) - 1)


@pytest.mark.parametrize("cause", safety.CAUSES, ids=lambda cause: cause[0])
def test_each_cause_leads_to_its_action(cause: tuple) -> None:
    name, action, latches, words = cause
    bit = safety.CAUSE_BIT[name]
    decided, latched = safety.decide(bit, 0, False)
    assert decided == action and words in safety.messages(bit)
    after, _ = safety.decide(0, latched, False)
    assert after == (action if latches else SafetyAction.NONE)


@given(flags=FLAGS, more=FLAGS, latched=FLAGS, clear=st.booleans())
def test_an_action_never_weakens_while_its_cause_stands(flags: int, more: int, latched: int, clear: bool) -> None:
    latched &= safety.LATCHING
    alone, _ = safety.decide(flags, 0, False)
    action, kept = safety.decide(flags | more, latched, clear)
    assert action >= alone
    again, _ = safety.decide(flags, kept, False)
    assert again >= alone
