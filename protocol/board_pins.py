"""Pins and polarities of the stepper board: which pin carries which signal, and the options the firmware is built with."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

from protocol.serial_frames import AXES

SWITCHES = (*(f"{axis}_{end}" for axis in AXES for end in ("min", "max")), "estop")  # in the order of InputBit
ENABLE_BIT = 6  # of the outputs: BOARD_ENABLE_BIT in firmware/src/board.h
ENABLE_PIN_WITH_SWITCHES = 4  # of the switches' port, where the outputs' port has no pin left


class Processor(NamedTuple):
    """What a processor has and needs: pins of its ports that are free on the board (bit masks), and usual choices.

    Of the outputs' port the firmware uses `outputs` moved up by the shift, of the other two the lowest pins.
    `shared_limits`: both limit switches of an axis share one input, and the enable line is on the port of the switches.
    """

    board: str
    ports: dict[str, int]
    names: dict[str, tuple[str, ...]]  # of the pins of each port, as printed on the Arduino; "" for none
    outputs: int
    encoders: int
    switches: int
    shared_limits: bool
    usual: dict[str, str | int]


def _digital(first: int, last: int) -> tuple[str, ...]:
    step = 1 if last >= first else -1
    return tuple(f"D{n}" for n in range(first, last + step, step))


# Arduino Mega: ports whose eight pins are all on its headers. Uno and Nano: D0 and D1 are the serial line.
PROCESSORS = {
    "atmega2560": Processor(
        "Arduino Mega 2560",
        dict.fromkeys("ABCFKL", 0xFF),
        {
            "A": _digital(22, 29),
            "B": (*_digital(53, 50), *_digital(10, 13)),
            "C": _digital(37, 30),
            "F": tuple(f"A{n}" for n in range(8)),
            "K": tuple(f"A{n}" for n in range(8, 16)),
            "L": _digital(49, 42),
        },
        0x7F,
        0x3F,
        0x7F,
        False,
        {"outputs": "A", "output_shift": 0, "encoders": "C", "switches": "L"},
    ),
    "atmega328p": Processor(
        "Arduino Uno or Nano",
        {"B": 0x3F, "C": 0x3F, "D": 0xFC},
        {"B": _digital(8, 13), "C": tuple(f"A{n}" for n in range(6)), "D": _digital(0, 7)},
        0x3F,
        0x3F,
        0x1F,
        True,
        {"outputs": "D", "output_shift": 2, "encoders": "C", "switches": "B"},
    ),
}


class Signal(NamedTuple):
    """One wire between the Arduino and the rig."""

    name: str  # "step insertion", "direction roll", "enable", "encoder A knob", "limit roll min", "estop"
    port_pin: str  # "PA0"
    pin: str  # as printed on the board, "D22"


def signals(mcu: str, outputs: str, output_shift: int, encoders: str, switches: str) -> list[Signal]:
    """Every signal of the board and its pin, in the order of firmware/src/board.h.

    mcu: of PROCESSORS. outputs, encoders, switches: port letters. output_shift: first pin of the outputs' port.
    """
    chip = PROCESSORS[mcu]

    def at(name: str, port: str, pin: int) -> Signal:
        return Signal(name, f"P{port}{pin}", chip.names[port][pin])

    found = [at(f"step {axis}", outputs, output_shift + i) for i, axis in enumerate(AXES)]
    found += [at(f"direction {axis}", outputs, output_shift + 3 + i) for i, axis in enumerate(AXES)]
    enable_place = (switches, ENABLE_PIN_WITH_SWITCHES) if chip.shared_limits else (outputs, output_shift + ENABLE_BIT)
    found.append(at("enable", *enable_place))
    found += [
        at(f"encoder {line} {axis}", encoders, 2 * i + j) for i, axis in enumerate(AXES) for j, line in enumerate("AB")
    ]
    if chip.shared_limits:
        found += [at(f"limits {axis}", switches, i) for i, axis in enumerate(AXES)]
    else:
        found += [at(f"limit {name.replace('_', ' ')}", switches, i) for i, name in enumerate(SWITCHES[:-1])]
    found.append(at("estop", switches, 3 if chip.shared_limits else 6))
    return found


def problem_of(
    mcu: str, outputs: str, output_shift: int, encoders: str, switches: str, normally_open: Sequence[str] = ()
) -> str:
    """What is wrong with these pins of `mcu`, as key, found and wanted; empty for good ones."""
    chip = PROCESSORS[mcu]
    chosen = {
        "outputs": (outputs, chip.outputs << output_shift),
        "encoders": (encoders, chip.encoders),
        "switches": (switches, chip.switches),
    }
    taken: dict[str, str] = {}
    for key, (port, mask) in chosen.items():
        if port not in chip.ports:
            return f"board.pins.{key}: found port {port!r}, wanted one of {', '.join(chip.ports)} of the {mcu}"
        if mask & ~chip.ports[port]:
            missing = next(bit for bit in range(16) if mask & ~chip.ports[port] & 1 << bit)
            return (
                f"board.pins.{key}: found pin P{port}{missing}, which the {mcu} has not free, "
                f"wanted another port or output_shift"
            )
        if port in taken:
            return f"board.pins.{key}: found port {port!r}, which has the {taken[port]}, wanted a port of its own"
        taken[port] = key
    return _problem_of_open(chip, normally_open)


def _problem_of_open(chip: Processor, normally_open: Sequence[str]) -> str:
    for name in normally_open:
        if name not in SWITCHES:
            return f"board.pins.normally_open: found {name!r}, wanted names of {', '.join(SWITCHES)}"
        axis, _, end = name.partition("_")
        other = f"{axis}_{'max' if end == 'min' else 'min'}"
        if chip.shared_limits and end and other not in normally_open:
            return (
                f"board.pins.normally_open: found {name} without {other}, wanted both or neither: "
                f"on the {chip.board} they share one input"
            )
    return ""


def definitions(
    mcu: str,
    outputs: str,
    output_shift: int,
    encoders: str,
    switches: str,
    enable_active: str = "low",
    normally_open: Sequence[str] = (),
    keep_enabled: bool = False,
) -> list[str]:
    """Options of the compiler that put these pins and polarities in the place of those in firmware/src/board.h."""
    definitions: dict[str, str | int] = {
        f"{mcu.upper()}_OUTPUTS": outputs,
        f"{mcu.upper()}_OUTPUT_SHIFT": output_shift,
        f"{mcu.upper()}_ENCODERS": encoders,
        f"{mcu.upper()}_SWITCHES": switches,
        "BOARD_ENABLE_ACTIVE_LOW": int(enable_active == "low"),
        "BOARD_NORMALLY_OPEN": sum(1 << SWITCHES.index(name) for name in set(normally_open)),
        "BOARD_KEEP_ENABLED": int(keep_enabled),
    }
    return [f"-D{word}={value}" for word, value in definitions.items()]


class Build(NamedTuple):
    """Where in firmware/ a build goes, and the variables of its make call."""

    folder: str
    variables: list[str]


def build_of(options: Sequence[str]) -> Build:
    """The build with these options of definitions(): the usual one in build/, every other in a folder of its own."""
    usual = {option for mcu, chip in PROCESSORS.items() for option in definitions(mcu, **chip.usual)}  # type: ignore[arg-type]
    if set(options) <= usual:
        return Build("build", [])
    folder = f"build/pins-{zlib.crc32(' '.join(options).encode()):08x}"
    return Build(folder, [f"BUILD={folder}", f"PINS={' '.join(options)}"])
