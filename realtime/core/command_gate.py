"""What stands between the network and the operator's desk: who asks, under which lease, how fresh, how much."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec

from protocol.topics import Command, CommandCounts, Reply, decode

LEASE_NS = 3_000_000_000
LONGEST_LIFE_NS = 2_000_000_000
# How far a sender's clock may be ahead; its clock follows the stamps of the replies.
AHEAD_NS = 100_000_000
# A flood costs its sender's commands, not the rig's time: so many at once, and so many a second.
BURST, RATE_PER_S = 50, 50.0
REMEMBERED = 2000
_SENDERS = 200
# Of refusals, one is told in so long, with the number of the others.
_TOLD_EVERY_NS = 500_000_000
_NEEDS_NO_LEASE = ("clock", "take", "hold", "stop")


@dataclass
class Lease:
    """The right to command: who has it, its secret, until when, and the newest sequence number under it."""

    holder: str = ""
    id: str = ""
    expires_ns: int = 0
    sequence: int = -1

    def active(self, now_ns: int) -> bool:
        """Whether it stands. Also a clock that was set back ends it."""
        return self.holder != "" and 0 <= self.expires_ns - now_ns <= LEASE_NS


class _Bucket:
    """Lets BURST through at once and RATE_PER_S in the long run."""

    def __init__(self, now_ns: int) -> None:
        self._level, self._at_ns = float(BURST), now_ns

    def let(self, now_ns: int) -> bool:
        """Whether one more may pass."""
        self._level = min(float(BURST), self._level + max(now_ns - self._at_ns, 0) * 1e-9 * RATE_PER_S)
        self._at_ns = now_ns
        if self._level < 1.0:
            return False
        self._level -= 1.0
        return True


class CommandGate:
    """Judges what arrives on `request/NAME`. What it refuses changes nothing; what it lets through goes to `obey`.

    obey(command, now_ns) -> Reply: the desk; called by one thread at a time. now_ns: the rig's clock.
    roles: name -> role, for names that the rig file gives one; only `commander` may command. Others come from this
    machine: the network lets no other name in. new_lease: makes a lease's secret.
    """

    def __init__(
        self,
        now_ns: Callable[[], int],
        obey: Callable[[Command, int], Reply],
        *,
        roles: Mapping[str, str] | None = None,
        new_lease: Callable[[], str] = lambda: secrets.token_hex(16),
    ) -> None:
        self._now_ns, self._obey, self._new_lease = now_ns, obey, new_lease
        self._roles = dict(roles or {})
        self._lock = threading.Lock()
        self._lease = Lease()
        self._seen: dict[str, int] = {}
        self._buckets: dict[str, _Bucket] = {}
        self._told_ns, self._untold = -_TOLD_EVERY_NS, 0
        self.counts = {"accepted": 0, "refused": 0, "expired": 0, "replayed": 0, "malformed": 0, "flooded": 0}

    def state(self) -> CommandCounts:
        """Who holds the lease, and the counts."""
        with self._lock:
            now_ns = self._now_ns()
            active = self._lease.active(now_ns)
            return CommandCounts(
                stamp_ns=now_ns,
                holder=self._lease.holder if active else "",
                lease_expires_ns=self._lease.expires_ns if active else 0,
                **self.counts,
            )

    def answer(self, name: str, payload: bytes) -> tuple[Command | None, Reply | None]:
        """What came on request/`name`, and the reply to it. No command: malformed; no reply either: one of a flood.

        A stop is obeyed from every commander at any time: without a lease, late, repeated, in the midst of a flood.
        """
        with self._lock:
            now_ns = self._now_ns()
            if not self._let(name, now_ns) and b"stop" not in payload:
                self.counts["flooded"] += 1
                return None, None
            try:
                command = decode(Command, payload)
            except ValueError as error:
                self.counts["malformed"] += 1
                return None, Reply(stamp_ns=now_ns, id="", result="malformed", text=str(error))
            reply = self._judge(name, command, now_ns)
            if command.action != "clock":
                self.counts[reply.result] += 1
            return command, reply

    def in_words(self, name: str, command: Command | None, reply: Reply | None) -> str:
        """The line for the log: what `name` asked and got; empty where nothing is to be told, or too much was already."""
        what = f"{command.action} {command.target}".removesuffix(" none") if command else "request"
        if reply is not None and reply.result == "accepted":
            return f"{name}: {what}: accepted" if for_the_record(command, reply) else ""
        with self._lock:
            now_ns = self._now_ns()
            if 0 <= now_ns - self._told_ns < _TOLD_EVERY_NS:
                self._untold += 1
                return ""
            more, self._untold, self._told_ns = self._untold, 0, now_ns
        said = "not read, there are too many" if reply is None else f"{what}: {reply.result}: {reply.text}"
        return f"{name[:40]}: {said}" + (f" (and {more} more not told)" if more else "")

    def _let(self, name: str, now_ns: int) -> bool:
        if name not in self._buckets and len(self._buckets) >= _SENDERS:
            name = ""
        return self._buckets.setdefault(name, _Bucket(now_ns)).let(now_ns)

    def _judge(self, name: str, command: Command, now_ns: int) -> Reply:
        def no(result: str, text: str) -> Reply:
            return Reply(stamp_ns=now_ns, id=command.id, result=result, text=text)

        if command.commander != name:
            return no("refused", f"commander: found {command.commander}, wanted {name}, whose key it came on")
        role = self._roles.get(name, "commander")
        if role != "commander":
            return no("refused", f"role: found {role}, wanted commander")
        if command.action == "stop":
            return self._obey(command, now_ns)
        if command.action == "clock":
            return no("accepted", "")
        result, text = self._stale(command, now_ns)
        if not text:
            result, text = self._unleased(command, now_ns)
        if text:
            return no(result, text)
        if command.action == "take":
            return self._take(command, now_ns)
        if command.action == "release":
            self._lease = Lease()
            return no("accepted", "")
        return self._obey(command, now_ns)

    def _stale(self, command: Command, now_ns: int) -> tuple[str, str]:
        """Why the command is too old, too new or a repetition; no text when it is fresh."""
        if now_ns > command.expires_ns:
            return "expired", f"came {(now_ns - command.expires_ns) * 1e-9:.3f} s after its expiry"
        if command.stamp_ns > now_ns + AHEAD_NS:
            return "refused", (
                f"stamp_ns: found {(command.stamp_ns - now_ns) * 1e-9:.3f} s ahead of the rig's clock, "
                f"wanted at most {AHEAD_NS * 1e-9:g} s"
            )
        if command.expires_ns - command.stamp_ns > LONGEST_LIFE_NS:
            return "refused", (
                f"expires_ns: found a life of {(command.expires_ns - command.stamp_ns) * 1e-9:.3f} s, "
                f"wanted at most {LONGEST_LIFE_NS * 1e-9:g} s"
            )
        if len(self._seen) >= REMEMBERED // 2:
            self._seen = {name: expires_ns for name, expires_ns in self._seen.items() if expires_ns >= now_ns}
        if command.id in self._seen:
            return "replayed", "this id was answered before"
        if len(self._seen) >= REMEMBERED:
            return "refused", f"found {REMEMBERED} commands within {LONGEST_LIFE_NS * 1e-9:g} s, wanted fewer"
        self._seen[command.id] = command.expires_ns
        return "accepted", ""

    def _unleased(self, command: Command, now_ns: int) -> tuple[str, str]:
        """Why the command may not be given under the lease it names; no text when it may, or needs none."""
        if command.action in _NEEDS_NO_LEASE:
            return "accepted", ""
        lease = self._lease
        if not lease.active(now_ns):
            return "refused", "lease: found none that stands, wanted one taken before and renewed"
        if not self._holds(command):
            return "refused", f"lease: held by {lease.holder}, for another {(lease.expires_ns - now_ns) * 1e-9:.1f} s"
        if command.sequence <= lease.sequence:
            return "replayed", f"sequence: found {command.sequence}, wanted above {lease.sequence}"
        lease.sequence = command.sequence
        return "accepted", ""

    def _holds(self, command: Command) -> bool:
        lease = self._lease
        return command.commander == lease.holder and secrets.compare_digest(command.lease.encode(), lease.id.encode())

    def _take(self, command: Command, now_ns: int) -> Reply:
        """A new lease where none stands, the same one for longer for who holds it, a refusal for all others."""
        lease = self._lease
        if lease.active(now_ns):
            if not self._holds(command):
                left_s = (lease.expires_ns - now_ns) * 1e-9
                return Reply(
                    stamp_ns=now_ns,
                    id=command.id,
                    result="refused",
                    text=f"lease: held by {lease.holder}, for another {left_s:.1f} s",
                )
        else:
            lease = self._lease = Lease(command.commander, self._new_lease(), 0, command.sequence)
        lease.expires_ns = now_ns + LEASE_NS
        return Reply(
            stamp_ns=now_ns, id=command.id, result="accepted", lease=lease.id, lease_expires_ns=lease.expires_ns, text=""
        )


def for_the_record(command: Command | None, reply: Reply | None) -> tuple[Command, Reply] | None:
    """What all may read of a command and its reply: without the lease's secret. None for renewals and clock readings."""
    if command is None or reply is None or command.action == "clock":
        return None
    if command.action == "take" and reply.result == "accepted" and reply.lease == command.lease:
        return None
    return msgspec.structs.replace(command, lease=""), msgspec.structs.replace(reply, lease="")
