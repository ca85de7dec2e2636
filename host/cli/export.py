"""`seldinger export`: a recording as one Parquet or CSV table for each topic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, one_of, writable_folder
from host.cli.recordings import UnpackLimit, open_recording
from protocol.errors import InputError


def export(
    recording: Annotated[Path, typer.Argument(help="The recording (MCAP).")],
    folder: Annotated[Path, typer.Argument(help="Folder for the tables; made if it does not exist.")],
    to: Annotated[str, typer.Option(help="parquet or csv.")] = "parquet",
    json: Json = False,
    unpack_limit: UnpackLimit = None,
) -> None:
    """Write one table for each topic: `seldinger export REC.mcap --to parquet DIR`."""
    from host.recordings.export import FORMATS
    from host.recordings.export import export as export_tables

    one_of("--to", to, FORMATS)
    opened = open_recording(recording, unpack_limit)
    writable_folder("folder", folder)
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
