"""The tick as a whole: phases, failsafe actions, limits, and finite outputs for any inputs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.enums import CommandKind, JogAxis, Phase, SafetyAction
from protocol.rig_file import Rig, parse_rig
from realtime.control import safety
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from tests.realtime.conftest import Bench


def armed(bench: Bench) -> Bench:
    bench.run(0.1)
    bench.command(CommandKind.HOLD)
    bench.run(0.1)
    assert bench.outputs[0].phase == Phase.HOLD
    return bench


def with_law(rig: Rig, law: str) -> Rig:
    data = rig.effective()
    return parse_rig({**data, "control": {**data["control"], "law": law}})


def in_contact(bench: Bench, force_N: float = 0.1) -> Bench:
    armed(bench)
    bench.command(CommandKind.CONTACT, target_m=(0.0, -0.006, 0.040), force_N=0.2)
    bench.run(0.2)
    assert bench.outputs[0].phase == Phase.APPROACH
    bench.force[:] = (0.0, 0.0, force_N)
    bench.run(0.1)
    assert bench.outputs[0].phase == Phase.CONTACT
    return bench


def test_nothing_is_sent_before_an_explicit_arm(bench: Bench) -> None:
    assert bench.run(0.2).valid == 0
    assert bench.outputs[0].phase == Phase.DISARMED


def test_arming_does_not_move_the_stages(bench: Bench) -> None:
    bench.inputs[0].board.position_steps[:] = (3200, -500, 100)
    armed(bench)
    assert list(bench.outputs[0].position_steps) == [3200, -500, 100]


def test_position_command_moves_towards_the_goal_within_stage_limits(bench: Bench) -> None:
    armed(bench)
    bench.command(CommandKind.POSITION, target_m=(0.0, -0.006, 0.040))
    stage = bench.params[0].stage
    last, last_speed = np.array(bench.outputs[0].stage_unit), np.zeros(3)
    for _ in range(400):
        now = np.array(bench.run(0.001).stage_unit)
        speed = (now - last) / 1e-3
        assert np.all(np.abs(speed) <= stage.max_speed * (1 + 1e-9))
        assert np.all(np.abs(speed - last_speed) / 1e-3 <= stage.max_accel * (1 + 1e-6))
        last, last_speed = now, speed
    assert last[0] > 0.001


@pytest.mark.parametrize("law", ["thesis", "predictive"])
def test_force_below_wanted_pushes_on_and_above_pulls_back(rig: Rig, law: str) -> None:
    bench = in_contact(Bench(with_law(rig, law)))
    before = bench.outputs[0].joint[0]
    assert bench.run(0.3).joint[0] > before
    bench = in_contact(Bench(with_law(rig, law)), 0.3)
    before = bench.outputs[0].joint[0]
    assert bench.run(0.3).joint[0] < before


def test_a_force_that_answers_no_motion_is_not_run_after_without_bound(bench: Bench) -> None:
    """A sensor that shows the same whatever is done: the law stays within a hand's breadth of where it touched."""
    in_contact(bench)
    before = bench.outputs[0].joint[0]
    assert abs(bench.run(5.0).joint[0] - before) < 0.015


def test_no_fresh_pose_holds_then_stops(bench: Bench) -> None:
    in_contact(bench)
    bench.with_pose = False
    bench.run(0.080)
    assert bench.outputs[0].action == SafetyAction.HOLD
    joint = bench.run(0.030).joint[0]
    assert bench.run(0.020).joint[0] == joint
    bench.run(0.050)
    assert bench.outputs[0].action == SafetyAction.STOP and bench.outputs[0].phase == Phase.RETRACT
    bench.force[:] = 0.0
    bench.run(1.0)
    assert bench.outputs[0].joint[0] <= joint - 0.009 and bench.outputs[0].phase == Phase.STOPPED
    bench.with_pose = True
    bench.run(0.5)
    assert bench.outputs[0].phase == Phase.STOPPED, "a stop must not end by itself"


