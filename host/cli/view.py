"""`seldinger view`: the running rig on a page of this machine."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from host.view.live import LiveRig
from host.view.server import ADDRESS, ViewServer
from host.view.source import Source
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.zenoh_session import Session


def serve(source: Source, port: int, what: str) -> None:
    """Serve `source` until SIGINT. Raises InputError for a port that is taken."""
    server = ViewServer(source, port)
    print(f"{what}: http://{ADDRESS}:{port}/  (Ctrl-C ends it)", file=sys.stderr)
    try:
        server.serve()
    except SystemExit:
        raise InputError("--port", port, "a port that is free") from None


@contextlib.contextmanager
def _simulated(rig: Path, directory: Path) -> Iterator[Path]:
    """The simulated rig, running; its rig file, with an endpoint of its own."""
    from host.recordings.recording import new_recording_path
    from host.run.demo import DemoSettings
    from host.run.wall_clock import Fleet

    print("starting the simulated rig (the first time it is compiled: a minute or two)", file=sys.stderr)
    recording = new_recording_path(directory, "view")
    try:
        with Fleet(DemoSettings(rig_file=rig), recording) as fleet:
            fleet.wait_until_heard()
            yield fleet.rig_file
    finally:
        print(f"recording: {recording}", file=sys.stderr)


def view(
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="Of the page, on 127.0.0.1.")] = 8447,
    simulated: Annotated[bool, typer.Option("--simulated", help="Start the simulated rig too, and record it.")] = False,
    directory: Annotated[Path, typer.Option("--dir", help="Where --simulated records.")] = Path("runs"),
) -> None:
    """Show the running rig in a browser: shape, force, safety, timing; arm, hold and stop it."""
    with contextlib.ExitStack() as stack:
        loaded = load_rig(stack.enter_context(_simulated(rig, directory)) if simulated else rig)
        session = stack.enter_context(Session(loaded.name, [], loaded.zenoh.connect))
        serve(stack.enter_context(contextlib.closing(LiveRig(loaded, session))), port, f"rig {loaded.name}")
