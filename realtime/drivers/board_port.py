"""The stepper board's serial port, at one file descriptor that stays the same while the cable is pulled and put back."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable

from realtime.drivers.transport import Transport, open_serial

RETRY_S = 0.2


class BoardPort:
    """An open port. The compiled loop writes to `fileno()` while it runs, so the descriptor is never closed.

    Args:
        path: the device.
        baud: its speed.
        timeout_s: how long to wait for the device (s).
        missing: gets one line at once where the device is not there, before the wait.

    Raises OSError where the port does not open in time.
    """

    def __init__(self, path: str, baud: int, timeout_s: float, missing: Callable[[str], None] = lambda line: None) -> None:
        self._path, self._baud = path, baud
        self._port = _opened(path, baud, timeout_s, missing)
        os.set_blocking(self._port.fileno(), False)

    def fileno(self) -> int:
        """Return the file descriptor of the port, which stays the same."""
        return self._port.fileno()

    def read(self, wait_s: float) -> bytes:
        """Return what has arrived, waiting for it at most `wait_s` (s). Raises OSError when the port is gone."""
        if not select.select([self.fileno()], [], [], wait_s)[0]:
            return b""
        data = self._port.read()
        if not data:
            raise OSError("serial port hung up (unplugged?)")
        return data

    def disconnect(self) -> None:
        """Connect the descriptor to nothing, so that writing to it has no effect."""
        with open(os.devnull, "r+b", buffering=0) as nowhere:
            os.dup2(nowhere.fileno(), self.fileno())

    def reconnect(self) -> bool:
        """Open the device again at the same descriptor; return False if it is not there."""
        try:
            found = open_serial(self._path, self._baud)
        except OSError:
            return False
        os.set_blocking(found.fileno(), False)
        os.dup2(found.fileno(), self.fileno())
        found.close()
        return True

    def close(self) -> None:
        """Close the board's serial port."""
        self._port.close()


def _opened(path: str, baud: int, timeout_s: float, missing: Callable[[str], None]) -> Transport:
    give_up, said = time.monotonic() + timeout_s, False
    while True:
        try:
            return open_serial(path, baud)
        except OSError as error:
            if time.monotonic() > give_up:
                raise
            if not said:
                said = True
                missing(f"board: {error}; waits for it, at most {timeout_s:g} s")
            time.sleep(RETRY_S)
