"""Who may command, under which lease, how fresh and how much: every refusal by its reason, and never past the gate."""

from __future__ import annotations

from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.commander import CommandSender
from protocol.topics import MAX_PAYLOAD_BYTES, Command, Reply, encode
from realtime.core.command_gate import AHEAD_NS, BURST, LEASE_NS, LONGEST_LIFE_NS, REMEMBERED, CommandGate, without_secrets

S = 1_000_000_000


class Rig:
    """A gate, its clock, and what got past it."""

    def __init__(self, now_ns: int = 100 * S, **options: Any) -> None:
        self.now_ns, self.done, self.ids = now_ns, list[Command](), 0
        self.gate = CommandGate(lambda: self.now_ns, self.obey, **options)

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.done.append(command)
        return Reply(stamp_ns=now_ns, id=command.id, result="accepted")

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        return self.gate.answer(command.commander, encode(command))[1]

    def commander(self, name: str = "console") -> CommandSender:
        return CommandSender(self, name, clock_ns=lambda: self.now_ns)

    def command(self, **changes: Any) -> Command:
        self.ids += 1
        fields: dict[str, Any] = {
            "stamp_ns": self.now_ns,
            "sequence": self.ids,
            "id": f"c{self.ids}",
            "commander": "console",
            "expires_ns": self.now_ns + S // 2,
            "action": "arm",
            "target": "none",
        }
        return Command(**(fields | changes))

    def leased(self, name: str = "console") -> str:
        reply = self.ask(self.command(action="take", commander=name))
        assert reply is not None and reply.result == "accepted"
        return reply.lease

    def said(self, command: Command) -> tuple[str, str]:
        reply = self.ask(command)
        assert reply is not None
        return reply.result, reply.text


def test_under_a_lease_a_command_is_obeyed() -> None:
    rig = Rig()
    lease = rig.leased()
    assert rig.said(rig.command(lease=lease)) == ("accepted", "")
    assert [command.action for command in rig.done] == ["arm"] and rig.gate.state().holder == "console"


@pytest.mark.parametrize("action", ["arm", "disarm", "clear_fault", "release"])
def test_without_a_lease_nothing_but_the_safe_direction(action: str) -> None:
    rig = Rig()
    assert rig.said(rig.command(action=action)) == (
        "refused",
        "lease: found no valid one, wanted one taken before and renewed",
    )
    rig.leased("other")
    refused, why = rig.said(rig.command(action=action))
    assert refused == "refused" and why.startswith(
        "lease: held by other, wanted it free; it is free as soon as other releases"
    )
    assert why.endswith("Hold, mark and stop need no lease")
    assert rig.said(rig.command(action=action, lease="guess"))[1].startswith("lease: held by other")
    assert rig.done == []
    assert rig.said(rig.command(action="hold")) == rig.said(rig.command(action="stop")) == ("accepted", "")


def test_a_lease_is_of_its_holder_alone() -> None:
    rig = Rig()
    lease = rig.leased()
    assert rig.said(rig.command(commander="other", lease=lease))[0] == "refused"
    assert rig.said(rig.command(commander="other", action="take"))[1].startswith("lease: held by console")
    assert rig.said(rig.command(action="take"))[1].startswith("lease: held by console")
    assert rig.ask(rig.command(action="take", lease=lease)).lease == lease  # type: ignore[union-attr]
    assert rig.said(rig.command(action="release", lease=lease))[0] == "accepted"
    assert rig.leased("other") != lease and rig.done == []


def test_a_lease_ends_unless_it_is_renewed() -> None:
    rig = Rig()
    lease = rig.leased()
    for _ in range(5):
        rig.now_ns += LEASE_NS - 1
        assert rig.said(rig.command(action="take", lease=lease))[0] == "accepted"
    rig.now_ns += LEASE_NS + 1
    assert rig.gate.state().holder == "" and rig.said(rig.command(lease=lease))[0] == "refused"
    rig.leased("other")
    assert rig.gate.state().holder == "other" and rig.done == []


