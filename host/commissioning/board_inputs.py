"""The stepper board's switch inputs in words: what each means, what it reads now, what it reads at rest."""

from __future__ import annotations

from typing import NamedTuple

from protocol import board_pins
from protocol.rig_file import Pins
from protocol.serial_frames import AXES


class InputLine(NamedTuple):
    """One switch input of the board."""

    name: str  # "limit insertion min"; where both ends share an input "limits insertion"
    pin: str  # as printed on the board
    hit: bool  # as the board reports it
    normally_open: bool

    @property
    def contact(self) -> str:
        """Return the present state of the contact: "open" or "closed"."""
        return "closed" if self.hit == self.normally_open else "open"

    @property
    def contact_at_rest(self) -> str:
        """Return the state of the contact while nothing touches the switch: "open" or "closed"."""
        return "open" if self.normally_open else "closed"

    def __str__(self) -> str:
        return (
            f"{self.pin}: {'HIT' if self.hit else 'not hit'} (contact {self.contact}); "
            f"at rest: not hit (contact {self.contact_at_rest})"
        )


def input_lines(pins: Pins, inputs: int) -> list[InputLine]:
    """Return every switch input in the board's order. inputs: STATUS.inputs, one InputBit each, set when hit."""
    wires = [s for s in board_pins.signals(**pins.ports()) if s.name.startswith("limit") or s.name == "estop"]
    lines = []
    for wire in wires:
        kind, _, where = wire.name.partition(" ")
        named = where.replace(" ", "_") if where else kind
        switches = [name for name in board_pins.SWITCHES if name == named or name.startswith(f"{named}_")]
        hit = any(inputs >> board_pins.SWITCHES.index(name) & 1 for name in switches)
        lines.append(InputLine(wire.name, wire.pin, hit, switches[0] in pins.normally_open))
    return lines


def input_problems(pins: Pins, inputs: int) -> list[str]:
    """Return the inputs that keep the rig from moving, one line each; empty if there are none."""
    lines = {line.name: line for line in input_lines(pins, inputs)}
    problems = []
    estop = lines.pop("estop")
    if estop.hit:
        why = "pressed, or its switch is normally closed" if estop.normally_open else "pressed, or its wire is broken"
        problems.append(f"the emergency stop ({estop.pin}) is {estop.contact}: {why}")
    for axis in AXES:
        ends = [line for name, line in lines.items() if name.split()[1] == axis]
        if not all(line.hit for line in ends):
            continue
        where = " and ".join(line.pin for line in ends)
        cause = (
            "normally_open names switches that are normally closed"
            if ends[0].normally_open
            else f"a broken wire, or no switch fitted (then connect {where} to GND, or name it in normally_open)"
        )
        problems.append(f"both ends of {axis} ({where}) are hit, so that the axis cannot move: {cause}")
    return problems
