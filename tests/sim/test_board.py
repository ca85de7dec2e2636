"""The simulated boards: what is commanded is what the pins do and what the firmware reports; every stop is safe."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.enums import BoardState
from protocol.serial_codec import encode
from protocol.serial_frames import DEADMAN_US, STOP_US, Fault, InputBit, Reject
from realtime.drivers.stepper_board import LinkPhase
from sim import board as board_module
from sim.board import BoardUnavailable, SimulatedBoard, ensure_built, resolve_kind
from tests.sim.board_rig import EVERY_BOARD, LIMITS, BoardRig, ramped_moves


@pytest.fixture(params=EVERY_BOARD)
def rig(request: pytest.FixtureRequest) -> Iterator[BoardRig]:
    if request.param[0] == "avr":
        request.getfixturevalue("avr_tools")
    rig = BoardRig(*request.param)
    yield rig
    rig.close()


@pytest.fixture
def armed(rig: BoardRig) -> BoardRig:
    rig.bring_up()
    rig.arm()
    return rig


def cruise(rig: BoardRig, milliseconds: int, steps_per_ms: tuple[int, int, int]) -> np.ndarray:
    """Constant speed without the rest at the end; returns the last position commanded."""
    position = rig.position.copy()
    for _ in range(milliseconds):
        position += np.array(steps_per_ms)
        rig.slice(rig.setpoint(position))
    return position


def assert_clean(rig: BoardRig) -> None:
    s = rig.status
    assert (
        s.crc_errors,
        s.sequence_errors,
        s.underruns,
        s.rejected,
        s.expired,
        s.overflows,
        s.late,
        s.rx_overruns,
        s.encoder_errors,
    ) == (0,) * 9, s
    counters = rig.link.decoder.counters
    assert counters.crc_errors == counters.lost == counters.repeated == 0


# --- motion ---------------------------------------------------------------------------------------------------------


def test_commanded_is_made_is_reported(armed: BoardRig) -> None:
    path = ramped_moves(240, seed=1)
    armed.follow(path, traffic=True)
    assert_clean(armed)
    assert armed.status.state == BoardState.RUNNING
    assert tuple(armed.position) == tuple(path[-1]) == armed.status.position_steps == armed.status.encoder_counts


def test_full_speed_on_all_axes_with_encoders(armed: BoardRig) -> None:
    """The most the processor is asked for: no set-point late, no byte lost, no interrupt longer than its period."""
    slope = np.minimum(np.arange(1, 1001), np.arange(1000, 0, -1)) / 30
    speeds = np.minimum(1.0, slope)[:, None] * np.array([15.9, 12.2, -12.2])
    path = np.round(np.cumsum(speeds, axis=0)).astype(np.int64)
    armed.follow(path, traffic=True)
    assert_clean(armed)
    assert tuple(armed.position) == tuple(path[-1]) == armed.status.encoder_counts
    assert armed.last is not None and armed.last.cpu.step_isr_max_cycles < 640
    assert armed.board.kind == "native" or armed.last.cpu.stack_free_bytes > 256


def test_edges_keep_to_the_step_timer(armed: BoardRig) -> None:
    armed.follow(ramped_moves(20, seed=2))
    for axis in range(3):
        gaps = np.diff(armed.edge_us[axis])
        assert gaps.min() >= 35, "two edges of one axis closer than a tick less its jitter"


@pytest.mark.parametrize("params", EVERY_BOARD)
def test_same_inputs_same_edges_to_the_cycle(params: tuple[str, str], request: pytest.FixtureRequest) -> None:
    if params[0] == "avr":
        request.getfixturevalue("avr_tools")
    digests = []
    for _ in range(2):
        rig = BoardRig(*params)
        rig.bring_up()
        rig.arm()
        rig.follow(ramped_moves(12, seed=3), traffic=True)
        digests.append(rig.digest)
        rig.close()
    assert digests[0] == digests[1]


@pytest.mark.avr
@pytest.mark.usefixtures("avr_tools")
def test_native_and_avr_agree() -> None:
    """The same core makes the same steps; they differ in time by what the links know of their board's clock."""
    rigs = [BoardRig("native"), BoardRig("avr"), BoardRig("avr", "atmega328p")]
    for rig in rigs:
        rig.bring_up()
        rig.arm()
        rig.follow(ramped_moves(30, seed=4))
    for rig in rigs[1:]:
        assert tuple(rig.position) == tuple(rigs[0].position)
        for axis in range(3):
            ours, native = np.array(rig.edge_us[axis]), np.array(rigs[0].edge_us[axis])
            assert len(ours) == len(native)
            lag = ours - native
            assert np.ptp(lag) <= 600
    for rig in rigs:
        rig.close()


