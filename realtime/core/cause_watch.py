"""What went wrong on the rig since it was armed, and which of it came first, as the message of the topic `cause`.

The realtime process alone knows the time of every cause: a program that starts to listen later sees a stop, not the stalled
computer that led to it. So the order is found here, and page, terminal and report show what was published.
"""

from __future__ import annotations

from protocol.enums import SafetyAction
from protocol.first_cause import EXPLAINS_FOR_NS, Observation, describe, first_cause
from protocol.serial_frames import DEADMAN_US, Fault
from protocol.topics import BoardCounters, RigCause
from realtime.control import safety

# Without a set-point for so long the board is half way to its dead man, and poses of 40 Hz have been missed.
LATE_GAP_NS = DEADMAN_US * 500
FAULT_CAUSES = {
    Fault.DEADMAN: "deadman",
    Fault.ESTOP: "estop",
    Fault.LIMIT: "limit",
    Fault.WATCHDOG: "board_reset",
    Fault.BROWNOUT: "board_reset",
}


class CauseWatch:
    """Collects what went wrong since the rig was armed or cleared; `message` orders it. Times are ns on the rig's clock."""

    def __init__(self) -> None:
        self._observed: dict[str, Observation] = {}
        self._bits = 0
        self._board: BoardCounters | None = None
        self._held = self._returned = self._stands = False
        self.changed = False  # since the last `message`

    def restart(self) -> None:
        """Forget what was, because the operator armed or cleared. What is still wrong is noted again."""
        self._observed.clear()
        self._bits, self._returned, self._stands, self.changed = 0, False, False, True

    def take_tick(self, at_ns: int, action: SafetyAction, bits: int) -> None:
        """Take in one tick's safety action and causes (bit set of `safety.CAUSES`)."""
        held = action >= SafetyAction.HOLD
        if held != self._held:
            self._held = held
            self._settle(at_ns)
        new = bits & ~self._bits
        self._bits |= bits
        if new:
            for name in safety.names(new):
                self._note(name, at_ns)

    def take_gap(self, at_ns: int, gap_ns: int, where: str) -> None:
        """Take in the time between two ticks, which ended at `at_ns`; `where`: what took it, if known."""
        if gap_ns > LATE_GAP_NS:
            self._note("loop_late", at_ns, f"no set-point for {gap_ns * 1e-6:.0f} ms" + (f", {where}" if where else ""))

    def take_return(self, at_ns: int, device: str) -> None:
        """Take in that the rig was disarmed because `device` was lost and is back."""
        self._returned = True
        self._settle(at_ns)
        self._note("device_returned", at_ns, device)

    def take_board(self, board: BoardCounters) -> None:
        """Take in the board's counters."""
        before, self._board = self._board, board
        self._settle(board.stamp_ns)
        fault = FAULT_CAUSES.get(Fault(board.fault), "board_fault" if board.fault else "")
        if fault:
            self._note(fault, board.stamp_ns)
        if before is not None and board.boot_count > before.boot_count:
            self._note("board_reset", board.stamp_ns)
        if before is not None and board.underruns > before.underruns:
            self._note("underrun", board.stamp_ns)

    def message(self, stamp_ns: int) -> RigCause:
        """Return the first cause of what holds the rig back, with remedy and what followed; empty if nothing does."""
        self.changed = False
        first = first_cause(self._observed.values()) if self._stands else None
        if first is None:
            return RigCause(stamp_ns=stamp_ns)
        return RigCause(
            stamp_ns=stamp_ns,
            name=first.cause,
            since_ns=first.at_ns,
            says=first.says,
            remedy=first.remedy,
            followed="\n".join(f"{(item.at_ns - first.at_ns) * 1e-6:+.0f} ms: {describe(item)}" for item in first.followed),
        )

    def _settle(self, at_ns: int) -> None:
        """Decide whether something holds the rig back: a safety action, a fault of the board, or a disarming of its own."""
        stands = self._held or self._returned or (self._board is not None and self._board.fault != 0)
        if stands and not self._stands:
            # What is long over did not lead to this: a pose that was rejected a minute ago is not why the board fell silent.
            self._observed = {name: item for name, item in self._observed.items() if at_ns - item.at_ns <= EXPLAINS_FOR_NS}
            self._bits = 0
        self.changed |= stands != self._stands
        self._stands = stands

    def _note(self, cause: str, at_ns: int, words: str = "") -> None:
        if cause not in self._observed:
            self._observed[cause] = Observation(cause, at_ns, words)
            self.changed |= self._stands
