"""What a fault campaign tests is what a rig runs: a run in lock step, played to the wall-clock shell, says the same."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import pytest

from protocol.enums import Phase
from protocol.rig_file import Rig, load_rig
from protocol.topics import Message, Reply
from realtime.control.tick import tick
from realtime.core import process as wall_clock
from realtime.core import rig_core
from realtime.core.process import RealtimeProcess
from realtime.core.rig_core import Arrived, Leaving
from realtime.loop.clock import Clock
from realtime.loop.loop_thread import NativeLoop
from sim.forked_board import LibraryBoard
from sim.plant import Plant, PlantConfig
from sim.scenario import Scenario
from sim.sensor_faults import SensorFault
from sim.world import World
from tests.realtime.conftest import RIG_FILE

TARGET_M = (0.0, -0.0107, 0.021)


@dataclasses.dataclass
class Turn:
    """One step of the core in lock step: what arrived, what left, and whether a tick followed it."""

    now_ns: int
    arrived: Arrived
    leaving: Leaving
    ticked: bool


class Recorded(Scenario):
    """A scenario that keeps what its core was given and what it returned, and the set-points of each tick."""

    def __init__(self, board: LibraryBoard) -> None:
        rig = load_rig(RIG_FILE)
        self.turns: list[Turn] = []
        self.outputs: list[bytes] = []
        plant = Plant(PlantConfig(tool_offsets_m=(0.0, rig.tracker.shaft_sensor_offset_m)), 1)
        super().__init__(rig, World(rig, plant, board, 1), lambda topic, message: None)
        core, step = self.loop.core, self.loop.core.step

        def kept(now_ns: int, arrived: Arrived) -> Leaving:
            leaving = step(now_ns, arrived)
            self.turns.append(Turn(now_ns, dataclasses.replace(arrived, ticks=()), leaving, not arrived.requests))
            return leaving

        core.step = kept  # type: ignore[method-assign]

    def step(self) -> None:
        super().step()
        self.outputs.append(self.loop.outputs.tobytes())


class StandIn(NativeLoop):
    """The compiled loop's memory and mailboxes, but a tick when the test says so."""

    alive = True  # type: ignore[assignment]

    def period(self, now_ns: int) -> bytes:
        """One pass, as `native_loop.make_loop` makes it; returns the outputs."""
        for name, box in self._mailboxes.items():
            box.read(self._memory.inputs[name])
        self._memory.inputs[0].now_ns = now_ns
        tick(self._params, self._state, self._memory.inputs, self._memory.outputs)
        self._memory.loop[0].tick += 1
        self.telemetry.push(loop=self._memory.loop[0], outputs=self._memory.outputs[0])
        return bytes(self._memory.outputs.tobytes())


class Network:
    """Stands for the zenoh session: keeps what is published."""

    def __init__(self, *_: object) -> None:
        self.messages: list[tuple[str, Message]] = []

    @classmethod
    def of_rig(cls, rig: Rig) -> Network:
        return cls()

    def publisher(self, topic: str) -> Any:
        network = self

        class Publisher:
            def put(self, message: Message) -> None:
                network.messages.append((topic, message))

        return Publisher()

    def latest(self, topic: str) -> Any:
        return None


class Port:
    """Stands for the board's port."""

    def __init__(self, *_: object) -> None:
        return

    def fileno(self) -> int:
        return -1


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> Iterator[RealtimeProcess]:
    """The process of the wall clock with virtual time, and neither network nor ports."""
    leases = iter(range(1, 1000))
    monkeypatch.setattr(rig_core.secrets, "token_hex", lambda _: f"lease-{next(leases)}")
    for name, stand_in in (("Session", Network), ("BoardPort", Port), ("NativeLoop", StandIn)):
        monkeypatch.setattr(wall_clock, name, stand_in)
    clock = Clock.virtual(0)
    monkeypatch.setattr(wall_clock.Clock, "monotonic", lambda: clock)
    yield RealtimeProcess(load_rig(RIG_FILE))


def eventful(run: Recorded) -> None:
    """Refused and accepted commands, a move, a silent tracker, a return, a clearing, a second arming, a stop."""
    run.command("arm")
    assert run.arm()
    run.command("target", "position", target_m=TARGET_M)
    run.command("target", "position", target_m=(0.0, 0.0, 0.5))
    run.run(0.5)
    run.command("jog", axis="insertion", travel_unit=-0.001, speed_unit_per_s=0.005)
    run.run(0.1)
    run.command("jog", axis="tip", direction=(0.0, 1.0, 0.0), travel_unit=0.001, speed_unit_per_s=0.005)
    run.run(0.1)
    run.command("hold")
    run.run(0.1)
    run.command("zero")
    run.command("mark", note="before the tracker is silent")
    now_ns = run.world.now_ns
    run.world.tracker.faults.append(SensorFault("silent", now_ns, now_ns + 1_500_000_000))
    run.run(1.0)
    run.command("arm")
    run.run(5.0, lambda: run.phase == Phase.DISARMED)
    run.command("clear_fault")
    run.run(0.2)
    run.command("arm")
    run.run(0.3)
    run.loop.request("intruder", b"junk")
    run.command("stop")
    run.run(0.1)
    run.command("disarm")
    run.run(0.6)


@pytest.mark.slow
def test_the_wall_clock_shell_says_and_does_what_the_lock_step_says_and_does(shell: RealtimeProcess) -> None:
    with LibraryBoard() as board:
        run = Recorded(board)
        eventful(run)
    outputs = iter(run.outputs)
    replies: list[tuple[Reply | None, Reply | None]] = []
    loop, network, clock = shell.loop, shell._session, shell.clock
    assert isinstance(loop, StandIn) and isinstance(network, Network)
    shell.shared.step(Arrived())  # the scenario's own first period
    loop.period(0)
    network.messages.clear()
    different = 0
    for turn in run.turns:
        clock.advance_to(turn.now_ns)
        leaving = shell.shared.step(turn.arrived)
        assert b"".join(leaving.frames) == b"".join(turn.leaving.frames)
        assert leaving.changed == turn.leaving.changed
        replies += list(zip(leaving.replies, turn.leaving.replies, strict=True))
        if turn.ticked:
            different += loop.period(turn.now_ns) != next(outputs)
    assert different == 0
    assert replies and all(ours == theirs for ours, theirs in replies)
    wanted = [message for turn in run.turns for message in turn.leaving.messages if message[0] != "loop"]
    assert [message for message in network.messages if message[0] != "loop"] == wanted
    texts = [message.text for topic, message in wanted if topic == "log"]  # type: ignore[attr-defined]
    for words in (
        "arm: accepted",
        "jog: accepted",
        "force sensor zeroed",
        "before the tracker",
        "wanted fresh readings",
        "stop: no pose",
        "is back: disarmed",
    ):
        assert any(words in text for text in texts), words