# --- stopping -------------------------------------------------------------------------------------------------------


def assert_stopped_on_a_ramp(
    rig: BoardRig, commanded: np.ndarray, steps_per_ms: tuple[int, int, int], since_us: int, within_us: int
) -> None:
    """At rest in time, off the last command by no more than the queue and a uniform deceleration, ever slower."""
    for axis, limits in enumerate(LIMITS):
        speed = 1000 * abs(steps_per_ms[axis])
        if speed == 0:
            continue
        edges = np.array(rig.edge_us[axis])
        assert edges[-1] <= since_us + within_us
        gaps = np.diff(edges[edges > since_us])
        assert len(gaps) > 10 and (gaps[1:] >= gaps[:-1] - 110).all(), "not a ramp down"
        braking_steps = speed**2 / (2 * limits.max_accel_steps_per_s2)
        off = abs(int(rig.position[axis] - commanded[axis]))
        assert off <= braking_steps + 0.005 * speed + 2


def test_deadman(armed: BoardRig) -> None:
    commanded = cruise(armed, 60, (15, 12, -12))
    last_sent_us = armed.time_us - 1000
    armed.run_ms(150)
    assert (armed.status.state, armed.status.fault) == (BoardState.FAULT, Fault.DEADMAN)
    assert_stopped_on_a_ramp(armed, commanded, (15, 12, -12), last_sent_us + 4000, DEADMAN_US + STOP_US)
    assert tuple(armed.position) == armed.status.position_steps == armed.status.encoder_counts
    at_rest = armed.position.copy()
    for _ in range(20):
        armed.slice(armed.setpoint(at_rest + 5))
    armed.run_ms(20, armed.link.hello())
    assert armed.status.state == BoardState.FAULT and armed.status.last_reject == Reject.STATE
    assert (armed.position == at_rest).all(), "moved while a fault was latched"
    armed.run_ms(8, armed.link.clear_fault(Fault.ESTOP))
    assert armed.status.state == BoardState.FAULT
    armed.run_ms(8, armed.link.clear_fault(Fault.DEADMAN))
    assert armed.status.state == BoardState.DISARMED


def test_emergency_stop(armed: BoardRig) -> None:
    commanded = cruise(armed, 60, (15, -12, 12))
    armed.inputs = {"estop": True}
    pressed_us = armed.time_us
    for _ in range(90):
        armed.slice(armed.setpoint(commanded))
    assert (armed.status.state, armed.status.fault) == (BoardState.FAULT, Fault.ESTOP)
    assert armed.status.inputs & 1 << InputBit.ESTOP
    assert_stopped_on_a_ramp(armed, commanded, (15, -12, 12), pressed_us + 3000, STOP_US)
    armed.run_ms(8, armed.link.clear_fault(Fault.ESTOP))
    assert armed.status.state == BoardState.FAULT, "cleared with the button pressed"
    armed.inputs = {}
    armed.run_ms(8)
    armed.run_ms(8, armed.link.clear_fault(Fault.ESTOP))
    assert armed.status.state == BoardState.DISARMED


