"""Writes tests/realtime/vectors/stepper_board.json: what computer and firmware (the ELF in simavr) said, ms by ms.

`python -m tests.references.make_board_exchange`
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from protocol.serial_frames import Fault
from realtime.drivers.stepper_board import LinkPhase
from tests.sim.board_rig import BoardRig

PATH = Path(__file__).parents[1] / "realtime" / "vectors" / "stepper_board.json"


def script(rig: BoardRig) -> Iterator[tuple[str, bytes]]:
    """(what it is, bytes to the board) of one millisecond after another: bring-up, move, refusals, a limit switch."""
    while rig.link.phase is not LinkPhase.READY:
        yield "bring-up", rig.link.advance(rig.now_ns)
    yield "a set-point while disarmed, refused", rig.setpoint(np.zeros(3, np.int64))
    yield from (("", b"") for _ in range(8))
    yield "arm", rig.link.arm()
    yield from (("", b"") for _ in range(8))
    for tick in range(12):
        yield "a move", rig.setpoint(np.array([tick, -tick // 2, 0]))
    yield "a damaged frame", b"\x05\x01\x02\x03\x04\x00"
    rig.inputs = {"limit_bits": 1}
    for _ in range(6):
        yield "lower switch of insertion opens", rig.setpoint(np.array([11, -6, 0]))
    yield "the wrong fault, refused", rig.link.clear_fault(Fault.ESTOP)
    yield from (("", b"") for _ in range(8))
    yield "the fault cleared", rig.link.clear_fault(Fault.LIMIT)
    yield from (("", b"") for _ in range(8))
    yield "its position named", rig.link.set_position(0, -16_000)
    yield from (("", b"") for _ in range(8))
    yield "arm", rig.link.arm()
    yield from (("", b"") for _ in range(6))
    yield "disarm", rig.link.disarm()
    yield from (("", b"") for _ in range(8))


def exchange(rig: BoardRig) -> list[dict[str, object]]:
    """The milliseconds in which something was said."""
    said = []
    for what, data in script(rig):
        limits = rig.inputs.get("limit_bits", 0)
        answer = rig.slice(data)
        pieces = [{"at_us": at_us, "hex": piece.hex()} for piece, at_us in answer.timed_frames()]
        said.append({"at_us": rig.time_us, "what": what, "limit_bits": limits, "to_board": data.hex(), "from_board": pieces})
    return [one for one in said if one["to_board"] or one["from_board"]]


def main() -> None:
    """Write the file."""
    rig = BoardRig("avr", "atmega2560")
    try:
        turns = exchange(rig)
    finally:
        rig.close()
    about = (
        "Recorded: seldinger-atmega2560.elf in simavr and the client, limits of tests/sim/board_rig.py. at_us: end of "
        "the millisecond in which to_board was sent; of from_board: when the piece had left the board."
    )
    rows = ",\n".join(json.dumps(turn) for turn in turns)
    head = f'{{"about": {json.dumps(about)},\n"events": {json.dumps(rig.events)},\n"turns": [\n'
    PATH.write_text(f"{head}{rows}\n]}}\n", encoding="utf-8")
    print(f"{PATH}: {len(turns)} turns")


if __name__ == "__main__":
    main()
