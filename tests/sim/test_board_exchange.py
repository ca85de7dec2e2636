"""The recorded exchange with the stepper board: the client hears in it what it heard then, and says it byte for byte;
the firmware, run again, answers byte for byte at the same microsecond."""

from __future__ import annotations

import json
from typing import Any

import pytest

from protocol.serial_codec import StreamDecoder
from realtime.drivers.stepper_board import BoardEventKind, StepperBoardLink
from sim.board import SimulatedBoard
from tests.references.make_board_exchange import PATH, exchange
from tests.sim.board_rig import EVERY_BOARD, LIMITS, BoardRig

RECORDED = json.loads(PATH.read_text(encoding="utf-8"))
TURNS: list[dict[str, Any]] = RECORDED["turns"]


def pieces() -> list[tuple[bytes, int]]:
    return [(bytes.fromhex(piece["hex"]), piece["at_us"] * 1000) for turn in TURNS for piece in turn["from_board"]]


def test_the_client_understands_what_was_recorded() -> None:
    link, told, decoder = StepperBoardLink(LIMITS), [], StreamDecoder()
    for turn in TURNS:
        sent = bytes.fromhex(turn["to_board"])
        for message in decoder.feed(sent):
            if message.name != "SETPOINT":  # an answer counts for what was asked: asked again, it is the same bytes
                assert link._command(message.name, **message.fields) in sent
        for piece in turn["from_board"]:
            told += [
                event
                for event in link.feed(bytes.fromhex(piece["hex"]), piece["at_us"] * 1000)
                if event.kind is not BoardEventKind.STATUS
            ]
    assert [event.message for event in told] == RECORDED["events"]
    status = link.status
    assert status is not None and (status.rejected, status.crc_errors) == (6, 1) and status.position_steps[0] == -16_000
    assert link.decoder.counters.crc_errors == 0


@pytest.mark.avr
def test_client_and_firmware_say_the_same_again() -> None:
    rig = BoardRig("avr", "atmega2560")
    try:
        assert exchange(rig) == TURNS and rig.events == RECORDED["events"]
    finally:
        rig.close()


@pytest.mark.parametrize("kind", EVERY_BOARD)
def test_every_board_answers_the_recorded_commands_alike(kind: tuple[str, str]) -> None:
    answers: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for name, stream in (("recorded", pieces()), ("now", _answers_of(*kind))):
        decoder = StreamDecoder()
        answers[name] = [
            (message.name, message.fields) for piece, _ in stream for message in decoder.feed(piece) if message.name == "ACK"
        ]
    for name in answers:
        for _, fields in answers[name]:
            fields.pop("mcu_time_us")
    assert len(answers["recorded"]) == 9 and answers["now"] == answers["recorded"]


def _answers_of(kind: str, mcu: str) -> list[tuple[bytes, int]]:
    """What a board answers to the recorded bytes, each in its millisecond."""
    said: list[tuple[bytes, int]] = []
    with SimulatedBoard(kind, mcu) as board:
        by_time, limits = {turn["at_us"]: turn for turn in TURNS}, 0
        for at_us in range(1000, max(by_time) + 20_000, 1000):
            turn = by_time.get(at_us, {"to_board": "", "limit_bits": limits})
            limits = turn["limit_bits"]
            part = board.exchange(at_us, bytes.fromhex(turn["to_board"]), limits)
            said += [(piece, done_us * 1000) for piece, done_us in part.timed_frames()]
    return said
