"""`seldinger reproduce`: the thesis' figures again, mechanics or control, as one page with a verdict each."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.report.figure_page import WORDS, as_json
from protocol.errors import InputError

# part -> module with run(directory, quick, progress) -> (sections, path of the report); imported only when asked for
PARTS = {"mechanics": "host.studies.reproduction.mechanics", "control": "host.studies.reproduction.control"}


def reproduce(
    part: Annotated[str, typer.Argument(help="mechanics or control")],
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Shorter runs: for a look, not for figures.")] = False,
    directory: Annotated[Path, typer.Option("--dir", help="Where the report goes.")] = Path("runs"),
) -> None:
    """Reproduce the thesis' figures; one section a figure, each with its verdict."""
    if part not in PARTS:
        raise InputError("part", part, " or ".join(PARTS))

    def progress(text: str) -> None:
        print(f"reproduce {part}: {text}", file=sys.stderr)

    sections, report = importlib.import_module(PARTS[part]).run(directory, quick, progress)
    if json:
        write_json(as_json(sections, report))
        return
    for section in sections:
        print(f"{section.title:<34} {WORDS[section.verdict]:<17} {section.says}")
    print(f"report: {report}")