def test_where_the_rig_file_forbids_it_a_stop_in_contact_does_not_retract(rig: Rig) -> None:
    still = rig.model_copy(update={"safety": rig.safety.model_copy(update={"retract_stopped": False})})
    bench = in_contact(Bench(still))
    bench.with_pose = False
    bench.run(0.2)
    assert bench.outputs[0].phase == Phase.STOPPED


def test_a_stopped_catheter_that_the_wall_presses_is_retracted_again(bench: Bench) -> None:
    in_contact(bench)
    bench.force[:] = (0.0, 0.0, 0.55)
    bench.run(0.02)
    bench.force[:] = 0.0
    assert bench.run(1.0).phase == Phase.STOPPED
    before = bench.outputs[0].joint[0]
    bench.force[:] = (0.0, 0.0, 0.12)
    assert bench.run(0.2).phase == Phase.STOPPED and "still_pressed" in safety.names(int(bench.outputs[0].cause))
    bench.force[:] = (0.0, 0.0, 0.2)
    assert bench.run(0.05).phase == Phase.RETRACT, "a wall that comes nearer leaves no time"
    bench.force[:] = 0.0
    assert bench.run(1.0).phase == Phase.STOPPED and bench.outputs[0].joint[0] <= before - 0.009


def test_a_retraction_goes_on_while_something_presses(bench: Bench) -> None:
    in_contact(bench)
    bench.force[:] = (0.0, 0.0, 0.55)
    bench.run(0.02)
    before = bench.outputs[0].joint[0]
    bench.force[:] = (0.0, 0.0, 0.1)
    bench.run(2.0)
    assert bench.outputs[0].joint[0] < before - 0.03 and bench.outputs[0].phase == Phase.STOPPED
    assert "still_pressed" in safety.names(int(bench.outputs[0].cause))


def test_over_force_retracts_and_stays_stopped(bench: Bench) -> None:
    in_contact(bench)
    bench.force[:] = (0.0, 0.0, 0.55)
    bench.run(0.02)
    assert bench.outputs[0].action == SafetyAction.RETRACT
    start = bench.outputs[0].joint[0]
    bench.force[:] = 0.0
    bench.run(1.0)
    assert bench.outputs[0].joint[0] <= start - 0.009
    assert bench.outputs[0].phase == Phase.STOPPED


def test_board_fault_and_silence_stop(bench: Bench) -> None:
    armed(bench)
    bench.with_board = False
    bench.run(0.05)
    assert bench.outputs[0].action == SafetyAction.STOP
    assert "board_silent" in safety.names(int(bench.outputs[0].cause))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 5.0])
def test_wild_pose_is_counted_and_never_acted_on(bench: Bench, bad: float) -> None:
    armed(bench)
    good = np.array(bench.outputs[0].tip_m)
    bench.tip = np.array([bad, 0.0, 0.03])
    bench.run(0.05)
    assert bench.outputs[0].poses_rejected == 2
    assert np.allclose(bench.outputs[0].tip_m, good, atol=1e-4)


def test_jump_beyond_the_speed_limit_is_rejected(bench: Bench) -> None:
    armed(bench)
    bench.tip = bench.tip + (0.0, 0.0, 0.02)
    bench.run(0.025)
    assert bench.outputs[0].poses_rejected == 1


def test_force_not_finite_is_rejected_and_goes_stale(bench: Bench) -> None:
    in_contact(bench)
    bench.force[:] = np.nan
    bench.run(0.1)
    assert bench.outputs[0].forces_rejected == 100
    assert np.all(np.isfinite(bench.outputs[0].force_N))
    assert bench.outputs[0].action >= SafetyAction.HOLD


any_float = st.floats(allow_nan=True, allow_infinity=True)
vector = st.tuples(any_float, any_float, any_float)


