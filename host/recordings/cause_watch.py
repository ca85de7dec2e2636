"""What went wrong on a rig since it was armed, collected from its messages, for page and report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from protocol.first_cause import FirstCause, Observation, first_cause
from protocol.serial_frames import DEADMAN_US, Fault

# Without a set-point for so long the board is half way to its dead man, and poses of 40 Hz have been missed.
LATE_GAP_NS = DEADMAN_US * 500
FAULT_CAUSES = {
    Fault.DEADMAN: "deadman",
    Fault.ESTOP: "estop",
    Fault.LIMIT: "limit",
    Fault.WATCHDOG: "board_reset",
    Fault.BROWNOUT: "board_reset",
}
Body = Mapping[str, Any]


class CauseWatch:
    """Collects what went wrong since the rig was armed, from the messages as they come; `first` orders it."""

    def __init__(self) -> None:
        self._observed: dict[str, Observation] = {}
        self._armed = False
        self._loop: Body = {}
        self._board: Body = {}

    def first(self) -> FirstCause | None:
        """Return the first cause of all that was noticed, None where nothing was."""
        return first_cause(self._observed.values())

    def take(self, topic: str, body: Body) -> None:
        """Take in one message; topics of no concern cost nothing."""
        if topic == "state":
            self._take_state(body)
        elif topic == "loop":
            self._take_loop(body)
        elif topic == "board":
            self._take_board(body)

    def _note(self, cause: str, at_ns: int, words: str = "") -> None:
        self._observed.setdefault(cause, Observation(cause, at_ns, words))

    def _take_state(self, body: Body) -> None:
        armed = body.get("mode") not in ("disarmed", "homing")
        if armed and not self._armed:
            self._observed.clear()
        self._armed = armed
        if body.get("cause") and body.get("safety_action") != "none":
            for name, words in named_causes(body["cause"]):
                self._note(name, body["stamp_ns"], words if name == words else "")

    def _take_loop(self, body: Body) -> None:
        gap_ns = body.get("longest_gap_ns", 0)
        # The gap arose at some time since the message before.
        if self._loop and gap_ns > max(LATE_GAP_NS, self._loop.get("longest_gap_ns", 0)):
            where = body.get("longest_gap_where", "")
            words = f"no set-point for {gap_ns * 1e-6:.0f} ms" + (f", {where}" if where else "")
            self._note("loop_late", self._loop["stamp_ns"], words)
        self._loop = body

    def _take_board(self, body: Body) -> None:
        fault = FAULT_CAUSES.get(body.get("fault", 0))
        if fault is not None:
            self._note(fault, body["stamp_ns"])
        before, self._board = self._board, body
        if before and body.get("boot_count", 0) > before.get("boot_count", 0):
            self._note("board_reset", body["stamp_ns"])
        if before and body.get("underruns", 0) > before.get("underruns", 0):
            self._note("underrun", body["stamp_ns"])


def named_causes(text: str) -> list[tuple[str, str]]:
    """Return (name, sentence) of each cause in a state's `cause`; a text that is not known has no name of its own."""
    from realtime.control.safety import CAUSES  # brings a compiler; loaded only where a state has a cause

    known = [(name, sentence) for name, _, _, sentence in CAUSES if sentence in text]
    return known or [(text, text)]
