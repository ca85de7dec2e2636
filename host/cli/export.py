"""`seldinger export`: a recording as one Parquet or CSV table for each topic."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.recordings.export import FORMATS
from host.recordings.export import export as export_tables
from host.recordings.recording import Recording
from protocol.errors import InputError


def open_recording(path: Path) -> Recording:
    """The recording at `path`, with a line on standard error where it is incomplete. Raises InputError."""
    try:
        recording = Recording(path)
    except ValueError as error:
        found, _, wanted = str(error).removeprefix(f"{path}: found ").partition(", wanted ")
        raise InputError(str(path), found, wanted) from None
    if recording.truncated or recording.damaged_chunks:
        print(
            f"seldinger: {path} is {'cut short' if recording.truncated else 'damaged'} "
            f"({recording.damaged_chunks} damaged chunks): using the messages that are intact",
            file=sys.stderr,
        )
    return recording


def export(
    recording: Annotated[Path, typer.Argument(help="the recording (MCAP)")],
    folder: Annotated[Path, typer.Argument(help="where the tables go; made if need be")],
    to: Annotated[str, typer.Option(help="parquet or csv")] = "parquet",
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Write one table for each topic: `seldinger export REC.mcap --to parquet DIR`."""
    if to not in FORMATS:
        raise InputError("to", to, f"one of {', '.join(FORMATS)}")
    opened = open_recording(recording)
    try:
        written = export_tables(opened, to, folder)
    except OSError as error:
        raise InputError(str(folder), error.strerror or str(error), "a folder that can be written to") from None
    if json:
        write_json(
            {
                "tables": {topic: rows for topic, rows in sorted(opened.topics.items())},
                "files": [str(path) for path in written],
                "truncated": opened.truncated,
            }
        )
        return
    for topic, rows in sorted(opened.topics.items()):
        print(f"{rows:9d} rows  {topic}")
    print(f"{len(written)} files in {folder}")
