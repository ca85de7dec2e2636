"""Pins of the stepper board: which port carries what, and the definitions that the firmware is built with."""

from __future__ import annotations

from typing import NamedTuple


class Processor(NamedTuple):
    """What a processor has and needs: pins of its ports that are free on the board (bit masks), and usual choices.

    Of the outputs' port the firmware uses `outputs` moved up by the shift, of the other two the lowest pins.
    """

    ports: dict[str, int]
    outputs: int
    encoders: int
    switches: int
    usual: dict[str, str | int]


# Arduino Mega: ports whose eight pins are all on its headers. Uno and Nano: D0 and D1 are the serial line.
PROCESSORS = {
    "atmega2560": Processor(
        dict.fromkeys("ABCFKL", 0xFF),
        0x7F,
        0x3F,
        0x7F,
        {"outputs": "A", "output_shift": 0, "encoders": "C", "switches": "L"},
    ),
    "atmega328p": Processor(
        {"B": 0x3F, "C": 0x3F, "D": 0xFC},
        0x3F,
        0x3F,
        0x0F,
        {"outputs": "D", "output_shift": 2, "encoders": "C", "switches": "B"},
    ),
}


def problem_of(mcu: str, outputs: str, output_shift: int, encoders: str, switches: str) -> str:
    """What is wrong with these ports of `mcu`, as key, found and wanted; empty for good ones."""
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
    return ""


def definitions(mcu: str, outputs: str, output_shift: int, encoders: str, switches: str) -> list[str]:
    """Options of the compiler that put these ports in the place of those in firmware/src/board.h."""
    words = {"OUTPUTS": outputs, "OUTPUT_SHIFT": output_shift, "ENCODERS": encoders, "SWITCHES": switches}
    return [f"-D{mcu.upper()}_{word}={value}" for word, value in words.items()]
