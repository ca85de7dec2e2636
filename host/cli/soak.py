"""`seldinger soak`: the job for hours of virtual time; memory, clocks, steps and the recording stay as they must."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from host.cli.contract_io import write_json
from host.studies.reliability_page import write_section
from host.studies.soak import page_section
from host.studies.soak import soak as run_soak
from protocol.errors import InputError
from sim.board import KINDS, BoardUnavailable


def soak(
    minutes: Annotated[float, typer.Option(help="Of virtual time.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Of all noise.")] = 1,
    board: Annotated[str, typer.Option(help="avr (the ELF in simavr), native, or auto.")] = "native",
    record: Annotated[bool, typer.Option(help="Record it.")] = True,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    docs: Annotated[Path | None, typer.Option(help="Page whose section on the soak is to be written anew.")] = None,
) -> None:
    """Hold a force for MINUTES of virtual time. Exit status 1 when something did not stay as it must."""
    if not 0.1 <= minutes <= 10_000:
        raise InputError("--minutes", minutes, "0.1 to 10000")
    if board not in KINDS:
        raise InputError("--board", board, " or ".join(KINDS))
    with Progress(
        TextColumn("soak"), BarColumn(bar_width=30), TimeElapsedColumn(), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task("soak", total=1.0)
        try:
            result = run_soak(minutes, seed, board, lambda share: bar.update(task, completed=share), record)
        except BoardUnavailable as error:
            print(f"seldinger: {error}", file=sys.stderr)
            raise typer.Exit(1) from None
    section = page_section(result, minutes, seed, board + ("" if record else " --no-record"))
    print(section, file=sys.stderr)
    if docs is not None:
        write_section(docs, "soak-avr" if board == "avr" else "soak", section)
    if json:
        write_json(result.as_dict())
    raise typer.Exit(1 if result.problems else 0)
