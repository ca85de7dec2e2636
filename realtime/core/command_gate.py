"""Check of every command from the network: sender, role, lease, age, repetition and rate."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec

from protocol.topics import Command, CommandCounts, Reply, decode

LEASE_NS = 3_000_000_000
LONGEST_LIFE_NS = 2_000_000_000
# Greatest lead of a sender's clock; the sender sets its clock by the stamps of the replies.
AHEAD_NS = 100_000_000
# Limits of one sender: commands at once, and commands a second. A flood loses its sender's commands, not the rig's time.
BURST, RATE_PER_S = 50, 50.0
REMEMBERED = 2000
_SENDERS = 200
# In this time at most one refusal is logged, with the number of the others.
_LOG_EVERY_NS = 500_000_000
_NEEDS_NO_LEASE = ("clock", "take", "hold", "mark", "stop")


@dataclass
class Lease:
    """The right to command: its holder, secret, expiry, and the newest sequence number under it."""

    holder: str = ""
    id: str = ""
    expires_ns: int = 0
    sequence: int = -1

    def active(self, now_ns: int) -> bool:
        """Whether the lease is valid. A clock that was set back ends it, too."""
        return self.holder != "" and 0 <= self.expires_ns - now_ns <= LEASE_NS


class _Bucket:
    """Limit of one sender's rate: BURST at once and RATE_PER_S in the long run (token bucket)."""

    def __init__(self, now_ns: int) -> None:
        self._level, self._at_ns = float(BURST), now_ns

    def take(self, now_ns: int) -> bool:
        """Take one token. Return whether there was one."""
        self._level = min(float(BURST), self._level + max(now_ns - self._at_ns, 0) * 1e-9 * RATE_PER_S)
        self._at_ns = now_ns
        if self._level < 1.0:
            return False
        self._level -= 1.0
        return True


