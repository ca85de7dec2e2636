"""What a stop over the stop socket does: it stops the rig, or ends the loop where the core does not answer."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable
from typing import Any

from protocol.stop_client import CONFIRM_S, shows_stop
from protocol.topics import Command, Log, encode
from realtime.core.rig_core import Arrived, CommandRequest, Leaving, RigCore
from realtime.core.stop_listener import Peer
from realtime.loop.loop_thread import NativeLoop

# A stop waits so long for the core; then it ends the loop, and the board stops the stages by itself.
_CORE_BUSY_S = 0.05
logger = logging.getLogger("seldinger.realtime")


class StopPath:
    """Stop and status for the stop socket.

    Args:
        core: the rig's core.
        loop: the loop that writes to the board.
        take: takes the core one step further; raises TimeoutError where the core is busy for longer than the seconds given.
        now_ns: clock of all stamps.
    """

    def __init__(
        self, core: RigCore, loop: NativeLoop, take: Callable[[Arrived, float], Leaving], now_ns: Callable[[], int]
    ) -> None:
        self._core, self._loop, self._take, self._now_ns = core, loop, take, now_ns

    def status(self) -> dict[str, Any]:
        """Return the rig's phase, whether the loop runs, and the state of the board's link."""
        return {
            "rig": self._core.rig.name,
            "phase": self._core.phase.label,
            "loop_runs": self._loop.alive,
            "board_link": self._core.link.phase.value,
        }

    def stop(self, peer: Peer) -> dict[str, Any]:
        """Stop the rig for the program `peer`; return the action and whether the rig's state shows it.

        If the core does not take the command, because a thread that works in it hangs, the loop is ended: without
        set-points the board stops the stages after its dead-man time.
        """
        begin_ns, before = time.monotonic_ns(), self._core.phase
        try:
            self._take(self._stop_request(peer), _CORE_BUSY_S)
            while not self._confirmed and time.monotonic_ns() - begin_ns < CONFIRM_S * 1e9:
                time.sleep(0.001)
                self._take(Arrived(), _CORE_BUSY_S)
        except Exception as failure:  # a stop is not lost if the core fails in any way
            self._loop.stop()
            busy = isinstance(failure, TimeoutError)
            why = "the core does not answer" if busy else f"the core failed ({type(failure).__name__})"
            text = f"{why}: the loop was ended, the board stops the stages by its dead man"
            logger.error("stop socket: %s", text)
            return {**self.status(), "confirmed": False, "text": text}
        after_ms = (time.monotonic_ns() - begin_ns) * 1e-6
        text = f"{before.label}, {self._core.phase.label} after {after_ms:.1f} ms"
        return {**self.status(), "confirmed": self._confirmed, "after_ms": round(after_ms, 3), "text": text}

    def _stop_request(self, peer: Peer) -> Arrived:
        now_ns = self._now_ns()
        stop = Command(
            stamp_ns=now_ns,
            id=uuid.uuid4().hex,
            commander=peer.commander,
            lease="",
            expires_ns=now_ns,
            action="stop",
            target="none",
        )
        line = Log(stamp_ns=now_ns, level="warning", source="stop socket", text=f"stop from {peer}")
        return Arrived(requests=[CommandRequest(peer.commander, encode(stop))], log_lines=[line])

    @property
    def _confirmed(self) -> bool:
        return shows_stop(self._core.phase.label, self._core.action.label)
