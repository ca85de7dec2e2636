"""`seldinger view`: the running rig on a page of this machine."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Folder, Json, RigFile, writable_folder
from protocol.rig_file import SIMULATED_RIG


def view(
    rig: RigFile = SIMULATED_RIG,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="Port of the page, on 127.0.0.1.")] = 8447,
    simulated: Annotated[bool, typer.Option("--simulated", help="Start the simulated rig too, and record it.")] = False,
    directory: Folder = Path("runs"),
    json: Json = False,
) -> None:
    """Show the running rig in a browser (shape, force, safety, timing), with buttons to drive it."""
    from host.view.serve import check_port, page_address, serve_rig, simulated_rig

    def report(line: str) -> None:
        print(line, file=sys.stderr)

    check_port(port)
    if simulated:
        writable_folder("--out", directory)
    if json:
        write_json({"url": page_address(port)})
        sys.stdout.flush()
    with simulated_rig(rig, directory, report) if simulated else contextlib.nullcontext(rig) as rig_file:
        serve_rig(rig_file, port, report)
