"""`seldinger play`: a recording on the page of the live view, with the windows of its diagnosis marked."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, within
from host.cli.recordings import UnpackLimit, open_recording


def play(
    recording: Annotated[Path, typer.Argument(help="The recording (MCAP).")],
    speed: Annotated[float, typer.Option(help="Speed relative to real time, 0.05 to 50.")] = 1.0,
    diagnosis: Annotated[str | None, typer.Option(help="JSON of `seldinger diagnose`; the page marks its windows.")] = None,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="Port of the page, on 127.0.0.1.")] = 8448,
    unpack_limit: UnpackLimit = None,
    json: Json = False,
) -> None:
    """Show a recording in a browser: play, pause, seek."""
    within("--speed", speed, 0.05, 50.0)
    # Loaded after the check: the server takes seconds.
    from host.view.serve import check_port, page_address, serve_recording

    check_port(port)
    opened = open_recording(recording, unpack_limit)
    if json:
        write_json({"url": page_address(port)})
        sys.stdout.flush()
    serve_recording(opened, speed, diagnosis, port, lambda line: print(line, file=sys.stderr))