def test_a_clock_set_back_ends_a_lease() -> None:
    rig = Rig()
    lease = rig.leased()
    rig.now_ns -= 20 * S
    assert rig.said(rig.command(lease=lease))[0] == "refused" and rig.done == []


def test_what_is_stale_early_or_lives_too_long_is_refused() -> None:
    rig = Rig()
    lease = rig.leased()
    now_ns = rig.now_ns
    late = rig.command(lease=lease, stamp_ns=now_ns - S, expires_ns=now_ns - S // 4)
    assert rig.said(late) == ("expired", "came 0.250 s after its expiry")
    early = rig.command(lease=lease, stamp_ns=now_ns + AHEAD_NS + 1, expires_ns=now_ns + S)
    assert "ahead of the rig's clock" in rig.said(early)[1]
    assert "a life of" in rig.said(rig.command(lease=lease, expires_ns=now_ns + LONGEST_LIFE_NS + 1))[1]
    assert rig.done == [] and rig.gate.counts["expired"] == 1 and rig.gate.counts["refused"] == 2


def test_what_comes_twice_or_out_of_sequence_is_a_replay() -> None:
    rig = Rig()
    lease = rig.leased()
    first = rig.command(lease=lease)
    assert rig.said(first)[0] == "accepted"
    assert rig.said(first) == ("replayed", "this id was answered before")
    assert rig.said(msgspec.structs.replace(first, id="new"))[0] == "replayed"
    rig.now_ns += LEASE_NS + 1
    rig.leased()
    assert rig.said(first)[0] == "expired" and len(rig.done) == 1 and rig.gate.counts["replayed"] == 2


def test_a_recorded_take_gives_no_second_lease() -> None:
    rig = Rig()
    take = rig.command(action="take")
    assert rig.said(take)[0] == "accepted" and rig.said(take)[0] == "replayed"


def test_a_stop_is_obeyed_late_repeated_and_from_any_commander() -> None:
    rig = Rig()
    rig.leased("other")
    stop = Command(stamp_ns=0, id="s", commander="console", expires_ns=1, action="stop", target="none")
    assert [rig.said(stop)[0] for _ in range(3)] == ["accepted"] * 3 and len(rig.done) == 3


def test_a_hold_must_be_fresh() -> None:
    rig = Rig()
    hold = rig.command(action="hold")
    assert rig.said(hold)[0] == "accepted" and rig.said(hold)[0] == "replayed"
    rig.now_ns += 5 * S
    assert rig.said(msgspec.structs.replace(hold, id="again"))[0] == "expired" and len(rig.done) == 1


def test_a_reader_commands_nothing_not_even_a_stop() -> None:
    rig = Rig(roles={"analysis": "reader", "console": "commander"})
    for action in ("take", "hold", "stop", "clock", "arm"):
        assert rig.said(rig.command(commander="analysis", action=action)) == (
            "refused",
            "role: found reader, wanted commander",
        )
    assert rig.done == [] and rig.leased()


def test_nobody_speaks_under_the_key_of_another() -> None:
    rig = Rig()
    lease = rig.leased()
    _, reply = rig.gate.answer("other", encode(rig.command(lease=lease)))
    assert reply is not None and reply.result == "refused" and "whose key it came on" in reply.text
    assert rig.gate.answer("*", encode(rig.command(action="stop")))[1].result == "refused"  # type: ignore[union-attr]
    assert rig.done == []


def test_a_flood_is_not_read_and_costs_nobody_else() -> None:
    rig = Rig()
    lease = rig.leased("other")
    got = [rig.gate.answer("console", b"junk") for _ in range(BURST + 500)]
    assert sum(reply is None for _, reply in got) == rig.gate.counts["flooded"] == 500
    assert rig.gate.counts["malformed"] == BURST
    assert rig.said(rig.command(commander="other", lease=lease))[0] == "accepted"
    assert rig.ask(rig.command(action="arm")) is None
    assert rig.said(rig.command(action="stop"))[0] == "accepted"
    rig.now_ns += S
    assert rig.said(rig.command(action="hold"))[0] == "accepted"


def test_neither_many_names_nor_many_ids_fill_the_memory() -> None:
    rig = Rig()
    for number in range(5 * REMEMBERED):
        rig.now_ns += 100_000
        rig.ask(rig.command(commander=f"n{number}", action="hold"))
    assert len(rig.gate._seen) <= REMEMBERED and len(rig.gate._buckets) <= 201
    rig.now_ns += 3 * S
    assert rig.said(rig.command(action="hold"))[0] == "accepted"


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=MAX_PAYLOAD_BYTES + 1000))
def test_noise_is_never_a_command(payload: bytes) -> None:
    rig = Rig()
    command, reply = rig.gate.answer("console", payload)
    assert command is None and reply is not None and reply.result == "malformed" and rig.done == []


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_good_command_with_one_field_spoilt_is_not_obeyed(data: st.DataObject) -> None:
    rig = Rig()
    body = msgpack.unpackb(encode(rig.command(lease=rig.leased())))
    name = data.draw(st.sampled_from(sorted(body)))
    body[name] = data.draw(
        st.none()
        | st.integers().filter(lambda n: -(2**63) <= n < 2**64)
        | st.text()
        | st.binary()
        | st.floats()
        | st.lists(st.integers(0, 9))
    )
    _, reply = rig.gate.answer("console", msgpack.packb(body))
    assert reply is not None
    harmless = name in ("id", "sequence", "stamp_ns", "expires_ns", "fault", "target_m", "normal", "force_N", "lease")
    harmless |= name in ("direction", "travel_unit", "speed_unit_per_s", "note")  # of other actions
    assert rig.done == [] or harmless
    for done in rig.done:
        assert done.expires_ns >= rig.now_ns and done.lease == body["lease"]


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["take", "release", "arm", "hold", "disarm", "wait"]),
            st.sampled_from(["a", "b"]),
            st.integers(0, 4),
        ),
        max_size=40,
    )
)
def test_only_the_holder_gets_past_the_gate(steps: list[tuple[str, str, int]]) -> None:
    rig = Rig()
    commanders = {name: rig.commander(name) for name in "ab"}
    for action, name, wait in steps:
        if action == "wait":
            rig.now_ns += wait * S
            continue
        before, holder = len(rig.done), rig.gate.state().holder
        answer = commanders[name].take() if action == "take" else commanders[name].give(action)
        if action in ("arm", "disarm") and len(rig.done) > before:
            assert rig.gate.state().holder == name
        if holder not in ("", name) and action != "hold":
            assert not answer.accepted and "held by" in answer.reason and len(rig.done) == before


