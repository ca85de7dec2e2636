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
    """Collects what went wrong since the rig was armed; `message` orders it. Times are ns on the rig's clock."""

    def __init__(self) -> None:
        self._observed: dict[str, Observation] = {}
        self._armed = self._held = False
        self._bits = 0
        self._board: BoardCounters | None = None
        self.changed = False  # since the last `message`

    def take_tick(self, at_ns: int, armed: bool, action: SafetyAction, bits: int) -> None:
        """Take in one tick's safety action and causes (bit set of `safety.CAUSES`). Arming forgets all before it."""
        if armed and not self._armed:
            self._observed.clear()
            self._bits, self.changed = 0, True
        held = action >= SafetyAction.HOLD
        if held and not self._held:
            # What is long over did not lead to this: a pose that was rejected a minute ago is not why the board fell silent.
            self._observed = {name: item for name, item in self._observed.items() if at_ns - item.at_ns <= EXPLAINS_FOR_NS}
            self._bits = 0
        self._armed, self._held = armed, held
        new = bits & ~self._bits
        self._bits |= bits
        if new:
            for name in safety.names(new):
                self._note(name, at_ns)

    def take_gap(self, at_ns: int, gap_ns: int, where: str) -> None:
        """Take in the time between two ticks, which ended at `at_ns`; `where`: what took it, if known."""
        if gap_ns > LATE_GAP_NS:
            self._note("loop_late", at_ns, f"no set-point for {gap_ns * 1e-6:.0f} ms" + (f", {where}" if where else ""))

    def take_board(self, board: BoardCounters) -> None:
        """Take in the board's counters."""
        fault = FAULT_CAUSES.get(Fault(board.fault))
        if fault is not None:
            self._note(fault, board.stamp_ns)
        before, self._board = self._board, board
        if before is not None and board.boot_count > before.boot_count:
            self._note("board_reset", board.stamp_ns)
        if before is not None and board.underruns > before.underruns:
            self._note("underrun", board.stamp_ns)

    def message(self, stamp_ns: int) -> RigCause:
        """Return the first cause of all that was noticed, with its remedy and what followed; empty where nothing was."""
        self.changed = False
        first = first_cause(self._observed.values())
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

    def _note(self, cause: str, at_ns: int, words: str = "") -> None:
        if cause not in self._observed:
            self._observed[cause] = Observation(cause, at_ns, words)
            self.changed = True
