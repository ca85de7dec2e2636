"""`seldinger rig check FILE`: is the rig file good, and what configuration comes of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from host.cli.contract_io import write_json
from host.security.keys_check import keys_problems
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.rig_file import Rig, parse_rig, problems_of, read_rig_data

rig = typer.Typer(help="The rig file: check it, show what it comes to.", no_args_is_help=True)
DISTAL_AGREES_M = 0.005


@rig.callback()
def _group() -> None:
    """The rig file."""


@rig.command()
def check(
    file: Annotated[Path, typer.Argument(help="Rig file (TOML).")],
    json: Annotated[bool, typer.Option("--json", help="One JSON object with the effective configuration.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say only what is wrong.")] = False,
) -> None:
    """Check FILE and show its effective configuration. Exit status 2 and a line for each mistake."""
    data = read_rig_data(file)
    problems = problems_of(data)
    if not problems:
        read = parse_rig(data, str(file))
        problems = catheter_problems(read)
        if read.network.listen:
            problems += keys_problems(Path(read.network.keys), read.network.listen)
    for problem in problems:
        print(f"seldinger: {file}: {problem}", file=sys.stderr)
    if problems:
        raise typer.Exit(2)
    good = parse_rig(data, str(file))
    if json:
        write_json({"file": str(file), "good": True, "configuration": good.effective()})
    elif not quiet:
        _show(good, data)


def catheter_problems(good: Rig) -> list[str]:
    """Where the named catheter is not known, or is not the one that the rest of the file speaks of."""
    try:
        catheter: Any = load_catheter(good.catheter.name)
    except (InputError, ValueError, OSError) as error:
        return [f"catheter.name: found {good.catheter.name!r}, wanted a catheter that ships or its file ({error})"]
    length_m = getattr(catheter, "distal_length_m", None)
    if length_m is not None and abs(length_m - good.catheter.distal_length_m) > DISTAL_AGREES_M:
        return [
            f"catheter.distal_length_m: found {good.catheter.distal_length_m}, wanted about {length_m}, which "
            f"{good.catheter.name} has"
        ]
    return []


def _rows(section: dict[str, Any], given: Any, prefix: str = "") -> list[tuple[str, str, str]]:
    rows = []
    for key, value in section.items():
        mine = given.get(key) if isinstance(given, dict) else None
        if isinstance(value, dict):
            rows += _rows(value, mine, f"{prefix}{key}.")
        else:
            rows.append((prefix + key, str(value), "" if mine is not None else "default"))
    return rows


def _show(good: Rig, data: dict[str, Any]) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for row in _rows(good.effective(), data):
        table.add_row(*row)
    Console(highlight=False).print(table)
    print(f"{good.name}: good", file=sys.stderr)
