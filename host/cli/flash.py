"""`seldinger flash`: build the firmware for the rig's board and write it through avrdude."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile, within
from host.cli.progress import Working
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig


def flash(
    port: Annotated[str, typer.Option(help="Serial port of the board, such as /dev/ttyACM0 or /dev/serial/by-id/...")],
    rig: RigFile = SIMULATED_RIG,
    mcu: Annotated[
        str, typer.Option(help="atmega2560 or atmega328p. If it is not the one of the rig file, its default pins are used.")
    ] = "",
    baud: Annotated[int, typer.Option(help="Baud rate of the boot loader; 0: the usual one of this board.")] = 0,
    image: Annotated[Path | None, typer.Option(help="ELF file to write instead of a new build.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Build the firmware and print the command; write nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Build the firmware and write it to the board. The board resets: make sure that the stages may stop."""
    from host.commissioning.firmware_flash import avrdude_command, built, check_avrdude, check_port, pins_of, write_firmware

    if not port.strip():
        raise InputError("--port", port, "the serial port of the board, such as /dev/ttyACM0")
    pins = pins_of(load_rig(rig), mcu)
    if not dry_run:
        check_avrdude()
        check_port(port)
    if image is not None and not _is_elf(image):
        raise InputError("--image", str(image), "an ELF file of the firmware")
    if baud:
        within("--baud", baud, 300, 4_000_000)
    command = avrdude_command(pins.mcu, port, image or built(pins), baud)
    print("seldinger: " + " ".join(command), file=sys.stderr)
    if json and dry_run:
        write_json({"command": command, "written": False})
    if dry_run:
        return
    try:
        with Working(f"writing {pins.mcu}"):
            write_firmware(command, port, pins.mcu)
    except RuntimeError as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    print("seldinger: written and verified; next: `seldinger check-device board`", file=sys.stderr)
    if json:
        write_json({"command": command, "written": True})


def _is_elf(path: Path) -> bool:
    """Whether `path` is a file that begins as an ELF does."""
    try:
        with path.open("rb") as file:
            return file.read(4) == b"\x7fELF"
    except OSError:
        return False
