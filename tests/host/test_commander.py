"""The client that everyone commands with: over a real session, with a lease that is kept, lost and given back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from host.run.commander import Commander
from protocol.commander import CommandSender
from protocol.topics import Command, Reply
from protocol.zenoh_session import RequestServer, Session
from realtime.core.command_gate import CommandGate
from tests.waiting import until

# The rig's clock is not the one of who commands it.
AHEAD_NS = 77_000_000_000
PATIENCE_S = 30.0


class Gate:
    """A gate on a session of its own; what got past it."""

    def __init__(self, endpoint: str, prove: Callable[[bytes], bytes] | None = None) -> None:
        self.done: list[Command] = []
        self.session = Session("simulated", [endpoint], [])
        self.gate = CommandGate(lambda: time.monotonic_ns() + AHEAD_NS, self.obey)
        self.server: RequestServer = self.session.serve_requests(
            lambda name, payload: self.gate.answer(name, payload)[1], prove
        )

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.done.append(command)
        problem = "found no board, wanted one" if command.action == "arm" else ""
        return Reply(stamp_ns=now_ns, id=command.id, result="refused" if problem else "accepted", text=problem)


@pytest.fixture
def gate(tmp_path: Path) -> Iterator[Gate]:
    made = Gate(f"unixsock-stream/{tmp_path}/rig.sock")
    yield made
    made.session.close()


@pytest.fixture
def console(gate: Gate, tmp_path: Path) -> Iterator[Session]:
    with Session("simulated", [], [f"unixsock-stream/{tmp_path}/rig.sock"]) as session:
        probe = CommandSender(session, "probe")
        assert until(lambda: probe.give("clock").accepted)
        yield session


def test_every_command_comes_back_with_what_became_of_it(gate: Gate, console: Session) -> None:
    with Commander(console, "console") as commander:
        assert not commander.arm().accepted and "found no valid one" in commander.arm().reason
        assert commander.take().accepted and 2.0 < commander.lease_left_s <= 3.0
        refused = commander.arm()
        assert (refused.accepted, refused.reason) == (False, "refused: found no board, wanted one")
        assert commander.target((0.0, 0.0, 0.04)).accepted
        assert commander.press((0.0, 0.0, 0.04), (0.0, 0.0, 1.0), 0.2).accepted
        for give in (
            lambda: commander.force(0.1),
            commander.hold,
            commander.retract,
            commander.disarm,
            commander.clear_fault,
        ):
            assert give().accepted
        stopped = commander.stop()
        assert stopped.result == "not confirmed" and "no state" in stopped.reason  # this rig publishes none
        malformed = commander.press((0.0, 0.0, 0.04), (0.0, 0.0, 2.0), 0.2)
        assert not malformed.accepted and "no unit normal" in malformed.reason
    assert [command.action for command in gate.done] == [
        "arm",
        "target",
        "target",
        "force",
        "hold",
        "target",
        "disarm",
        "clear_fault",
        "stop",
    ]
    assert gate.gate.state().holder == ""


def test_the_lease_is_kept_and_given_back(gate: Gate, console: Session) -> None:
    with Commander(console, "console") as commander, Commander(console, "other") as other:
        assert commander.take().accepted
        first_ns = gate.gate.state().lease_expires_ns
        assert until(lambda: gate.gate.state().lease_expires_ns > first_ns)
        assert "held by console" in other.take().reason and other.stop_by_zenoh().answered and other.hold().accepted
        assert commander.release().accepted and other.take().accepted
        assert "held by other" in commander.disarm().reason


def test_a_lease_that_another_got_is_said_to_be_lost(gate: Gate, console: Session) -> None:
    with Commander(console, "console") as commander:
        assert commander.take().accepted
        gate.gate._lease.holder = "other"
        assert until(lambda: "held by other" in commander.lost)


def test_a_rig_that_is_not_there_is_said(tmp_path: Path) -> None:
    with Session("simulated", [], [f"unixsock-stream/{tmp_path}/none.sock"]) as session:
        answer = Commander(session, "console", timeout_s=0.2).take()
        assert not answer.accepted and answer.result == "unanswered" and answer.reason.startswith("no answer")


def test_a_session_that_was_closed_is_no_answer(gate: Gate, console: Session) -> None:
    commander = CommandSender(console, "console")
    assert commander.take().accepted
    console.close()
    assert commander.hold().result == "unanswered"
