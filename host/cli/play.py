"""`seldinger play`: a recording on the page of the live view, with the windows of its diagnosis marked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.cli.export import open_recording
from host.cli.view import serve
from host.view.replay import Replay, read_findings


def play(
    recording: Annotated[Path, typer.Argument(help="The recording (MCAP).")],
    speed: Annotated[float, typer.Option(help="Times real time, 0.05 to 50.")] = 1.0,
    diagnosis: Annotated[str | None, typer.Option(help="JSON of `seldinger diagnose`: its windows are marked.")] = None,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="Of the page, on 127.0.0.1.")] = 8448,
) -> None:
    """Show a recording in a browser: play, pause, seek."""
    findings = None if diagnosis is None else read_findings(diagnosis)
    serve(Replay(open_recording(recording), speed, findings), port, str(recording))
