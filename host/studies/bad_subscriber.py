"""Subscribers of all kinds: one that stops reading, one that floods queries, ones that are killed, a view with its pages."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh
from websockets import Origin
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import request_key
from protocol.zenoh_session import Session

KINDS = {
    "frozen": "a subscriber to everything stops reading",
    "flooding": "queries as fast as they go",
    "leaving": "subscribers come and are killed",
    "view": "a view, with a page that reads and two that do not",
}
_LIFE_S = 0.2
_RIG = SIMULATED_RIG


def misbehave(kind: str, rig: str, endpoint: str) -> None:
    """Subscribe to all and read, for ever; `flooding` asks for rubbish as well, as fast as it can; `view` serves pages."""
    session = Session(rig, [], [endpoint])
    if kind == "view":
        _view(session)
        return
    everything = session.everything()
    print("up", flush=True)
    rubbish = (b"", b"\0" * 200, os.urandom(60_000))
    while True:
        everything.take()
        if kind != "flooding":
            time.sleep(0.01)
            continue
        for junk in rubbish:
            session.zenoh.get(
                request_key(rig, "flood"),
                payload=junk,
                timeout=0.2,
                handler=zenoh.handlers.RingChannel(1),
                congestion_control=zenoh.CongestionControl.DROP,
            )


def _view(session: Session) -> None:
    from host.view.live import LiveRig  # the view and its models load for seconds: only for this kind
    from host.view.server import ADDRESS, ViewServer

    with socket.socket() as probe:
        probe.bind((ADDRESS, 0))
        port = int(probe.getsockname()[1])
    for reads in (True, False, False):
        threading.Thread(target=_page, args=(port, reads), daemon=True).start()
    ViewServer(LiveRig(load_rig(_RIG), session), port).serve()


def _page(port: int, reads: bool) -> None:
    """A page's socket, opened when the server is there; says when the first frame has come."""
    while True:
        try:
            with connect(
                f"ws://127.0.0.1:{port}/rig",
                origin=Origin(f"http://127.0.0.1:{port}"),
                proxy=None,
                max_queue=16 if reads else 1,
            ) as page:
                page.recv()
                page.recv()
                if reads:
                    print("up", flush=True)
                while True:
                    page.recv() if reads else time.sleep(60.0)
        except (OSError, ConnectionClosed):
            time.sleep(0.05)


class BadSubscriber:
    """A process that misbehaves; `tend` now and then keeps a leaving one leaving."""

    def __init__(self, kind: str, rig: str, endpoint: str) -> None:
        self._kind, self._arguments = kind, [kind, rig, endpoint]
        self._child = self._start()
        self._began = time.monotonic()
        self.lives = 1
        if kind == "frozen":
            time.sleep(0.3)
            self._child.send_signal(signal.SIGSTOP)

    def tend(self) -> None:
        """Kill a leaving one that has lived long enough, and start the next."""
        if self._kind == "leaving" and time.monotonic() - self._began > _LIFE_S:
            self.kill()
            self._child, self._began = self._start(), time.monotonic()
            self.lives += 1

    def kill(self) -> None:
        """Kill the process, so that it closes no connection properly."""
        self._child.kill()
        self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()

    def _start(self) -> subprocess.Popen[str]:
        child = subprocess.Popen(
            [sys.executable, "-m", "host.studies.bad_subscriber", *self._arguments], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        if child.stdout.readline() != "up\n":
            child.wait()
            raise OSError(f"bad subscriber: found that it ended at its start, wanted it to run ({self._kind})")
        return child


@contextmanager
def bad_subscriber(kind: str, rig: str, endpoint: str) -> Iterator[BadSubscriber | None]:
    """One while it lasts; None for any other word than those of KINDS."""
    made = BadSubscriber(kind, rig, endpoint) if kind in KINDS else None
    try:
        yield made
    finally:
        if made is not None:
            made.kill()


if __name__ == "__main__":
    misbehave(*sys.argv[1:4])
