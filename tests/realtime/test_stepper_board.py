"""The link to the stepper board: bring-up, status, refusals, faults, resets, mismatches; in any portions of bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.enums import BoardState
from protocol.serial_codec import StreamDecoder, encode
from protocol.serial_frames import FRAME_BY_NAME, PROTOCOL_HASH, Fault, Result
from realtime.drivers.stepper_board import (
    FAULT_ADVICE,
    RETRY_NS,
    AxisLimits,
    BoardEventKind,
    BoardIdentity,
    BoardStatus,
    LinkEvent,
    LinkPhase,
    StepperBoardLink,
)

LIMITS = [AxisLimits(16_000, 640_000, -1000, 1000)] * 3
MS = 1_000_000


class Peer:
    """A board that answers, frame by frame."""

    def __init__(self, **identity: int) -> None:
        self.sequence = 0
        self.decoder = StreamDecoder()
        self.identity = {
            "protocol_hash": PROTOCOL_HASH,
            "firmware_version": 0x0100,
            "boot_count": 3,
            "reset_cause": 0,
            "mcu": 1,
            "timer_hz": 20_000,
            "axes": 3,
            "queue_capacity": 4,
            "deadman_us": 30_000,
            "horizon_us": 12_000,
        } | identity
        self.refuse: dict[str, Result] = {}
        self.heard: list[str] = []

    def send(self, name: str, **fields: object) -> bytes:
        self.sequence += 1
        return encode(name, self.sequence, **fields)

    def answer(self, data: bytes) -> bytes:
        out = b""
        for message in self.decoder.feed(data):
            self.heard.append(message.name)
            if message.name == "HELLO":
                out += self.send("IDENTITY", **self.identity)
            else:
                out += self.send(
                    "ACK",
                    command=FRAME_BY_NAME[message.name].id,
                    command_sequence=message.sequence,
                    result=self.refuse.get(message.name, Result.OK),
                    mcu_time_us=0,
                )
        return out

    def status(self, **fields: object) -> bytes:
        blank: dict[str, object] = {f.name: 0 if f.count == 1 else (0,) * f.count for f in FRAME_BY_NAME["STATUS"].fields}
        return self.send("STATUS", **blank | {"boot_count": self.identity["boot_count"]} | fields)


def kinds(events: list[LinkEvent]) -> list[BoardEventKind]:
    return [event.kind for event in events]


def ready() -> tuple[StepperBoardLink, Peer]:
    link, peer = StepperBoardLink(LIMITS), Peer()
    for ms in range(5):
        link.feed(peer.answer(link.advance(ms * MS)), ms * MS)
    assert link.phase is LinkPhase.READY
    return link, peer


def test_bring_up_and_arm() -> None:
    link, peer = ready()
    assert peer.heard == ["HELLO", "CONFIGURE", "CONFIGURE", "CONFIGURE"]
    assert link.identity == BoardIdentity(**peer.identity)
    events = link.feed(peer.answer(link.arm()), 9 * MS)
    assert [(e.kind, e.command) for e in events] == [(BoardEventKind.ACK, "ARM")]
    assert not link.armed
    link.feed(peer.status(state=BoardState.ARMED), 10 * MS)
    assert link.armed


def test_what_is_not_answered_is_sent_again_but_not_at_once() -> None:
    link = StepperBoardLink(LIMITS)
    assert link.advance(0)
    assert link.advance(RETRY_NS - 1) == b""
    assert link.advance(RETRY_NS)


def test_a_board_that_starts_late_is_greeted_at_its_first_word() -> None:
    link, peer = StepperBoardLink(LIMITS), Peer()
    assert link.advance(0)
    link.feed(peer.status(), 5 * MS)
    assert link.advance(6 * MS)


@pytest.mark.parametrize("identity", [{"protocol_hash": PROTOCOL_HASH ^ 1}, {"firmware_version": 0x0200}])
def test_another_protocol_or_firmware_is_refused(identity: dict[str, int]) -> None:
    link, peer = StepperBoardLink(LIMITS), Peer(**identity)
    events = link.feed(peer.answer(link.advance(0)), MS)
    assert kinds(events) == [BoardEventKind.MISMATCH] and "flash this version's firmware" in events[0].message
    assert link.phase is LinkPhase.MISMATCH
    assert link.advance(10 * RETRY_NS) == b""
    with pytest.raises(ValueError, match="wanted ready"):
        link.arm()


def test_a_newer_minor_version_is_taken() -> None:
    link, peer = StepperBoardLink(LIMITS), Peer(firmware_version=0x0105)
    link.feed(peer.answer(link.advance(0)), MS)
    assert link.phase is LinkPhase.CONFIGURE


def test_a_refused_command_says_why() -> None:
    link, peer = ready()
    link.feed(peer.status(state=BoardState.FAULT, fault=Fault.ESTOP), 7 * MS)
    peer.refuse["CLEAR_FAULT"] = Result.CAUSE_PRESENT
    events = link.feed(peer.answer(link.clear_fault(Fault.ESTOP)), 8 * MS)
    assert kinds(events) == [BoardEventKind.REFUSED]
    assert events[0].message == "board refused CLEAR_FAULT: CAUSE_PRESENT (it is FAULT, fault ESTOP)"


def test_refused_limits_are_not_taken_as_set() -> None:
    link, peer = StepperBoardLink(LIMITS), Peer()
    peer.refuse["CONFIGURE"] = Result.BAD_VALUE
    for ms in range(5):
        link.feed(peer.answer(link.advance(ms * MS)), ms * MS)
    assert link.phase is LinkPhase.CONFIGURE


def test_a_board_with_a_fault_is_not_configured_until_it_is_cleared() -> None:
    link, peer = StepperBoardLink(LIMITS), Peer()
    link.feed(peer.answer(link.advance(0)) + peer.status(state=BoardState.FAULT, fault=Fault.DEADMAN), MS)
    assert link.advance(500 * MS) == b""
    link.feed(peer.status(), 501 * MS)
    assert link.advance(502 * MS)


def test_a_fault_is_told_once_with_advice() -> None:
    link, peer = ready()
    events = []
    for ms in range(10, 60, 5):
        events += link.feed(peer.status(state=BoardState.FAULT, fault=Fault.DEADMAN), ms * MS)
    told = [e for e in events if e.kind is BoardEventKind.FAULT]
    assert len(told) == 1 and FAULT_ADVICE[Fault.DEADMAN] in told[0].message
    link.feed(peer.status(), 60 * MS)
    assert BoardEventKind.FAULT in kinds(link.feed(peer.status(state=BoardState.FAULT, fault=Fault.DEADMAN), 65 * MS))


def test_every_fault_has_advice() -> None:
    assert set(FAULT_ADVICE) == set(Fault)


def test_a_reset_is_a_fault_that_ends_the_session() -> None:
    link, peer = ready()
    link.feed(peer.status(state=BoardState.RUNNING), 10 * MS)
    events = link.feed(peer.status(boot_count=4) + peer.status(boot_count=4), 15 * MS)
    assert kinds(events).count(BoardEventKind.RESET) == 1
    assert "found start 4, wanted 3" in events[0].message
    assert link.phase is LinkPhase.RESET and link.advance(10 * RETRY_NS) == b""
    with pytest.raises(ValueError, match="wanted ready"):
        link.arm()
    peer.identity["boot_count"] = 4
    link.restart()
    for ms in range(20, 25):
        link.feed(peer.answer(link.advance(ms * MS)), ms * MS)
    assert link.phase is LinkPhase.READY and link.identity is not None and link.identity.boot_count == 4


def test_status_carries_every_field() -> None:
    names = [f.name for f in FRAME_BY_NAME["STATUS"].fields]
    assert BoardStatus._fields == ("arrival_ns", *names)
    assert BoardIdentity._fields == tuple(f.name for f in FRAME_BY_NAME["IDENTITY"].fields)
    link, peer = ready()
    link.feed(peer.status(position_steps=(1, -2, 3), underruns=7), 9 * MS)
    assert link.status is not None
    assert link.status.position_steps == (1, -2, 3) and link.status.underruns == 7 and link.status.arrival_ns == 9 * MS


def test_commands_and_setpoints_count_for_themselves() -> None:
    link = StepperBoardLink(LIMITS)
    frames = [link.ping(), link.setpoint(1, 2, 3, (0, 0, 0)), link.ping(), link.setpoint(2, 2, 3, (0, 0, 0))]
    sequences = [StreamDecoder().feed(frame)[0].sequence for frame in frames]
    assert sequences == [1, 1, 2, 2]


def test_wrapping_numbers_and_times() -> None:
    message = StreamDecoder().feed(StepperBoardLink(LIMITS).setpoint(70_000, 2**32 + 5, 3, (0, 0, -1)))[0]
    assert (message.fields["number"], message.fields["execute_us"]) == (70_000 - 65_536, 5)


def test_stray_answers_change_nothing() -> None:
    link, peer = ready()
    stray = peer.send("ACK", command=0x99, command_sequence=77, result=Result.OK, mcu_time_us=0)
    assert link.feed(stray, 9 * MS) == []
    assert link.feed(peer.send("ACK", command=0x03, command_sequence=77, result=0, mcu_time_us=0), 9 * MS) == []


def test_wrong_number_of_axes_is_refused() -> None:
    with pytest.raises(ValueError, match="axes: found 2, wanted 3"):
        StepperBoardLink(LIMITS[:2])


@given(st.lists(st.integers(1, 30), min_size=1, max_size=20), st.binary(max_size=40))
def test_any_portions_and_any_noise_before(sizes: list[int], noise: bytes) -> None:
    link, peer = StepperBoardLink(LIMITS), Peer()
    stream = noise + b"\0" + peer.answer(link.advance(0)) + peer.status(state=BoardState.DISARMED, last_setpoint=9)
    events, at, turn = [], 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        events += link.feed(stream[at : at + size], MS)
        at, turn = at + size, turn + 1
    assert kinds(events) == [BoardEventKind.IDENTIFIED, BoardEventKind.STATUS]
    assert link.status is not None and link.status.last_setpoint == 9


def test_a_board_unplugged_and_back_is_brought_up_again() -> None:
    link, peer = ready()
    link.feed(peer.status(state=BoardState.RUNNING), 10 * MS)
    link.unplugged()
    assert link.phase is LinkPhase.HELLO and link.status is None and not link.armed
    peer.heard.clear()
    link.feed(peer.status(state=BoardState.DISARMED), 900 * MS)
    for ms in range(1000, 1005):
        link.feed(peer.answer(link.advance(ms * MS)), ms * MS)
    assert link.phase is LinkPhase.READY and peer.heard == ["HELLO", "CONFIGURE", "CONFIGURE", "CONFIGURE"]


def test_a_board_that_lost_power_with_its_plug_is_not_believed() -> None:
    link, peer = ready()
    link.unplugged()
    peer.identity["boot_count"] += 1
    events = link.feed(peer.answer(link.advance(1000 * MS)), 1000 * MS)
    assert kinds(events) == [BoardEventKind.RESET] and "home the axes again" in events[0].message
    assert link.phase is LinkPhase.RESET
    link.unplugged()
    assert link.phase is LinkPhase.RESET
