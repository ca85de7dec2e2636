"""The core as the threads of a process use it: one step at a time, and messages in the order in which they arose."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from protocol.topics import Log, Message
from realtime.core.rig_core import Arrived, Leaving, RigCore, Tick
from realtime.loop.loop_thread import NativeLoop
from realtime.loop.mailbox import Mailbox

logger = logging.getLogger("seldinger.realtime")


class SharedCore:
    """A RigCore with a lock, connected with the compiled loop that ticks.

    Args:
        core: the rig's core.
        loop: the loop that reads the core's records and writes to the board.
        mailboxes: through which the loop reads the records, by name.
        now_ns: clock of all stamps.
        publish: takes topic and message, one thread at a time.
    """

    def __init__(
        self,
        core: RigCore,
        loop: NativeLoop,
        mailboxes: dict[str, Mailbox],
        now_ns: Callable[[], int],
        publish: Callable[[str, Message], None],
    ) -> None:
        self._core, self._loop, self._mailboxes, self._now_ns, self._publish = core, loop, mailboxes, now_ns, publish
        self._lock, self._publish_lock = threading.Lock(), threading.Lock()
        self._unpublished: list[tuple[str, Message]] = []

    def step(self, arrived: Arrived) -> Leaving:
        """Step the core with all ticks that have run since the last step, and publish its messages."""
        leaving = self.take(arrived)
        with self._publish_lock:
            messages, self._unpublished = self._unpublished, []
            for topic, message in messages:
                if isinstance(message, Log):
                    logger.log(getattr(logging, message.level.upper()), "%s: %s", message.source, message.text)
                self._publish(topic, message)
        return leaving

    def take(self, arrived: Arrived, wait_s: float = -1.0) -> Leaving:
        """Step the core; its messages wait for the next `step`.

        Raises TimeoutError where another thread works in the core for longer than `wait_s` (-1: waits without a limit).
        """
        if not self._lock.acquire(timeout=wait_s):
            raise TimeoutError
        try:
            records = self._loop.telemetry.drain()
            outputs = records["outputs"]
            arrived.ticks = [Tick(int(number), outputs[i]) for i, number in enumerate(records["loop"]["tick"])]
            arrived.loop_runs = self._loop.alive
            leaving = self._core.step(self._now_ns(), arrived)
            self._send(leaving)
            self._unpublished += leaving.messages
        finally:
            self._lock.release()
        return leaving

    def shut_down(self, wait_s: float) -> None:
        """Disarm. If another thread uses the core for longer than `wait_s`, leave it as it is."""
        if self._lock.acquire(timeout=wait_s):
            try:
                self._send(self._core.shut_down())
            finally:
                self._lock.release()

    def _send(self, leaving: Leaving) -> None:
        for name in leaving.changed:
            self._mailboxes[name].publish()
        for frame in b"".join(leaving.frames).split(b"\0"):
            if frame:
                self._loop.send(frame + b"\0")
