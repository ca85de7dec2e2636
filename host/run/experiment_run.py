"""Performs an experiment script: in virtual time on the simulated rig, or as commander of the running rig."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from host.commissioning.experiment_script import Script, perform
from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter, new_recording_path
from host.run.commander import Commander
from protocol.commander import Acknowledgement
from protocol.enums import Phase
from protocol.errors import InputError
from protocol.rig_file import Rig
from protocol.topics import Message, RigState
from protocol.zenoh_session import Session
from sim.board import SimulatedBoard
from sim.effects import parse
from sim.scenario import Scenario
from sim.world import World, simulated_plant

ARM_WITHIN_S = 10.0
REST_BEFORE_S = 4.0  # stillness, from which a diagnosis takes the noise


class SimulatedCommands:
    """Command interface of a simulated rig (`sim.scenario.Scenario`)."""

    def __init__(self, scenario: Any) -> None:
        self._scenario = scenario

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give a command and return its answer, as `Scenario.command` does."""
        answer: Acknowledgement = self._scenario.command(action, target, **fields)
        return answer

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Run for `seconds` of virtual time or until `until()`, as `Scenario.run` does."""
        return bool(self._scenario.run(seconds, until))

    def now_s(self) -> float:
        """Return the virtual time in s."""
        return float(self._scenario.now_ns * 1e-9)

    def mode(self) -> str:
        """Return the label of the loop's phase."""
        return Phase(self._scenario.phase).label

    def tip_m(self) -> Sequence[float]:
        """Return the tip (3,) m as the loop predicts it."""
        return [float(v) for v in self._scenario.loop.outputs[0].tip_m]


def run_simulated(script: Script, rig: Rig, directory: Path, board: str, seed: int, effects: tuple[str, ...],
                  progress: Callable[[float], None] = lambda share: None) -> Path:  # fmt: skip
    """Run `script` on the simulated rig in virtual time; return the recording. Raises InputError, RuntimeError."""
    try:
        plant = simulated_plant(rig, seed, effects=tuple(map(parse, effects)))
    except ValueError as error:
        found, _, wanted = str(error).partition(": found ")[2].partition(", wanted ")
        raise InputError("--effect", found, wanted) from None
    target = new_recording_path(directory, "experiment")
    with (
        SimulatedBoard(board) as made,
        RecordingWriter(target, header_of(rig, "virtual", seed, {"job": script.says})) as recording,
    ):
        world = World(rig, plant, made, seed)

        def record(topic: str, message: Message) -> None:
            recording.write(topic, message, world.now_ns)

        scenario = Scenario(rig, world, record)
        scenario.run(REST_BEFORE_S)
        if not scenario.arm():
            raise RuntimeError("devices not ready")
        commands = SimulatedCommands(scenario)
        perform(script, commands, progress)
        commands.give("disarm")
        scenario.run(0.1)
    return target


class LiveCommands:
    """Command interface of a running rig over zenoh."""

    def __init__(self, session: Any, commander: Any) -> None:
        self._states, self._commander = session.latest("state"), commander
        self._state: RigState | None = None

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give a command and return its answer, as `Commander.give` does."""
        answer: Acknowledgement = self._commander.give(action, target, **fields)
        return answer

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait on the wall clock, with a check every 10 ms; end if the lease was lost."""
        end = time.monotonic() + seconds
        while True:
            self._look()
            if until():
                return True
            if time.monotonic() >= end:
                return False
            if self._commander.lost:
                raise RuntimeError(f"lease lost: {self._commander.lost}")
            time.sleep(min(0.01, max(end - time.monotonic(), 0.0)))

    def _look(self) -> None:
        state = self._states.take()
        if isinstance(state, RigState):
            self._state = state

    def now_s(self) -> float:
        """Return CLOCK_MONOTONIC in s."""
        return time.monotonic()

    def mode(self) -> str:
        """Return the loop's phase, empty before the first message."""
        self._look()
        return self._state.mode if self._state else ""

    def tip_m(self) -> Sequence[float] | None:
        """Return the tip (3,) m as the loop predicts it."""
        tip_m = self._state.tip_m if self._state else None
        return None if tip_m is None else [float(v) for v in tip_m]


def run_live(script: Script, rig: Rig, progress: Callable[[float], None]) -> None:
    """Run `script` on the running rig of the rig file; its own services record. Raises RuntimeError."""
    with Session.of_rig(rig) as session, Commander(session, "experiment") as commander:
        commands = LiveCommands(session, commander)
        taken = commander.take()
        if not taken.accepted:
            raise RuntimeError(f"lease: {taken.reason}")
        if not commands.wait(2.0, lambda: commands.mode() != ""):
            raise RuntimeError("no message of the topic state from the rig within 2 s; check that it runs")
        if commands.mode() == "disarmed":
            armed = commander.arm()
            if not armed.accepted or not commands.wait(ARM_WITHIN_S, lambda: commands.mode() == "hold"):
                raise RuntimeError(f"not armed: {armed.reason or 'the loop does not hold'}")
        try:
            perform(script, commands, progress)
        finally:
            commander.disarm()
