"""`seldinger export`: a recording as one Parquet or CSV table for each topic."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Folder, Json, writable_folder
from host.cli.progress import Working
from host.cli.recordings import UnpackLimit, open_recording
from protocol.errors import InputError, one_of


def export(
    recording: Annotated[Path, typer.Argument(help="The recording (MCAP).")],
    out: Folder = Path("tables"),
    to: Annotated[str, typer.Option(help="parquet or csv.")] = "parquet",
    json: Json = False,
    unpack_limit: UnpackLimit = None,
) -> None:
    """Write one table for each topic: `seldinger export REC.mcap --to csv --out DIR`."""
    from host.recordings.export import FORMATS
    from host.recordings.export import export as export_tables

    one_of("--to", to, FORMATS)
    opened = open_recording(recording, unpack_limit)
    writable_folder("--out", out)
    try:
        with Working(f"tables of {recording.name}"):
            written = export_tables(opened, to, out)
    except OSError as error:
        raise InputError(str(out), error.strerror or str(error), "a folder that can be written to") from None
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
    print(f"{len(written)} files in {out}")
