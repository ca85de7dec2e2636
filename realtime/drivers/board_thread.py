"""Wall clock: the thread that reads the stepper board's port, and finds it again when it was unplugged."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from realtime.drivers.board_port import RETRY_S, BoardPort

# Longest wait for bytes: how often the core takes a step while the board sends nothing.
_POLL_S = 0.005
logger = logging.getLogger("seldinger.realtime")


class BoardThread(threading.Thread):
    """A daemon thread with `start()` and `stop()`. The callbacks are called in this thread; what they raise ends it.

    Args:
        port: the board's open port.
        on_bytes: takes what arrived, `b""` where nothing did; called at least every 5 ms, every 0.2 s without a port.
        on_lost: takes the reason why the port is gone, once.
        on_found: called once the port is there again.
    """

    def __init__(
        self,
        port: BoardPort,
        on_bytes: Callable[[bytes], object],
        on_lost: Callable[[str], object],
        on_found: Callable[[], object],
    ) -> None:
        super().__init__(name="board", daemon=True)
        self._port, self._on_bytes, self._on_lost, self._on_found = port, on_bytes, on_lost, on_found
        self._stopping = threading.Event()
        self.failure: BaseException | None = None

    def stop(self, timeout_s: float = 1.0) -> None:
        """End the thread and wait for it."""
        self._stopping.set()
        if self.is_alive():
            self.join(timeout_s)

    def run(self) -> None:
        """Hand over what the board sends until `stop`."""
        try:
            while not self._stopping.is_set():
                try:
                    data = self._port.read(_POLL_S)
                except OSError as gone:
                    self._find_again(str(gone))
                else:
                    self._on_bytes(data)
        except Exception as failure:  # the process reads `failure` and ends
            self.failure = failure
            logger.exception("the board's thread failed")

    def _find_again(self, why: str) -> None:
        """Report the loss, and wait for the port. The loop continues to tick; its frames are lost in this time."""
        self._port.disconnect()
        self._on_lost(why)
        while not self._stopping.wait(RETRY_S):
            if self._port.reconnect():
                self._on_found()
                return
            self._on_bytes(b"")
