"""The stop socket: a second way into the realtime process that needs neither the model process nor zenoh.

One line in, `stop` or `status`; one line of JSON out. `echo stop | nc -U /run/seldinger/stop.sock` is enough.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import socket
import socketserver
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.local_paths import SOCKET_MODE
from protocol.stop_client import peer_credentials

# A client that has not sent its line in this time is disconnected.
REQUEST_S = 1.0
LONGEST_REQUEST = 64
# With so many clients connected the oldest is disconnected, so that a stop always gets in.
MAX_CLIENTS = 32


@dataclass(frozen=True)
class Peer:
    """The program at the other end of the socket, as the kernel identifies it."""

    pid: int
    uid: int

    @property
    def commander(self) -> str:
        """Return the peer's name as a commander."""
        return f"socket-uid-{self.uid}"

    def __str__(self) -> str:
        try:
            user = pwd.getpwuid(self.uid).pw_name
        except KeyError:
            user = "unknown user"
        return f"{user} (user {self.uid}, process {self.pid})"


class _Request(socketserver.StreamRequestHandler):
    timeout = REQUEST_S
    server: _Server

    def handle(self) -> None:
        """Answer one line. Disconnect a client that sends no line, or leaves before the answer."""
        with contextlib.suppress(OSError):
            word = self.rfile.readline(LONGEST_REQUEST).strip().decode("ascii", "replace")
            pid, uid, _ = peer_credentials(self.connection)
            self.wfile.write(json.dumps(self.server.answer(word, Peer(pid, uid))).encode() + b"\n")


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(self, path: Path, answer: Callable[[str, Peer], dict[str, Any]]) -> None:
        self.answer = answer
        self._clients: deque[socket.socket] = deque()
        self._lock = threading.Lock()
        super().__init__(os.fspath(path), _Request)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give the client a thread of its own; disconnect the oldest where too many are connected."""
        with self._lock:
            self._clients.append(request)
            oldest = self._clients.popleft() if len(self._clients) > MAX_CLIENTS else None
        if oldest is not None:
            with contextlib.suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Remove a client from the list and close its connection."""
        with self._lock, contextlib.suppress(ValueError):
            self._clients.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the failure of one client; only its own connection ends."""


class StopListener:
    """Listens at `path` from `start` to `close`.

    Args:
        path: of the socket, in a folder that only the rig's user can write. A socket that no program listens at is replaced.
        stop: stops the rig and returns what it did; called on a thread of its own.
        status: returns the rig's state.

    Raises:
        OSError: another realtime process listens there.
    """

    def __init__(self, path: Path, stop: Callable[[Peer], dict[str, Any]], status: Callable[[], dict[str, Any]]) -> None:
        self._path, self._stop, self._status = path, stop, status
        _remove_stale(path)
        self._server = _Server(path, self._answer)
        path.chmod(SOCKET_MODE)
        self._inode = path.stat().st_ino
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="stop", daemon=True)

    def start(self) -> None:
        """Start the thread that answers."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, and remove the socket if it is still this one."""
        if self._thread.is_alive():
            self._server.shutdown()
        self._server.server_close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()

    def _answer(self, word: str, peer: Peer) -> dict[str, Any]:
        if word == "stop":
            return self._stop(peer)
        if word == "status":
            return self._status()
        return {"error": f"found {word!r}, wanted stop or status"}


def _remove_stale(path: Path) -> None:
    """Remove the socket of a process that is dead."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise OSError(f"{path}: found {error.strerror or error}, wanted a socket that can be replaced") from None
    raise OSError(f"{path}: found another realtime process of this rig, wanted none; stop it first")
