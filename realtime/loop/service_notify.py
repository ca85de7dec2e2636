"""The service manager's contract: ready, watchdog fed by a heartbeat that must move, stopping; and logs with fields."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping

JOURNAL_SOCKET = "/run/systemd/journal/socket"
_PRIORITIES = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


class ServiceNotifier:
    """Notifies the manager at NOTIFY_SOCKET (sd_notify(3)); without one, does nothing. Never raises, never blocks.

    environment: of the process, not inherited by its children's; now_s: monotonic clock.
    """

    def __init__(self, environment: Mapping[str, str] | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        environment = os.environ if environment is None else environment
        self._address = environment.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        usec = environment.get("WATCHDOG_USEC", "")
        self.watchdog_s = int(usec) * 1e-6 if self._address and mine and usec.isdigit() else 0.0
        self._now_s, self._heartbeat, self._fed_s = now_s, -1, -1e9

    def _send(self, text: str) -> bool:
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
                line.setblocking(False)
                line.connect(self._address)
                line.send(text.encode())
        except OSError:
            return False
        return True

    def ready(self, status: str) -> bool:
        """Report that the service has started, with a status line."""
        return self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> bool:
        """Send the status line that `systemctl status` shows."""
        return self._send(f"STATUS={status}")

    def stopping(self) -> bool:
        """Report that the service has begun to stop."""
        return self._send("STOPPING=1")

    def beat(self, heartbeat: int) -> bool:
        """Feed the watchdog, if `heartbeat` (a count of the loop's periods) has moved since it was fed last.

        To be called several times within `watchdog_s`; feeds at most four times in it. A loop that stands still is
        thus found by the manager, however well the thread that calls this does.
        """
        now_s = self._now_s()
        if self.watchdog_s <= 0 or heartbeat == self._heartbeat or now_s - self._fed_s < self.watchdog_s / 4:
            return False
        self._heartbeat, self._fed_s = heartbeat, now_s
        return self._send("WATCHDOG=1")


class JournalHandler(logging.Handler):
    """Log records to journald with fields (PRIORITY, SELDINGER_SOURCE, CODE_FUNC), by its own datagram protocol."""

    def __init__(self, path: str = JOURNAL_SOCKET) -> None:
        super().__init__()
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._line.connect(path)

    def emit(self, record: logging.LogRecord) -> None:
        """Sends the record; one that the journal does not take is lost."""
        source, _, text = record.getMessage().partition(": ")
        fields = {
            "MESSAGE": record.getMessage(),
            "PRIORITY": str(_PRIORITIES.get(record.levelno, 6)),
            "SYSLOG_IDENTIFIER": record.name,
            "SELDINGER_SOURCE": source if text else "",
            "CODE_FUNC": record.funcName or "",
        }
        try:
            self._line.send(b"".join(_field(name, value) for name, value in fields.items() if value))
        except OSError:
            self.handleError(record)


def _field(name: str, value: str) -> bytes:
    """One field: NAME=value, or with a length where the value has line ends."""
    data = value.encode()
    if b"\n" not in data:
        return name.encode() + b"=" + data + b"\n"
    return name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"


def log_handler(environment: Mapping[str, str] | None = None) -> logging.Handler:
    """For journald where the manager connected standard error to it, else for standard error."""
    environment = os.environ if environment is None else environment
    if environment.get("JOURNAL_STREAM"):
        try:
            return JournalHandler()
        except OSError:
            pass
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(name)s %(levelname)s %(message)s"))
    return handler
