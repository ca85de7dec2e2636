"""Serve the page: of a running rig, of a simulated rig started for it, or of a recording, until SIGINT or SIGTERM."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from host.recordings.recording import RecordingFile
from host.recordings.writer import new_recording_path
from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet
from host.view.live import LiveRig
from host.view.replay import Replay, read_findings
from host.view.server import ADDRESS, ViewServer
from host.view.source import Source
from protocol.errors import InputError
from protocol.rig_file import load_rig
from protocol.zenoh_session import Session

Report = Callable[[str], None]
# How often the processes of a simulated rig are looked at.
WATCH_S = 0.5
PROCESSES = {
    "rig": "the simulated hardware",
    "host": "the model process, which records,",
    "realtime": "the realtime process",
}


def serve(source: Source, port: int, title: str, report: Report) -> None:
    """Serve `source` on 127.0.0.1 until SIGINT. Raises InputError for a port that is in use."""
    check_port(port)
    server = ViewServer(source, port)
    # Compiles the models, which Ctrl-C ends at once here; in the server it would wait for them.
    source.frame()
    report(f"{title}: {page_address(port)}  (Ctrl-C ends it)")
    try:
        server.serve()
    except KeyboardInterrupt:  # the server passes the signal on that has ended it
        return
    except SystemExit:
        raise InputError("--port", port, "a port that is free") from None


def page_address(port: int) -> str:
    """The page's address for a browser of this machine."""
    return f"http://{ADDRESS}:{port}/"


def check_port(port: int) -> None:
    """Raise InputError if the page's port is in use, before a rig is started for it."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((ADDRESS, port))
        except OSError as error:
            raise InputError("--port", port, f"a free port ({error.strerror})") from None


def serve_rig(rig_file: Path, port: int, report: Report) -> None:
    """Serve the running rig of `rig_file`. Raises InputError."""
    rig = load_rig(rig_file)
    with Session.of_rig(rig) as session, contextlib.closing(LiveRig(rig, session)) as source:
        serve(source, port, f"rig {rig.name}", report)


def serve_recording(recording: RecordingFile, speed: float, diagnosis: str | None, port: int, report: Report) -> None:
    """Serve a recording at `speed` times real time, with the windows of the verdict in JSON file `diagnosis` marked.

    Raises: InputError.
    """
    findings = None if diagnosis is None else read_findings(diagnosis)
    serve(Replay(recording, speed, findings), port, str(recording.path), report)


@contextlib.contextmanager
def _watched(fleet: Fleet, report: Report) -> Iterator[None]:
    """Report each process of the simulated rig that ends by itself."""
    ending = threading.Event()

    def watch() -> None:
        said: set[str] = set()
        while not ending.wait(WATCH_S):
            for name in set(fleet.dead()) - said:
                said.add(name)
                report(f"{PROCESSES[name]} has ended by itself ({fleet.last_log_line(name)}); Ctrl-C, then start again")

    thread = threading.Thread(target=watch, name="watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


@contextlib.contextmanager
def simulated_rig(rig_file: Path, directory: Path, report: Report) -> Iterator[Path]:
    """Run the simulated rig of `rig_file`, recorded into `directory`; gives its rig file, with an endpoint of its own."""
    report("starting the simulated rig")
    recording = new_recording_path(directory, "view")
    try:
        with Fleet(DemoSettings(rig_file=rig_file), recording, own_folder=True) as fleet:
            fleet.wait_for_state()
            if load_rig(rig_file).local.endpoint != fleet.endpoint:
                report(f"another rig has the rig file's folder; commands to this one need --rig {fleet.rig_file}")
            with _watched(fleet, report):
                yield fleet.rig_file
    finally:
        if recording.exists():
            report(f"recording: {recording}")