def test_limit_switch(armed: BoardRig) -> None:
    commanded = cruise(armed, 40, (0, 8, 0))
    armed.inputs = {"limit_bits": 1 << InputBit.LIMIT_1_MAX}
    opened_us = armed.time_us
    for _ in range(80):
        armed.slice(armed.setpoint(commanded))
    assert (armed.status.state, armed.status.fault) == (BoardState.FAULT, Fault.LIMIT)
    assert armed.status.inputs == 1 << InputBit.LIMIT_1_MAX
    assert_stopped_on_a_ramp(armed, commanded, (0, 8, 0), opened_us + 3000, STOP_US)
    armed.run_ms(8, armed.link.clear_fault(Fault.LIMIT))
    armed.arm()
    at_end = armed.position.copy()
    for k in range(10):
        armed.slice(armed.setpoint(at_end + np.array([0, k, 0])))
    assert armed.position[1] == at_end[1] and armed.status.last_reject == Reject.LIMIT_SWITCH
    armed.follow(at_end - np.arange(40)[:, None] * np.array([0, 3, 0]))
    assert armed.position[1] == at_end[1] - 117 and armed.status.state == BoardState.RUNNING


@pytest.mark.parametrize("how", ["reset", "power_cycle", "freeze"])
def test_a_restarted_processor_is_a_fault(armed: BoardRig, how: str) -> None:
    cruise(armed, 30, (10, 10, 10))
    getattr(armed.board, how)()
    before = [len(edges) for edges in armed.edge_us]
    for _ in range(120):
        armed.slice(armed.setpoint(armed.position))
    assert armed.link.phase is LinkPhase.RESET
    assert any("board was reset: found start 2, wanted 1" in line for line in armed.events)
    assert [len(edges) for edges in armed.edge_us] == before, "moved after a restart"
    assert armed.status.state == (BoardState.FAULT if how == "freeze" else BoardState.DISARMED)
    assert armed.status.fault == (Fault.WATCHDOG if how == "freeze" else Fault.NONE)
    with pytest.raises(ValueError, match="wanted ready"):
        armed.link.arm()
    armed.run_ms(8, encode("ARM", 200, boot_count=1))
    assert not armed.link.armed


# --- set-points that must not be executed ---------------------------------------------------------------------------


def test_expired_setpoints_are_counted_and_not_executed(armed: BoardRig) -> None:
    armed.follow(np.zeros((5, 3), np.int64))
    for _ in range(10):
        armed.slice(armed.setpoint(np.array([9, 9, 9]), lead_us=-4000, expiry_us=1000))
        armed.slice(armed.setpoint(np.zeros(3, np.int64)))
    armed.run_ms(6)
    assert armed.status.expired == 10 and not armed.position.any()


def test_overflow_and_underrun_are_counted(armed: BoardRig) -> None:
    """Eight at once, none due before all have come: one is loaded, four wait, three are refused."""
    armed.run_ms(25, b"".join(armed.setpoint(np.array([k, 0, 0]), lead_us=6000 + 500 * k) for k in range(8)))
    assert (armed.status.overflows, armed.status.underruns, armed.status.rejected) == (3, 1, 0)
    assert armed.position[0] == armed.status.position_steps[0] and 4 <= armed.position[0] <= 8


def test_too_fast_and_too_far_are_rejected(armed: BoardRig) -> None:
    armed.slice(armed.setpoint(np.array([400, 0, 0])))
    armed.run_ms(8)
    assert armed.status.last_reject == Reject.SPEED
    armed.slice(armed.setpoint(np.array([0, 2_000_000, 0])))
    armed.run_ms(8)
    assert armed.status.last_reject == Reject.SOFT_LIMIT
    armed.slice(armed.setpoint(np.array([1, 0, 0]), lead_us=40_000))
    armed.run_ms(8)
    assert armed.status.last_reject == Reject.HORIZON
    assert armed.status.rejected == 3 and not armed.position.any()


@st.composite
def damage(draw: st.DrawFn) -> list[tuple[str, int, int]]:
    kinds = st.sampled_from(["flip", "cut", "double", "swap", "drop"])
    return draw(st.lists(st.tuples(kinds, st.integers(0, 19), st.integers(0, 10_000)), min_size=1, max_size=8))


