"""SIGTERM and SIGINT of a process that serves: they interrupt its start at once, and later end its work in order."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


class EndSignals:
    """Handles SIGTERM and SIGINT of this process from its construction on; construct it on the main thread.

    asked: set by the first of these signals. The process looks at it between two steps of its work.
    """

    def __init__(self) -> None:
        self.asked = threading.Event()
        self._interrupts = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    @contextlib.contextmanager
    def interrupting(self) -> Iterator[None]:
        """Let a signal interrupt what runs inside, as the compiling of kernels does not look at `asked` for a minute.

        For a start during which nothing moves. An interruption does not leave this context as an exception: look at
        `asked` after it.
        """
        self._interrupts = True
        try:
            yield
        except BaseException:
            # A KeyboardInterrupt that is raised while code is compiled comes out as SystemError or another exception.
            if not self.asked.is_set():
                raise
        finally:
            self._interrupts = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.asked.set()
        if self._interrupts:
            self._interrupts = False
            raise KeyboardInterrupt
