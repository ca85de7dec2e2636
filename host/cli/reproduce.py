"""`seldinger reproduce`: reproduce the thesis' figures, mechanics or control, on one page with a verdict each."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Folder, Json, writable_folder
from protocol.errors import one_of

# part -> module with run(directory, quick, progress) -> (sections, path of the report); imported only when requested
PARTS = {"mechanics": "host.studies.reproduction.mechanics", "control": "host.studies.reproduction.control"}


def reproduce(
    part: Annotated[str, typer.Argument(help="mechanics or control.")],
    json: Json = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Run shorter; the figures are then not fit for publication.")
    ] = False,
    directory: Folder = Path("runs"),
) -> None:
    """Reproduce the thesis' figures: one section for each figure, with its verdict."""
    from host.report.figure_page import WORDS, as_json

    one_of("part", part, PARTS)
    writable_folder("--out", directory)

    def progress(text: str) -> None:
        print(f"reproduce {part}: {text}", file=sys.stderr)

    sections, report = importlib.import_module(PARTS[part]).run(directory, quick, progress)
    if json:
        write_json(as_json(sections, report))
        return
    for section in sections:
        print(f"{section.title:<34} {WORDS[section.verdict]:<17} {section.says}")
    print(f"report: {report}")
