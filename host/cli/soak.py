"""`seldinger soak`: hold a force for hours of virtual time; check memory, clocks, steps and the recording."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import BOARDS, Board, Docs, Json, Seed, checked_seed, within, writable_file
from host.cli.progress import share_bar
from protocol.errors import one_of


def soak(
    minutes: Annotated[float, typer.Option(help="Length of the run in virtual time, minutes.")] = 30.0,
    seed: Seed = 1,
    board: Board = "native",
    record: Annotated[bool, typer.Option(help="Write a recording.")] = True,
    json: Json = False,
    docs: Docs = None,
) -> None:
    """Hold a force for MINUTES of virtual time. Exit status 1 when a check failed."""
    from host.studies.reliability_page import write_section
    from host.studies.soak import page_section
    from host.studies.soak import soak as run_soak
    from sim.board import BoardUnavailable

    within("--minutes", minutes, 0.1, 10_000)
    one_of("--board", board, BOARDS)
    checked_seed(seed)
    if docs is not None:
        writable_file("--docs", docs)
    with share_bar("soak") as progress:
        try:
            result = run_soak(minutes, seed, board, progress, record)
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