def apply_damage(frames: list[bytes], faults: list[tuple[str, int, int]]) -> list[bytes]:
    pieces = [bytearray(frame) for frame in frames]
    for kind, at, where in faults:
        piece = pieces[at % len(pieces)]
        if kind == "flip" and piece:
            piece[where // 8 % len(piece)] ^= 1 << where % 8
        elif kind == "cut":
            del piece[where % (len(piece) + 1) :]
        elif kind == "double":
            pieces.insert(at % len(pieces), bytearray(piece))
        elif kind == "swap":
            other = where % len(pieces)
            pieces[at % len(pieces)], pieces[other] = pieces[other], piece
        elif kind == "drop" and len(pieces) > 1:
            del pieces[at % len(pieces)]
    return [bytes(piece) for piece in pieces]


@settings(max_examples=60)
@given(damage())
def test_nothing_is_executed_that_was_not_sent(faults: list[tuple[str, int, int]]) -> None:
    """Twenty frames that each name another position, damaged: the board holds one of these, or none."""
    rig = BoardRig("native")
    try:
        rig.bring_up()
        names = [1_000_000 + 7919 * k for k in range(20)]
        rig.run_ms(20, b"".join(apply_damage([rig.link.set_position(0, name) for name in names], faults)))
        assert rig.status.position_steps[0] in (0, *names)
        assert rig.status.position_steps[1:] == (0, 0) and rig.status.state == BoardState.DISARMED
    finally:
        rig.close()


@settings(max_examples=40)
@given(damage())
def test_damaged_setpoints_are_not_executed(faults: list[tuple[str, int, int]]) -> None:
    """A slow path of which a part is damaged on the line: the axes stay close to it and come to its very end."""
    rig = BoardRig("native")
    slope = np.array([1, 1, -1])
    try:
        rig.bring_up()
        rig.arm()
        rig.follow(np.arange(1, 11)[:, None] * slope)
        frames = []
        for k in range(20):
            execute_us = rig.link.clock.to_mcu_us(rig.now_ns, rig.now_ns) + 1000 * k + 3000
            frames.append(rig.link.setpoint(rig.number + 1 + k, execute_us, 2000, (11 + k) * slope))
        rig.number += len(frames)
        for piece in apply_damage(frames, faults):
            rig.slice(piece)
            assert (rig.position * slope >= 9).all() and (rig.position * slope <= 31).all()
        rig.follow(np.arange(31, 51)[:, None] * slope)
        assert rig.accepted <= set(range(rig.number + 1))
        assert tuple(rig.position) == tuple(50 * slope) == rig.status.position_steps
        assert rig.status.state == BoardState.RUNNING and rig.number - 9 < rig.status.last_setpoint <= rig.number
    finally:
        rig.close()


# --- the child ------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="board kind: found 'steel'"):
        resolve_kind("steel")
    with pytest.raises(ValueError, match="mcu: found 'z80'"):
        SimulatedBoard("native", "z80")
    with SimulatedBoard("native") as board:
        board.exchange(2000)
        with pytest.raises(ValueError, match="until_us: found 1000"):
            board.exchange(1000)


def test_a_dead_child_is_one_line() -> None:
    board = SimulatedBoard("native")
    os.kill(board.pid, signal.SIGKILL)
    with pytest.raises(BoardUnavailable, match=r"board native: the child process \d+ died"):
        for k in range(1, 100):
            board.exchange(1000 * k)
    board.close()
    board.close()


def test_missing_tools_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    which = board_module.shutil.which
    monkeypatch.setattr(board_module.shutil, "which", lambda tool: None if tool == "avr-gcc" else which(tool))
    with pytest.raises(BoardUnavailable, match="avr-gcc") as error:
        ensure_built("avr")
    assert "\n" not in str(error.value)
    assert resolve_kind("auto") == "native"
    assert "compiled for the host" in capsys.readouterr().err


def test_time_goes_on_through_a_restart(rig: BoardRig) -> None:
    rig.bring_up()
    rig.board.power_cycle()
    rig.run_ms(30)
    rig.link.restart()
    rig.bring_up()
    rig.arm()
    rig.follow(np.arange(20)[:, None] * np.array([4, 0, 0]))
    assert rig.position[0] == 76 and rig.edge_us[0][-1] < rig.time_us
