"""A commander of a rig: takes the lease, keeps it, gives commands under it, and returns the result of each."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, SupportsFloat

from protocol.stop_client import PathAnswer
from protocol.topics import Command, Reply, check_name

LIFE_NS = 500_000_000
_RENEW_BEFORE_NS = 2_000_000_000
_STOP_TRIES = 3
# A round trip longer than this says too little about the rig's clock.
_PROMPT_NS = 100_000_000


@dataclass(frozen=True)
class Acknowledgement:
    """Result of a command. `reason`: why it was refused; empty when it was accepted.

    result: as in Reply, or `unanswered`: it may or may not have been carried out; or, of a stop, `not confirmed`: the rig's
    own state did not show it in time. paths: of a stop, what each path to the rig answered.
    """

    accepted: bool
    reason: str
    result: str
    paths: tuple[PathAnswer, ...] = ()


class Asker(Protocol):
    """Interface that sends a command to a rig and returns its reply: a zenoh session, or a rig in the same process."""

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        """Return the reply, None if no answer arrives in time."""


class CommandSender:
    """Commands one rig as `name`. Each method sends one command and returns its Acknowledgement; none raises an exception.

    session: as in Asker. clock_ns: this side's clock; the rig's is learnt from its replies. new_id: unique texts.
    Raises ValueError for a bad name.
    """

    def __init__(
        self,
        session: Asker,
        name: str,
        *,
        timeout_s: float = 1.0,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        new_id: Callable[[], str] = lambda: uuid.uuid4().hex,
    ) -> None:
        self.name = check_name(name)
        self._session, self._timeout_s, self._clock_ns, self._new_id = session, timeout_s, clock_ns, new_id
        self._ahead_ns: int | None = None
        self._lease, self._lease_expires_ns, self._sequence = "", 0, 0
        self._lock = threading.RLock()

    def take(self) -> Acknowledgement:
        """Take the lease, or renew it. Refused while another commander holds it."""
        with self._lock:
            try:
                reply = self._ask("take")
            except ValueError as error:
                return Acknowledgement(False, str(error), "malformed")
            if reply is not None and reply.result == "accepted":
                self._lease, self._lease_expires_ns = reply.lease, reply.lease_expires_ns
            return _said(reply)

    def release(self) -> Acknowledgement:
        """Release the lease. A motion in progress continues as commanded."""
        with self._lock:
            answer = self.give("release")
            self._lease, self._lease_expires_ns = "", 0
            return answer

    def arm(self) -> Acknowledgement:
        """Arm the board and the loop; the rig holds."""
        return self.give("arm")

    def disarm(self) -> Acknowledgement:
        """Bring the stages to rest and disarm the board."""
        return self.give("disarm")

    def hold(self) -> Acknowledgement:
        """Hold the present position. Needs no lease."""
        return self.give("hold")

    def stop(self) -> Acknowledgement:
        """Stop; only disarming and arming end the stop. Needs no lease, and is obeyed even if it is late."""
        return self.give("stop")

    def clear_fault(self) -> Acknowledgement:
        """Clear latched causes and faults; the rig is disarmed afterwards."""
        return self.give("clear_fault")

    def target(self, position_m: Sequence[float]) -> Acknowledgement:
        """Bring the tip to `position_m` (3, m, base frame)."""
        return self.give("target", "position", target_m=position_m)

    def press(self, position_m: Sequence[float], normal: Sequence[float], force_N: float) -> Acknowledgement:
        """Approach the tissue at `position_m` along `normal` (3, unit, into it) and hold `force_N` on it."""
        return self.give("target", "contact", target_m=position_m, normal=normal, force_N=force_N)

    def force(self, force_N: float) -> Acknowledgement:
        """Change the force (N) of the present touch."""
        return self.give("force", force_N=force_N)

    def retract(self) -> Acknowledgement:
        """Move away from the tissue, then stop."""
        return self.give("target", "retract")

    def jog(
        self, axis: str, travel_unit: float, speed_unit_per_s: float, direction: Sequence[float] | None = None
    ) -> Acknowledgement:
        """Move `axis` (insertion, roll, knob; or tip along `direction`, unit, base frame) a short way, then hold."""
        return self.give("jog", axis=axis, travel_unit=travel_unit, speed_unit_per_s=speed_unit_per_s, direction=direction)

    def zero(self) -> Acknowledgement:
        """Make the force sensor's present load its zero; the tip has to hang free."""
        return self.give("zero")

    def home(self, axis: str) -> Acknowledgement:
        """Move one axis of a disarmed rig to its switch. axis: insertion, roll or knob. The rig's log states the result."""
        return self.give("home", axis=axis)

    def mark(self, note: str) -> Acknowledgement:
        """Write a note into log and recording. Needs no lease."""
        return self.give("mark", note=note)

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Send any command (fields as in `protocol.topics.Command`) under the lease, which is renewed in time."""
        try:
            fields = {name: _plain(value) for name, value in fields.items()}
            if action == "stop":
                return self._stop()
            with self._lock:
                if self._lease and action not in ("hold", "release", "mark"):
                    self._renew()
                return _said(self._ask(action, target, **fields))
        except (TypeError, ValueError) as error:
            return Acknowledgement(False, str(error), "malformed")

    def _stop(self) -> Acknowledgement:
        """Stop without waiting for a lock or another command; repeat the request if no answer arrives."""
        for _ in range(_STOP_TRIES):
            reply = self._send("stop", "none", 0)
            if reply is not None:
                break
        return _said(reply)

    @property
    def lease_left_s(self) -> float:
        """Return the remaining time of the lease (s) if it is not renewed; 0 without a lease."""
        with self._lock:
            return (self._lease_expires_ns - self._now_ns()) * 1e-9 if self._holding() else 0.0

    def _holding(self) -> bool:
        return bool(self._lease) and self._now_ns() <= self._lease_expires_ns

    def _renew(self) -> None:
        left_ns = self._lease_expires_ns - self._now_ns()
        if not _RENEW_BEFORE_NS < left_ns < 2 * _RENEW_BEFORE_NS:
            self.take()

    def _now_ns(self) -> int:
        return max(self._clock_ns() + (self._ahead_ns or 0), 0)

    def _ask(self, action: str, target: str = "none", **fields: Any) -> Reply | None:
        if self._ahead_ns is None:
            self._send("clock", "none", 0)
        self._sequence += 1
        return self._send(action, target, self._sequence, **fields)

    def _send(self, action: str, target: str, sequence: int, **fields: Any) -> Reply | None:
        issued_ns, sent_ns = self._now_ns(), self._clock_ns()
        reply = self._session.ask(
            Command(
                stamp_ns=issued_ns,
                sequence=sequence,
                id=self._new_id(),
                commander=self.name,
                lease=self._lease,
                expires_ns=issued_ns + LIFE_NS,
                action=action,
                target=target,
                **fields,
            ),
            self._timeout_s,
        )
        came_ns = self._clock_ns()
        if reply is not None and (came_ns - sent_ns < _PROMPT_NS or self._ahead_ns is None):
            self._ahead_ns = reply.stamp_ns - (sent_ns + came_ns) // 2
        return reply


def _plain(value: Any) -> Any:
    """Return numbers and vectors of any library as Python's own types."""
    if value is None or isinstance(value, (str, bool)):
        return value
    return float(value) if isinstance(value, SupportsFloat) else tuple(float(part) for part in value)


def _said(reply: Reply | None) -> Acknowledgement:
    if reply is None:
        return Acknowledgement(
            False,
            "no answer: the rig may or may not have received the command; look at its state, then repeat. "
            "`seldinger stop` has a path of its own",
            "unanswered",
        )
    accepted = reply.result == "accepted"
    return Acknowledgement(accepted, "" if accepted else f"{reply.result}: {reply.text}", reply.result)
