"""Commands that must not be obeyed, thrown at a rig that moves: every step edge stays where it was without them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgpack
import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from protocol.enums import Phase
from protocol.rig_file import load_rig
from protocol.topics import MAX_PAYLOAD_BYTES, Command, Message, Reply, decode, encode
from sim.forked_board import LibraryBoard
from sim.plant import Plant, PlantConfig
from sim.scenario import Scenario
from sim.world import World
from tests.realtime.conftest import RIG_FILE

MOVE_S = 0.4
ELSEWHERE = (0.0, -0.0107, 0.021)


class Tapped(Scenario):
    """A scenario whose commands are overheard on their way."""

    def __init__(self, board: LibraryBoard, roles: dict[str, str] | None = None) -> None:
        rig = load_rig(RIG_FILE)
        self.heard: list[bytes] = []
        self.logs: list[Message] = []
        plant = Plant(PlantConfig(tool_offsets_m=(0.0, rig.tracker.shaft_sensor_offset_m)), 1)
        super().__init__(rig, World(rig, plant, board, 1), self.tell)
        self.loop.core.gate._roles = roles or {}

    def tell(self, topic: str, message: Message) -> None:
        if topic == "log":
            self.logs.append(message)

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        if command.action != "clock":  # readings of the clock may be repeated by anyone
            self.heard.append(encode(command))
        return super().ask(command, timeout_s)

    def forged(self, **changes: object) -> Command:
        now_ns = self.loop.now_ns
        return Command(
            **{
                "stamp_ns": now_ns,
                "sequence": 10_000,
                "id": "forged",
                "commander": "intruder",  # type: ignore[arg-type]
                "expires_ns": now_ns + 100_000_000,
                "action": "target",
                "target": "position",
                "target_m": (0.0, 0.0, 0.05),
            }
            | changes
        )


Attack = Callable[[Tapped, int], tuple[str, bytes]]


def replayed(run: Tapped, number: int) -> tuple[str, bytes]:
    return "scenario", run.heard[number % len(run.heard)]


def replayed_under_a_new_id(run: Tapped, number: int) -> tuple[str, bytes]:
    old = decode(Command, run.heard[number % len(run.heard)])
    fresh = msgspec.structs.replace(old, id=f"r{number}", stamp_ns=run.loop.now_ns, expires_ns=run.loop.now_ns + 10**8)
    return "scenario", encode(fresh)


def stale(run: Tapped, number: int) -> tuple[str, bytes]:
    now_ns = run.loop.now_ns
    return "scenario", encode(
        run.forged(
            commander="scenario",
            lease=run.commander._lease,
            id=f"s{number}",
            stamp_ns=max(now_ns - 2 * 10**9, 0),
            expires_ns=now_ns - 10**6,
        )
    )


def from_a_reader(run: Tapped, number: int) -> tuple[str, bytes]:
    action = ("stop", "hold", "take", "disarm")[number % 4]
    return "analysis", encode(run.forged(commander="analysis", action=action, target="none", id=f"a{number}"))


def without_the_lease(run: Tapped, number: int) -> tuple[str, bytes]:
    return "intruder", encode(run.forged(id=f"n{number}"))


def with_a_stolen_lease(run: Tapped, number: int) -> tuple[str, bytes]:
    return "intruder", encode(run.forged(id=f"l{number}", lease=run.commander._lease))


def under_another_name(run: Tapped, number: int) -> tuple[str, bytes]:
    return "intruder", encode(run.forged(commander="scenario", lease=run.commander._lease, id=f"u{number}"))


def malformed(run: Tapped, number: int) -> tuple[str, bytes]:
    good = encode(run.forged())
    return "intruder", (b"", good[:-1], good + b"\0", b"\xc1" * 50, msgpack.packb({"action": "stop"}))[number % 5]


def oversized(run: Tapped, number: int) -> tuple[str, bytes]:
    return "intruder", b"\0" * (MAX_PAYLOAD_BYTES + 1 + 100 * number)


class Moved(NamedTuple):
    digest: str
    edges: list[int]
    steps: list[int]


def moving(run: Tapped) -> None:
    assert run.arm()
    assert run.command("target", "position", target_m=ELSEWHERE).accepted


def moved(run: Tapped) -> Moved:
    return Moved(run.world.digest, run.world.edges.tolist(), run.world.steps.tolist())


@pytest.fixture(scope="module")
def board() -> Iterator[LibraryBoard]:
    with LibraryBoard() as made:
        yield made


@pytest.fixture(scope="module")
def undisturbed() -> Moved:
    with LibraryBoard() as board:
        run = Tapped(board)
        moving(run)
        run.run(MOVE_S)
        result = moved(run)
    assert sum(result.edges) > 200
    return result


@pytest.mark.parametrize(
    "attack",
    [
        replayed,
        replayed_under_a_new_id,
        stale,
        from_a_reader,
        without_the_lease,
        with_a_stolen_lease,
        under_another_name,
        malformed,
        oversized,
    ],
)
def test_no_edge_moves_for_it(attack: Attack, undisturbed: Moved) -> None:
    with LibraryBoard() as board:
        run = Tapped(board, {"analysis": "reader"})
        moving(run)
        accepted, number = run.loop.core.gate.counts["accepted"], 0

        def strike() -> bool:
            nonlocal number
            if int(run.loop.state[0].ticks) % 4 == 0:
                run.loop.request(*attack(run, number))
                number += 1
            return False

        run.run(MOVE_S, strike)
        assert number == 100 and run.loop.core.gate.counts["accepted"] == accepted
        assert sum(run.loop.core.gate.counts.values()) == accepted + number
        assert moved(run) == undisturbed


def test_what_is_malformed_is_counted_and_logged(board: LibraryBoard) -> None:
    run = Tapped(board)
    run.loop.request("intruder", b"junk")
    assert run.loop.core.gate.counts["malformed"] == 1 and run.loop.core.gate.state().malformed == 1
    assert any("intruder: request: malformed" in log.text for log in run.logs)  # type: ignore[attr-defined]


def test_the_attack_would_have_moved_it_with_the_lease(undisturbed: Moved) -> None:
    with LibraryBoard() as board:
        run = Tapped(board)
        moving(run)
        reply = run.loop.request("scenario", encode(run.forged(commander="scenario", lease=run.commander._lease)))
        assert reply is not None and reply.result == "accepted"
        run.run(MOVE_S)
        assert moved(run) != undisturbed


def test_a_stop_from_a_second_commander_stops_and_stays_stopped(board: LibraryBoard) -> None:
    run = Tapped(board)
    moving(run)
    run.run(0.1)
    stop = run.forged(action="stop", target="none", target_m=None)
    assert run.loop.request("intruder", encode(stop)).result == "accepted"  # type: ignore[union-attr]
    assert run.run(0.2, lambda: run.phase == Phase.STOPPED)
    run.run(0.2)
    at_rest = moved(run)
    refused = run.command("target", "position", target_m=ELSEWHERE)
    assert run.command("hold").accepted and not refused.accepted and "disarm and arm again" in refused.reason
    run.run(0.2)
    assert moved(run).steps == at_rest.steps and run.phase == Phase.STOPPED


@pytest.fixture(scope="module")
def armed() -> Iterator[Tapped]:
    with LibraryBoard() as board:
        run = Tapped(board)
        assert run.arm()
        run.run(0.5)
        yield run


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    payload=st.binary(max_size=MAX_PAYLOAD_BYTES + 500)
    | st.dictionaries(
        st.sampled_from(["schema_version", "id", "action", "target", "lease", "commander", "expires_ns", "stamp_ns"]),
        st.none() | st.integers(-(2**63), 2**63) | st.text(max_size=20),
    ).map(msgpack.packb),
    name=st.text(max_size=40),
)
def test_nothing_random_moves_a_rig_at_rest(armed: Tapped, payload: bytes, name: str) -> None:
    before = moved(armed)
    armed.loop.request(name, payload)
    armed.run(0.004)
    assert moved(armed)[1:] == before[1:]
