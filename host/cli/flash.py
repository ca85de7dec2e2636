"""`seldinger flash --port PORT --rig FILE`: builds the firmware for the rig's board and writes it through avrdude."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from protocol.board_pins import definitions
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Pins, load_rig
from sim.board import FIRMWARE_DIR


class Programmer(NamedTuple):
    """How avrdude reaches a board: its names for the part and the boot loader, and the loader's speed."""

    part: str
    protocol: str
    baud: int


PROGRAMMERS = {"atmega2560": Programmer("m2560", "wiring", 115200), "atmega328p": Programmer("m328p", "arduino", 115200)}
TIMEOUT_S = 180


def flash(
    port: Annotated[str, typer.Option(help="Serial port of the board, as /dev/ttyACM0 or /dev/serial/by-id/...")],
    rig: Annotated[Path, typer.Option(help="Rig file; its [board.pins] are built in.")] = SIMULATED_RIG,
    mcu: Annotated[str, typer.Option(help="atmega2560 or atmega328p; another than the rig file's: its usual pins.")] = "",
    baud: Annotated[int, typer.Option(help="Of the boot loader; 0: the usual one of this board.")] = 0,
    image: Annotated[Path | None, typer.Option(help="ELF file to write, instead of building one.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Build, and show the command only.")] = False,
) -> None:
    """Build the firmware and write it to the board. The stages must be free to stand still: the board resets."""
    if mcu and mcu not in PROGRAMMERS:
        raise InputError("--mcu", mcu, " or ".join(PROGRAMMERS))
    pins = load_rig(rig).board.pins
    if mcu and mcu != pins.mcu:
        pins = Pins.model_validate({"mcu": mcu})
    if shutil.which("avrdude") is None:
        raise InputError("avrdude", "no such program", "avrdude on the PATH (Debian: apt install avrdude)")
    if not Path(port).exists() and not dry_run:
        raise InputError(
            "--port", port, f"a serial port that is there; found {', '.join(ports()) or 'none on this machine'}"
        )
    elf = image or built(pins)
    if not elf.is_file():
        raise InputError("--image", str(elf), "an ELF file of the firmware")
    command = avrdude_command(pins.mcu, port, elf, baud)
    print("seldinger: " + " ".join(command), file=sys.stderr)
    if dry_run:
        return
    try:
        status = subprocess.run(command, timeout=TIMEOUT_S, check=False).returncode
    except subprocess.TimeoutExpired:
        print(f"seldinger: avrdude did not end within {TIMEOUT_S} s; is another program holding {port}?", file=sys.stderr)
        raise typer.Exit(1) from None
    if status:
        print(
            f"seldinger: avrdude ended with status {status}: nothing else may hold {port}, and the board must have an "
            f"{pins.mcu}",
            file=sys.stderr,
        )
        raise typer.Exit(1)
    print("seldinger: written and verified; now `seldinger check-device board`", file=sys.stderr)


def ports() -> list[str]:
    """Serial ports that are there, by their lasting names where they have one."""
    named = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*")) if Path("/dev/serial/by-id").is_dir() else []
    return named or sorted(str(path) for pattern in ("ttyACM*", "ttyUSB*") for path in Path("/dev").glob(pattern))


def avrdude_command(mcu: str, port: str, elf: Path, baud: int = 0) -> list[str]:
    """The call of avrdude that writes and verifies the flash memory of `mcu`; -D: boot loaders erase page by page."""
    programmer = PROGRAMMERS[mcu]
    return [
        "avrdude",
        "-p",
        programmer.part,
        "-c",
        programmer.protocol,
        "-P",
        port,
        "-b",
        str(baud or programmer.baud),
        "-D",
        "-U",
        f"flash:w:{elf}:e",
    ]


def built(pins: Pins) -> Path:
    """The firmware's ELF for these pins, built if stale. Raises InputError where that cannot be."""
    for tool in ("make", "avr-gcc"):
        if shutil.which(tool) is None:
            raise InputError(tool, "no such program", "the AVR tool chain (Debian: gcc-avr avr-libc make), or --image FILE")
    folder, options = "build", list[str]()
    if pins != Pins.model_validate({"mcu": pins.mcu}):
        folder = f"build/pins-{pins.outputs}{pins.output_shift}{pins.encoders}{pins.switches}"
        options = [f"BUILD={folder}", f"PINS={' '.join(definitions(**pins.model_dump()))}"]
    target = f"{folder}/seldinger-{pins.mcu}.elf"
    command = ["make", "--silent", "-C", str(FIRMWARE_DIR), target, *options]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        said = [line for line in result.stderr.splitlines() if "error" in line.lower()] or ["make failed"]
        raise InputError("firmware", said[0], f"sources that build (`make -C firmware {target}`)")
    return FIRMWARE_DIR / target
