"""A small service manager with systemd's contract (notify, watchdog, restart limit), for tests and for containers."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ServiceSettings:
    """As in a unit: command, WatchdogSec, TimeoutStartSec, TimeoutStopSec, RestartSec, StartLimitBurst."""

    command: Sequence[str]
    watchdog_s: float = 2.0
    start_s: float = 180.0
    stop_s: float = 3.0
    restart_s: float = 1.0
    burst: int = 3


class Supervisor:
    """Runs one service. `turn` again and again; `history` tells, in words, what has happened. Use as a context."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings, self.history, self.status = settings, list[str](), ""
        self.ready = self.failed = False
        self.starts = 0
        self._folder = tempfile.TemporaryDirectory(prefix="seldinger-supervisor-")
        self._path = str(Path(self._folder.name) / "notify")
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._line.bind(self._path)
        self._process: subprocess.Popen[bytes] | None = None
        self._due_s = self._fed_s = 0.0

    @property
    def pid(self) -> int:
        """Of the service, 0 while it does not run."""
        return self._process.pid if self._process is not None and self._process.poll() is None else 0

    def turn(self) -> None:
        """Start what is due, hear what was said, end what is silent."""
        now_s = time.monotonic()
        if self._process is None:
            if not self.failed and now_s >= self._due_s:
                self._start(now_s)
            return
        self._hear(now_s)
        if self._process.poll() is not None:
            self._ended(f"ended with status {self._process.returncode}", self._process.returncode != 0, now_s)
        elif now_s - self._fed_s > (self.settings.watchdog_s if self.ready else self.settings.start_s):
            what = "watchdog" if self.ready else "start timeout"
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()
            self._ended(what, True, now_s)

    def _start(self, now_s: float) -> None:
        usec = str(round(self.settings.watchdog_s * 1e6))
        environment = {**os.environ, "NOTIFY_SOCKET": self._path, "WATCHDOG_USEC": usec}
        environment.pop("WATCHDOG_PID", None)
        self._process = subprocess.Popen(list(self.settings.command), env=environment, stdin=subprocess.DEVNULL)
        self.starts += 1
        self.ready, self._fed_s = False, now_s
        self.history.append("started")

    def _hear(self, now_s: float) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                for word in self._line.recv(4096).decode("utf-8", "replace").split("\n"):
                    self._take(word, now_s)

    def _take(self, word: str, now_s: float) -> None:
        key, _, value = word.partition("=")
        if key == "READY":
            self.ready, self._fed_s = True, now_s
            self.history.append("ready")
        elif key == "WATCHDOG":
            self._fed_s = now_s
        elif key == "STATUS":
            self.status = value
        elif key == "STOPPING":
            self.history.append("stopping")

    def _ended(self, why: str, failure: bool, now_s: float) -> None:
        self.history.append(why)
        self._process, self.ready = None, False
        self._due_s = now_s + self.settings.restart_s
        if not failure or self.starts >= self.settings.burst:
            self.failed = True
            self.history.append("given up" if failure else "done")

    def run_until(self, done: object, seconds: float) -> bool:
        """Turns until `done()` is true, for `seconds` at most."""
        assert callable(done)
        give_up_s = time.monotonic() + seconds
        while time.monotonic() < give_up_s:
            self.turn()
            if done():
                return True
            time.sleep(0.01)
        return False

    def stop(self) -> int | None:
        """SIGTERM, and SIGKILL after `stop_s`; the exit status."""
        if self._process is None:
            return None
        self._process.terminate()
        try:
            status: int | None = self._process.wait(self.settings.stop_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        self._hear(time.monotonic())
        self._process = None
        return status

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
        self._line.close()
        self._folder.cleanup()
