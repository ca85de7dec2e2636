"""Draws docs/wiring.md's pictures from the pin table: `python -m host.commissioning.wiring_drawing docs/pictures`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from html import escape
from pathlib import Path

from protocol.board_pins import PROCESSORS, Signal, signals
from protocol.rig_file import Pins
from protocol.serial_frames import AXES

ROW, LEFT, RIGHT, WIDTH = 22, 250, 560, 900
COLOURS = {
    "step": "#1f5fa8",
    "direction": "#2a8a57",
    "enable": "#b3341f",
    "encoder": "#7a4fa3",
    "limit": "#8a6100",
    "limits": "#8a6100",
    "estop": "#b3341f",
    "GND": "#333333",
    "5V": "#c05000",
}


def _text(x: float, y: float, words: str, style: str = "", anchor: str = "start") -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" {style}>{escape(words)}</text>'


def _box(x: float, y: float, width: float, height: float, title: str) -> list[str]:
    return [
        f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="5" fill="#f6f6f2" stroke="#555"/>',
        _text(x + width / 2, y + 17, title, 'font-weight="bold"', "middle"),
    ]


def _wire(y: float, signal: Signal, terminal: str) -> list[str]:
    colour = COLOURS[signal.name.split()[0]]
    middle = y - 4
    name = signal.pin if signal.port_pin == signal.pin else f"{signal.pin}  ({signal.port_pin})"
    return [
        _text(LEFT - 10, y, name, "", "end"),
        f'<line x1="{LEFT}" y1="{middle}" x2="{RIGHT}" y2="{middle}" stroke="{colour}" stroke-width="2"/>',
        *(f'<circle cx="{x}" cy="{middle}" r="3" fill="{colour}"/>' for x in (LEFT, RIGHT)),
        _text((LEFT + RIGHT) / 2, middle - 3, signal.name, f'fill="{colour}" font-size="11"', "middle"),
        _text(RIGHT + 10, y, terminal),
    ]


def _devices(pins: Pins) -> list[tuple[str, list[tuple[Signal, str]]]]:
    """Return the blocks on the right side and their wires: (signal, terminal of the device)."""
    by_name = {signal.name: signal for signal in signals(**pins.ports())}
    ground, supply = Signal("GND", "GND", "GND"), Signal("5V", "5V", "5V")
    inverse = "low = powered" if pins.enable_active == "low" else "high = powered"
    pull = "5V" if pins.enable_active == "low" else "GND"
    blocks: list[tuple[str, list[tuple[Signal, str]]]] = [
        (
            "All three drivers",
            [
                (by_name["enable"], f"EN of all three ({inverse}), 10 kOhm to {pull}"),
                (supply, "VDD / VIO (logic supply)"),
                (ground, "GND (logic)"),
            ],
        )
    ]
    for axis in AXES:
        wires = [(by_name[f"step {axis}"], "STEP"), (by_name[f"direction {axis}"], "DIR  (high = backwards)")]
        wires += [(by_name[f"encoder {line} {axis}"], f"encoder {line}, 5 V and GND from the Arduino") for line in "AB"]
        ends = [name for name in by_name if name.startswith("limit") and axis in name.split()]
        for name in ends:
            last = name.rpartition(" ")[2]
            switches = f"{axis}_{last}" if last in ("min", "max") else f"{axis}_min"
            open_contact = switches in pins.normally_open
            kind = "NO" if open_contact else "NC"
            join = ", in parallel" if open_contact else ", in series"
            terminal = f"switch {last}" if last in ("min", "max") else f"switches min and max{join}"
            wires.append((by_name[name], f"{terminal} ({kind}), other end to GND"))
        blocks.append((f"Axis {axis}: driver, encoder, switches", wires))
    kind = "NO" if "estop" in pins.normally_open else "NC"
    blocks.append(("Emergency stop, second contact", [(by_name["estop"], f"contact ({kind}), other end to GND")]))
    return blocks


def board_drawing(pins: Pins) -> str:
    """The wiring of the board with these pins as the text of an SVG file."""
    y, body = 66, list[str]()
    for title, wires in _devices(pins):
        height = 26 + ROW * len(wires)
        body += _box(RIGHT, y, WIDTH - RIGHT - 15, height, title)
        for i, (signal, terminal) in enumerate(wires):
            body += _wire(y + 26 + ROW * i + 12, signal, terminal)
        y += height + 12
    board = PROCESSORS[pins.mcu].board
    frame = _box(15, 44, LEFT - 15, y - 44, board)
    usb = [_text(28, 86, "USB to the computer", 'font-size="11"')]
    heading = f"{board} ({pins.mcu}): wires by [board.pins]; inputs have the processor's pull-ups on"
    return _svg(WIDTH, y + 12, [_text(15, 26, heading, 'font-size="15" font-weight="bold"'), *frame, *usb, *body])


SUPPLY = (
    ("Supply 24 V +", "fuse", "contactor K1 (main contact)", "VMOT of all three drivers, 100 uF at each"),
    ("Supply 24 V -", "", "", "GND (motor) of all three drivers"),
    ("Supply 24 V +", "", "e-stop, first NC contact", "coil of K1 (diode across it) to supply -"),
    ("Arduino input estop", "", "e-stop, second NC contact", "Arduino GND"),
)


def supply_drawing() -> str:
    """The supply of the drivers and the emergency stop that cuts it, as the text of an SVG file."""
    body = [
        _text(
            15, 26, "The emergency stop cuts the drivers' supply and signals the board", 'font-size="15" font-weight="bold"'
        )
    ]
    for i, (source, first, second, sink) in enumerate(SUPPLY):
        y = 50 + 62 * i
        colour = COLOURS["GND"] if source.endswith("-") else COLOURS["5V"] if "24" in source else COLOURS["estop"]
        body.append(f'<line x1="150" y1="{y + 21}" x2="610" y2="{y + 21}" stroke="{colour}" stroke-width="2"/>')
        body += _box(15, y, 150, 42, "") + [_text(90, y + 26, source, "", "middle")]
        for x, width, words in ((185, 60, first), (265, 210, second)):
            if words:
                body += _box(x, y, width, 42, "") + [_text(x + width / 2, y + 26, words, "", "middle")]
        body += _box(560, y, 325, 42, "") + [_text(722, y + 26, sink, 'font-size="12"', "middle")]
    return _svg(WIDTH, 50 + 62 * len(SUPPLY), body)


def _svg(width: int, height: float, body: Sequence[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height:g}" width="{width}" height="{height:g}" '
    style = 'font-family="DejaVu Sans, Helvetica, Arial, sans-serif" font-size="12.5" fill="#111">'
    return "\n".join([head + style, '<rect width="100%" height="100%" fill="white"/>', *body, "</svg>", ""])


def drawings() -> dict[str, str]:
    """File name and text of every picture of docs/wiring.md."""
    return {
        "wiring_mega.svg": board_drawing(Pins.model_validate({})),
        "wiring_uno.svg": board_drawing(Pins.model_validate({"mcu": "atmega328p"})),
        "wiring_supply.svg": supply_drawing(),
    }


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures")
    folder.mkdir(parents=True, exist_ok=True)
    for file_name, text in drawings().items():
        (folder / file_name).write_text(text, encoding="utf-8")