def test_the_record_shows_no_secret_and_no_renewal() -> None:
    rig = Rig()
    command, reply = rig.gate.answer("console", encode(rig.command(action="take")))
    assert reply is not None and reply.lease
    public = without_secrets(command, reply)
    assert public is not None and public[0].lease == public[1].lease == ""
    again = rig.gate.answer("console", encode(rig.command(action="take", lease=reply.lease)))
    assert without_secrets(*again) is None
    assert without_secrets(*rig.gate.answer("console", encode(rig.command(action="clock")))) is None
    assert without_secrets(*rig.gate.answer("console", b"")) is None


def test_refusals_are_logged_at_once_and_then_counted_for_half_a_second() -> None:
    rig = Rig(now_ns=0)

    def log_line() -> str:
        return rig.gate.log_line("console", *rig.gate.answer("console", b"junk"))

    assert log_line().startswith("console: request: malformed: payload") and [log_line() for _ in range(7)] == [""] * 7
    rig.now_ns += S
    assert log_line().endswith("(and 7 more not logged)")
    assert (
        rig.gate.log_line("console", *rig.gate.answer("console", encode(rig.command(action="take"))))
        == "console: take: accepted"
    )
    assert rig.gate.log_line("console", *rig.gate.answer("console", encode(rig.command(action="clock")))) == ""
