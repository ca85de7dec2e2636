"""Options that several commands share, checks of their values, and a try of the places for output before the work.

One name means one thing in all commands: --json prints one JSON object on standard output; --out is the folder for what the
command writes; --jobs is the number of processes at a time; --seed decides all random numbers; --rig is the rig's file.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import Description, InputError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]
RigFile = Annotated[Path, typer.Option("--rig", help="Rig file (TOML).")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
Board = Annotated[str, typer.Option(help="avr (the firmware's ELF in simavr), native, or auto.")]
Folder = Annotated[Path, typer.Option("--out", help="Folder for recording, report and other results; created if missing.")]
Jobs = Annotated[int, typer.Option("--jobs", help="Processes at a time; 0: one for each core.")]
RequestFile = Annotated[str, typer.Argument(help="The request: a JSON file, or - for standard input.")]
# For developers: the help does not list it.
Docs = Annotated[Path | None, typer.Option(help="Page of the documentation whose section is written.", hidden=True)]

SEEDS = (0, 2**31 - 1)
BOARDS = ("avr", "native", "auto")  # sim.board.KINDS, which takes the simulator's modules to import


def within(key: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return `value` if it lies from `low` to `high`. Raises InputError named `key`; NaN is refused."""
    if not low <= value <= high:
        raise InputError(key, value, f"{low:.12g} to {high:.12g}{f' ({unit})' if unit else ''}")
    return value


def checked_seed(value: int) -> int:
    """Return `value` if it can seed every generator. Raises InputError."""
    return int(within("--seed", value, *SEEDS))


def checked_effects(effects: Sequence[str] | None) -> tuple[str, ...]:
    """Return the effects to plant in the simulated rig. Raises InputError for one that `sim.effects` does not have."""
    from sim.effects import parse

    for text in effects or ():
        try:
            parse(text)
        except ValueError as error:
            found, _, wanted = str(error).partition(": found ")[2].partition(", wanted ")
            raise InputError(f"--effect {text}", Description(found), wanted) from None
    return tuple(effects or ())


def checked_jobs(value: int) -> int:
    """Return the number of processes for `--jobs`, at least 1. Raises InputError."""
    return int(within("--jobs", value, 0, 1024)) or os.cpu_count() or 1


def writable_file(key: str, path: Path) -> Path:
    """Return `path` if a file can be written there; its folder must exist. An existing file keeps its content.

    Raises:
        InputError: named `key`, with the system's reason.
    """
    try:
        existed = path.exists()
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise InputError(key, str(path), f"a file that can be written ({error.strerror or error})") from None
    return path


def writable_folder(key: str, path: Path) -> Path:
    """Make the folder `path` where it does not exist, and return it if files can be written there.

    Raises:
        InputError: named `key`, with the system's reason.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(key, str(path), f"a folder that can be written ({error.strerror or error})") from None
    return path


def plot_file(path: str | None) -> None:
    """Refuse a plot file that cannot be written. Raises InputError."""
    if path is None:
        return
    if Path(path).suffix.lower() != ".png":
        raise InputError("--plot", path, "a file name that ends in .png")
    writable_file("--plot", Path(path))