@settings(max_examples=200)
@given(
    poses=st.lists(vector, min_size=1, max_size=8),
    forces=st.lists(vector, min_size=8, max_size=8),
    target=vector,
    wanted=any_float,
    kind=st.integers(0, 4),
    step_ms=st.integers(1, 60),
)
def test_outputs_are_finite_for_any_inputs(rig, poses, forces, target, wanted, kind, step_ms) -> None:  # type: ignore[no-untyped-def]
    bench = Bench(rig)
    armed(bench)
    u = bench.inputs[0]
    bench.command(kind, target_m=target, force_N=wanted)
    for i, pose in enumerate(poses):
        u.now_ns += step_ms * 1_000_000
        u.tip.count += 1
        u.tip.stamp_ns, u.tip.arrival_ns = u.now_ns - 25_000_000, u.now_ns
        u.tip.position_m[:] = pose
        u.sensor.count += 1
        u.sensor.force_N[:] = forces[i]
        u.sensor.arrival_ns = u.now_ns
        tick(bench.params, bench.state, bench.inputs, bench.outputs)
        y = bench.outputs[0]
        assert np.all(np.isfinite(y.stage_unit)) and np.all(np.isfinite(y.tip_m)) and np.all(np.isfinite(y.joint))
        assert np.all(np.abs(y.stage_unit) <= 7.0)


def test_the_tick_is_pure(bench: Bench) -> None:
    in_contact(bench)
    state, inputs, first, second = bench.state.copy(), bench.inputs.copy(), new(OUTPUTS), new(OUTPUTS)
    again = state.copy()
    tick(bench.params, state, inputs, first)
    tick(bench.params, again, inputs, second)
    assert first.tobytes() == second.tobytes() and state.tobytes() == again.tobytes()
    assert inputs.tobytes() == bench.inputs.tobytes()
    assert STATE.itemsize and INPUTS.itemsize


@pytest.mark.parametrize("law", ["predictive", "thesis"])
def test_a_jog_moves_one_axis_by_its_travel_at_its_speed_and_then_rests(rig: Rig, law: str) -> None:
    bench = armed(Bench(with_law(rig, law)))
    before = np.array(bench.outputs[0].joint)
    bench.command(CommandKind.JOG, jog_axis=JogAxis.KNOB, jog_travel=0.1, jog_speed=0.5)
    bench.run(0.1)
    half = float(bench.outputs[0].joint[2] - before[2])
    assert bench.outputs[0].phase == Phase.JOG and 0.02 < half < 0.055
    bench.run(0.4)
    change = np.array(bench.outputs[0].joint) - before
    assert change[2] == pytest.approx(0.1, abs=0.002) and change[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("law", ["predictive", "thesis"])
def test_a_jog_that_meets_a_force_holds(rig: Rig, law: str) -> None:
    bench = armed(Bench(with_law(rig, law)))
    bench.command(CommandKind.JOG, jog_axis=JogAxis.TIP, jog_travel=0.01, jog_speed=0.005, jog_direction=(0.0, 0.0, 1.0))
    bench.run(0.2)
    assert bench.outputs[0].phase == Phase.JOG
    bench.force[:] = (0.0, 0.0, 0.05)
    bench.run(0.01)
    assert bench.outputs[0].phase == Phase.HOLD


@pytest.mark.parametrize(
    "wrong",
    [
        {"jog_axis": 7},
        {"jog_axis": -1},
        {"jog_travel": np.nan},
        {"jog_speed": np.inf},
        {"jog_speed": -0.01},
        {"jog_axis": 3, "jog_direction": (0.0, 0.0, 0.0)},
        {"jog_axis": 3, "jog_direction": (0.0, 0.0, 1.0), "jog_travel": 5.0},
    ],
)
def test_a_jog_that_makes_no_sense_holds(bench: Bench, wrong: dict) -> None:
    armed(bench)
    bench.command(CommandKind.JOG, **{"jog_axis": 0, "jog_travel": 0.001, "jog_speed": 0.005} | wrong)
    bench.run(0.05)
    assert bench.outputs[0].phase == Phase.HOLD and np.all(np.isfinite(bench.outputs[0].stage_unit))
