"""`seldinger rig check FILE`: check a rig file and show its effective configuration."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json
from protocol.catheter import load_catheter, unusual_parameters
from protocol.errors import InputError
from protocol.rig_file import Rig, catheter_problems, parse_rig, problems_of, read_rig_data, unusual_values
from protocol.usual_values import UnusualValue

rig = typer.Typer(help="Check a rig file; show the effective configuration.", no_args_is_help=True)


@rig.callback()
def _group() -> None:
    """Group the commands on rig files."""


@rig.command()
def check(
    file: Annotated[Path, typer.Argument(help="Rig file (TOML).")],
    json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only mistakes.")] = False,
) -> None:
    """Check FILE and show its effective configuration. Exit status 2 and a line for each mistake.

    An accepted value that is probably in another unit gets a warning, with exit status 0.
    """
    data = read_rig_data(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnusualValue)  # printed below, and part of the JSON
        _refuse_mistakes(file, data)
        good = parse_rig(data, str(file))
        of_catheter = unusual_parameters(load_catheter(good.catheter.name))
    suspect = [*unusual_values(good), *(f"{good.catheter.name}: {line}" for line in of_catheter)]
    if json:
        write_json({"file": str(file), "good": True, "unusual": suspect, "configuration": good.effective()})
    elif not quiet:
        _show(good, data)
    for line in suspect:
        print(f"seldinger: warning: {file}: {line}", file=sys.stderr)
    if not quiet and not json:
        print(f"{good.name}: good" + (f", {len(suspect)} unusual" if suspect else ""), file=sys.stderr)


def _refuse_mistakes(file: Path, data: dict[str, Any]) -> None:
    """Print a line for each mistake in the rig file; exit with status 2 if there is one."""
    problems = problems_of(data)
    if not problems:
        read = parse_rig(data, str(file))
        problems = [*catheter_problems(read), *_device_problems(read)]
        if read.network.listen:
            from host.security.keys_check import keys_problems

            problems += keys_problems(Path(read.network.keys), read.network.listen)
    for problem in problems:
        print(f"seldinger: {file}: {problem}", file=sys.stderr)
    if problems:
        raise typer.Exit(2)


def _device_problems(read: Rig) -> list[str]:
    """The line with which the realtime process would refuse the kinds of the rig's devices, if it would."""
    from realtime.core.device_sources import check_kinds

    try:
        check_kinds(read)
    except InputError as error:
        return [str(error)]
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
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for row in _rows(good.effective(), data):
        table.add_row(*row)
    Console(highlight=False).print(table)
