"""Inverse kinematics: undoes the arc on both sides of the fold, continuous everywhere, the knob's dead zones kept."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocol.rig_file import Rig
from realtime.control import inverse_kinematics as ik
from realtime.control.configure import tick_parameters
from realtime.control.records import CURVE_POINTS

LENGTH_M = 0.110


@pytest.fixture(scope="module")
def config(rig: Rig) -> np.record:
    params = tick_parameters(rig)
    knob = np.radians([-95.0, -84.0, -4.0, 4.0, 84.0, 95.0])
    curve = ik.fitted_knob_curve(list(knob), [-45.0, -45.0, 0.0, 0.0, 45.0, 45.0], 45.0)
    params[0].kinematics.knob_of_curvature_rad[:] = curve
    return params[0].kinematics


def tip_of(joint: np.ndarray, curvature: float) -> np.ndarray:
    """Tip (3,) of an arc with body insertion, roll and curvature."""
    out_m = min(LENGTH_M, LENGTH_M + joint[0])
    bend = curvature * out_m
    lateral = out_m * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2
    return np.array(
        [lateral * math.sin(joint[1]), -lateral * math.cos(joint[1]), max(joint[0], 0.0) + out_m * np.sinc(bend / np.pi)]
    )


@given(ratio=st.floats(0.0, 0.7246))
def test_both_sides_of_the_fold_reach_the_place(ratio: float) -> None:
    below, beyond = ik.bend_of_reach(ratio, False), ik.bend_of_reach(ratio, True)
    assert 0.0 <= below <= ik.FOLD_BEND + 1e-12 and ik.FOLD_BEND - 1e-12 <= beyond <= 2 * math.pi
    for bend in (below, beyond):
        value = 0.0 if bend == 0 else 2 * math.sin(bend / 2) ** 2 / bend
        assert value == pytest.approx(ratio, abs=1e-10)


@given(insertion=st.floats(-0.08, 0.05), bend=st.floats(-4.9, 4.9), roll=st.floats(-3, 3), off=st.floats(-0.2, 0.2))
def test_nearest_branch_undoes_the_arc_on_both_sides(
    config: np.record, insertion: float, bend: float, roll: float, off: float
) -> None:
    curvature = bend / min(LENGTH_M, LENGTH_M + insertion)
    assume(abs(curvature) < 44 and abs(bend) > 0.05)
    tip = tip_of(np.array([insertion, roll]), curvature)
    assume(math.hypot(tip[0], tip[1]) > 2.1 * config.axis_radius_m)
    lateral = math.copysign(math.hypot(tip[0], tip[1]), tip[0] * math.sin(roll) - tip[1] * math.cos(roll))
    assume(abs(abs(bend) - ik.FOLD_BEND) > 0.05 or insertion < 0)
    assume(lateral * bend > 0)
    last, out = np.array([insertion, roll + off, ik.knob_of_curvature(config, curvature)]), np.zeros(3)
    out[:] = ik.apply_nearest(config, tip, last)
    assert out[0] == pytest.approx(insertion, abs=2e-7)
    assert out[1] == pytest.approx(roll, abs=1e-9)
    assert out[2] == pytest.approx(last[2], abs=1e-5)


@given(st.tuples(*[st.floats(-0.12, 0.12)] * 2, st.floats(-0.02, 0.22)), st.floats(-6, 6), st.floats(-1.7, 1.7))
def test_always_finite_and_within_the_curve(
    config: np.record, tip: tuple[float, float, float], roll: float, knob: float
) -> None:
    out = np.zeros(3)
    out[:] = ik.apply_nearest(config, np.array(tip), np.array([0.0, roll, knob]))
    assert np.all(np.isfinite(out)) and abs(out[1] - roll) <= math.pi / 2 + 1e-9
    assert config.knob_of_curvature_rad[0] <= out[2] <= config.knob_of_curvature_rad[-1]


def test_no_jump_on_a_path_out_of_the_sheath_past_the_fold(config: np.record) -> None:
    joint, jumps = np.array([-0.030, 0.0, ik.knob_of_curvature(config, 30.0)]), []
    for insertion in np.linspace(-0.030, 0.020, 1001):
        tip = tip_of(np.array([insertion, 0.0]), 30.0)
        before = joint.copy()
        joint[:] = ik.apply_nearest(config, tip, joint)
        jumps.append(np.abs(joint - before))
    assert np.max(np.array(jumps)[:, 0]) < 2e-4 and np.max(np.array(jumps)[:, 2]) < 0.02
    assert joint[0] == pytest.approx(0.020, abs=1e-6)


def test_straight_is_no_singularity_and_the_knob_passes_its_slack(config: np.record) -> None:
    joint, knobs = np.zeros(3), []
    for lateral in np.linspace(0.004, -0.004, 801):
        joint[:] = ik.apply_nearest(config, np.array([0.0, -lateral, 0.12]), joint)
        knobs.append(joint[2])
    assert abs(joint[1]) < 1e-9 and np.all(np.diff(knobs) <= 1e-12)
    assert np.max(np.abs(np.diff(knobs))) < math.radians(0.6)


def test_the_curve_keeps_both_ends_of_the_slack_and_drops_the_stops(config: np.record) -> None:
    step = 90.0 / (CURVE_POINTS - 1)
    assert ik.knob_of_curvature(config, step) == pytest.approx(math.radians(4.0 + step * 80 / 45), abs=1e-9)
    assert ik.knob_of_curvature(config, -step) == pytest.approx(-math.radians(4.0 + step * 80 / 45), abs=1e-9)
    assert ik.knob_of_curvature(config, 45.0) == pytest.approx(math.radians(84.0), abs=1e-9)
    assert ik.knob_of_curvature(config, 0.0) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-44.0, 44.0))
def test_curvature_of_knob_inverts_the_curve(config: np.record, curvature: float) -> None:
    assert ik.curvature_of_knob(config, ik.knob_of_curvature(config, curvature)) == pytest.approx(curvature, abs=1e-9)


def test_a_knob_that_bends_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="wanted a knob that bends"):
        ik.fitted_knob_curve([-1.0, 0.0, 1.0], [0.0, 0.0, 0.0], 45.0)


@given(insertion=st.floats(-0.1, 0.02), curvature=st.floats(0.0, 44.0))
def test_what_the_tip_reaches_is_within_reach(config: np.record, insertion: float, curvature: float) -> None:
    tip = tip_of(np.array([insertion, 0.3]), curvature)
    assert ik.out_of_reach_m(config, tip, -0.105, 0.025, 1.6) < 1e-6


@pytest.mark.parametrize(
    ("tip_m", "off_m"), [((0.0, 0.0, 0.2), 0.064), ((0.0, -0.11, 0.05), 0.030), ((0.0, -0.09, -0.01), 0.05)]
)
def test_what_it_does_not_reach_is_told_by_how_much(config: np.record, tip_m: tuple, off_m: float) -> None:
    assert ik.out_of_reach_m(config, np.array(tip_m), -0.105, 0.025, 1.6) > off_m
