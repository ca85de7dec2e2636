"""Flash the stepper board: build the firmware for the rig's pins and write it through avrdude."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from protocol.errors import InputError
from protocol.rig_file import Pins, Rig
from sim.board import FIRMWARE_DIR


class Programmer(NamedTuple):
    """How avrdude reaches a board: its names for the part and the boot loader, and the loader's speed."""

    part: str
    protocol: str
    baud: int


PROGRAMMERS = {"atmega2560": Programmer("m2560", "wiring", 115200), "atmega328p": Programmer("m328p", "arduino", 115200)}
TIMEOUT_S = 180


def pins_of(rig: Rig, mcu: str = "") -> Pins:
    """Return the rig's pins, or the usual ones of `mcu` where that is another. Raises InputError for an unknown one."""
    if mcu and mcu not in PROGRAMMERS:
        raise InputError("--mcu", mcu, " or ".join(PROGRAMMERS))
    pins = rig.board.pins
    return Pins.model_validate({"mcu": mcu}) if mcu and mcu != pins.mcu else pins


def check_avrdude() -> None:
    """Raise InputError where avrdude is not installed."""
    if shutil.which("avrdude") is None:
        raise InputError("avrdude", "no such program", "avrdude on the PATH (Debian: apt install avrdude)")


def check_port(port: str) -> None:
    """Raise InputError where there is no such serial port, with those that there are."""
    if not Path(port).exists():
        raise InputError("--port", port, f"a serial port that exists; this machine has {', '.join(ports()) or 'none'}")


def write_firmware(command: Sequence[str], port: str, mcu: str) -> None:
    """Run avrdude. Raises RuntimeError with the likely cause where it fails or does not end."""
    try:
        status = subprocess.run(command, timeout=TIMEOUT_S, check=False).returncode
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"avrdude did not end within {TIMEOUT_S} s; does another program use {port}?") from None
    if status:
        raise RuntimeError(
            f"avrdude ended with status {status}: no other program may hold {port}, and the board must have an {mcu}"
        )


def ports() -> list[str]:
    """List this machine's serial ports, by their persistent names where they have one."""
    named = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*")) if Path("/dev/serial/by-id").is_dir() else []
    return named or sorted(str(path) for pattern in ("ttyACM*", "ttyUSB*") for path in Path("/dev").glob(pattern))


def avrdude_command(mcu: str, port: str, elf: Path, baud: int = 0) -> list[str]:
    """Return the avrdude command that writes and verifies the flash memory of `mcu`; -D: boot loaders erase page by page.

    Arguments: `baud`, of the boot loader; 0: the usual one of this board.
    """
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
    """Build the firmware for these pins where it is stale; return its ELF. Raises InputError where it cannot be built."""
    for tool in ("make", "avr-gcc"):
        if shutil.which(tool) is None:
            raise InputError(tool, "no such program", "the AVR tool chain (Debian: gcc-avr avr-libc make), or --image FILE")
    build = pins.build()
    target = f"{build.folder}/seldinger-{pins.mcu}.elf"
    command = ["make", "--silent", "-C", str(FIRMWARE_DIR), target, *build.variables]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        errors = [line for line in result.stderr.splitlines() if "error" in line.lower()] or ["make failed"]
        raise InputError("firmware", errors[0], f"sources that build (`make -C firmware {target}`)")
    return FIRMWARE_DIR / target