class CommandGate:
    """Checks commands on `request/NAME`, and passes accepted ones to `execute`. A refused command changes nothing.

    Args:
        now_ns: the rig's clock.
        execute: (command, now_ns) -> Reply; carries out a command. One thread at a time calls it.
        roles: name -> role, for the names that have one in the rig file; only `commander` may command. A name without a
            role is a program of this computer, because the network admits no other names.
        new_lease: makes the secret of a lease.
    """

    def __init__(
        self,
        now_ns: Callable[[], int],
        execute: Callable[[Command, int], Reply],
        *,
        roles: Mapping[str, str] | None = None,
        new_lease: Callable[[], str] = lambda: secrets.token_hex(16),
    ) -> None:
        self._now_ns, self._execute, self._new_lease = now_ns, execute, new_lease
        self._roles = dict(roles or {})
        self._lock = threading.Lock()
        self._lease = Lease()
        self._seen: dict[str, int] = {}
        self._buckets: dict[str, _Bucket] = {}
        self._logged_ns, self._not_logged = -_LOG_EVERY_NS, 0
        self.counts = {"accepted": 0, "refused": 0, "expired": 0, "replayed": 0, "malformed": 0, "flooded": 0}

    def state(self) -> CommandCounts:
        """Return the holder of the lease, and the counts."""
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
        """Return the command in `payload`, which came on request/`name`, and the reply to it.

        The command is None if it is malformed, and the reply is None as well if the sender exceeds its rate. A stop is
        carried out for every commander at any time: without a lease, late, repeated, or above the rate.
        """
        with self._lock:
            now_ns = self._now_ns()
            if not self._within_rate(name, now_ns) and b"stop" not in payload:
                self.counts["flooded"] += 1
                return None, None
            try:
                command = decode(Command, payload)
            except ValueError as error:
                self.counts["malformed"] += 1
                return None, Reply(stamp_ns=now_ns, id="", result="malformed", text=str(error))
            reply = self._check(name, command, now_ns)
            if command.action != "clock":
                self.counts[reply.result] += 1
            return command, reply

    def log_line(self, name: str, command: Command | None, reply: Reply | None) -> str:
        """Return the log line of a command and its reply; empty for a renewal, a clock reading, or above the log's rate."""
        what = f"{command.action} {command.target}".removesuffix(" none") if command else "request"
        if reply is not None and reply.result == "accepted":
            return f"{name}: {what}: accepted" if without_secrets(command, reply) else ""
        with self._lock:
            now_ns = self._now_ns()
            if 0 <= now_ns - self._logged_ns < _LOG_EVERY_NS:
                self._not_logged += 1
                return ""
            more, self._not_logged, self._logged_ns = self._not_logged, 0, now_ns
        result = "not read, too many commands" if reply is None else f"{what}: {reply.result}: {reply.text}"
        return f"{name[:40]}: {result}" + (f" (and {more} more not logged)" if more else "")

    def _within_rate(self, name: str, now_ns: int) -> bool:
        if name not in self._buckets and len(self._buckets) >= _SENDERS:
            name = ""
        return self._buckets.setdefault(name, _Bucket(now_ns)).take(now_ns)

    def _check(self, name: str, command: Command, now_ns: int) -> Reply:
        def answer(result: str, text: str) -> Reply:
            return Reply(stamp_ns=now_ns, id=command.id, result=result, text=text)

        if command.commander != name:
            return answer("refused", f"commander: found {command.commander}, wanted {name}, whose key it came on")
        role = self._roles.get(name, "commander")
        if role != "commander":
            return answer("refused", f"role: found {role}, wanted commander")
        if command.action == "stop":
            return self._execute(command, now_ns)
        if command.action == "clock":
            return answer("accepted", "")
        result, text = self._stale(command, now_ns)
        if not text:
            result, text = self._unleased(command, now_ns)
        if text:
            return answer(result, text)
        if command.action == "take":
            return self._take(command, now_ns)
        if command.action == "release":
            self._lease = Lease()
            return answer("accepted", "")
        return self._execute(command, now_ns)

    def _stale(self, command: Command, now_ns: int) -> tuple[str, str]:
        """Return the result and the reason if the command is too old, too new or a repetition; an empty reason otherwise."""
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
        """Return the result and the reason if the command's lease does not permit it; an empty reason otherwise."""
        if command.action in _NEEDS_NO_LEASE:
            return "accepted", ""
        lease = self._lease
        if not lease.active(now_ns):
            return "refused", "lease: found no valid one, wanted one taken before and renewed"
        if not self._holds(command):
            return "refused", _held(lease)
        if command.sequence <= lease.sequence:
            return "replayed", f"sequence: found {command.sequence}, wanted above {lease.sequence}"
        lease.sequence = command.sequence
        return "accepted", ""

    def _holds(self, command: Command) -> bool:
        lease = self._lease
        return command.commander == lease.holder and secrets.compare_digest(command.lease.encode(), lease.id.encode())

    def _take(self, command: Command, now_ns: int) -> Reply:
        """Return a new lease if none is valid, the same lease renewed for its holder, and a refusal for other commanders."""
        lease = self._lease
        if lease.active(now_ns):
            if not self._holds(command):
                return Reply(stamp_ns=now_ns, id=command.id, result="refused", text=_held(lease))
        else:
            lease = self._lease = Lease(command.commander, self._new_lease(), 0, command.sequence)
        lease.expires_ns = now_ns + LEASE_NS
        return Reply(
            stamp_ns=now_ns, id=command.id, result="accepted", lease=lease.id, lease_expires_ns=lease.expires_ns, text=""
        )


def _held(lease: Lease) -> str:
    """Return who holds the lease, and what another commander can do. The time left says little: a holder renews it."""
    return (
        f"lease: held by {lease.holder}, wanted it free; it is free as soon as {lease.holder} releases it, or "
        f"{LEASE_NS * 1e-9:g} s after that program has ended. Hold, mark and stop need no lease"
    )


def without_secrets(command: Command | None, reply: Reply | None) -> tuple[Command, Reply] | None:
    """Return a command and its reply without the lease's secret, to be published. None for renewals and clock readings."""
    if command is None or reply is None or command.action == "clock":
        return None
    if command.action == "take" and reply.result == "accepted" and reply.lease == command.lease:
        return None
    return msgspec.structs.replace(command, lease=""), msgspec.structs.replace(reply, lease="")
