"""The two rigs that a protocol runs on: the simulated one in virtual time, and the running one over zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter, new_recording_path
from host.run.commander import Commander
from host.run.connection import may_run, not_running
from host.run.protocol_result import ProtocolResult
from host.run.protocol_run import Job, Progress, StepFailed, blank_result, carry_out
from protocol.commander import Acknowledgement
from protocol.errors import InputError
from protocol.messages import MessageType
from protocol.topics import Message, PlannedStep, Pose, RigCause, RigState, decode
from protocol.zenoh_session import Session
from sim.board import SimulatedBoard
from sim.effects import parse
from sim.scenario import Estimator, Scenario
from sim.world import World, simulated_plant

ARM_WITHIN_S = 10.0
# A rig that runs publishes its state 100 times a second; one of this computer without a socket does not run.
STATES_WITHIN_S, NOT_RUNNING_S = 3.0, 0.2


class SimulatedDrive:
    """A simulated rig in lock step (`sim.scenario.Scenario`). The operator of a simulation always confirms."""

    def __init__(self, scenario: Scenario, publish: Callable[[str, Message], None]) -> None:
        self._scenario, self._publish = scenario, publish
        self._states: list[RigState] = []
        self._poses: list[Pose] = []
        self._cause = ""

    def take(self, message: Message) -> None:
        """Keep a state, a pose of the tip or the first cause that the loop published."""
        if isinstance(message, RigCause):
            self._cause = _cause_text(message)
        elif isinstance(message, RigState):
            self._states.append(message)
        elif isinstance(message, Pose):
            self._poses.append(message)

    def poses(self) -> list[Pose]:
        """Return the tracker's poses of the tip since the last call; see DrivenRig.poses."""
        taken, self._poses = self._poses, []
        return taken

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command; see DrivenRig.give."""
        return self._scenario.command(action, target, **fields)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let virtual time pass, with a check at each new state; see DrivenRig.wait."""
        return self._scenario.run(seconds, lambda: bool(self._states) and until())

    def states(self) -> list[RigState]:
        """Return the loop's states since the last call; see DrivenRig.states."""
        taken, self._states = self._states, []
        return taken

    def first_cause(self) -> str:
        """Return the cause that the loop published last; see DrivenRig.first_cause."""
        return self._cause

    def operator(self, message: str) -> bool:
        """Confirm at once; see DrivenRig.operator."""
        self._scenario.commander.mark(f"operator: {message}"[:500])
        return True

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan; see DrivenRig.publish_step."""
        self._publish("plan", step)


def run_simulated(
    job: Job,
    directory: Path,
    board: str,
    seed: int,
    effects: tuple[str, ...] = (),
    estimator: Estimator | None = None,
    progress: Progress = lambda step, share: None,
) -> ProtocolResult:
    """Run the protocol on the simulated rig in virtual time, recorded into `directory`. Raises InputError, RuntimeError."""
    try:
        plant = simulated_plant(job.rig, seed, effects=tuple(map(parse, effects)))
    except ValueError as error:
        raise InputError.from_sentence(f"--effect: {str(error).partition(': ')[2]}") from None
    path = new_recording_path(directory, "protocol")
    header = header_of(job.rig, "virtual", seed, {"job": job.protocol.file.name})
    with SimulatedBoard(board) as made, RecordingWriter(path, header) as recording:
        world = World(job.rig, plant, made, seed)
        listeners: list[Callable[[Message], None]] = []

        def publish(topic: str, message: Message) -> None:
            recording.write(topic, message, world.now_ns)
            if topic in ("state", "pose/tip", "cause"):
                for listener in listeners:
                    listener(message)

        scenario = Scenario(job.rig, world, publish, estimator=estimator)
        driven = SimulatedDrive(scenario, publish)
        listeners.append(driven.take)
        if not scenario.arm():
            raise RuntimeError("devices not ready")
        result = carry_out(job, driven, blank_result(job, True, str(path)), progress)
        scenario.command("disarm")
        scenario.run(0.1)
    return result


class LiveDrive:
    """The running rig over zenoh. ask_operator: shows a message and returns whether to continue."""

    def __init__(self, session: Session, commander: Commander, ask_operator: Callable[[str], bool]) -> None:
        self._commander, self._ask = commander, ask_operator
        self._steps, self._causes, self._cause = session.publisher("plan"), session.latest("cause"), ""
        self._subscriber = session.ring("state", 1024)
        self._pose_subscriber = session.ring("pose/tip", 512)

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command over zenoh; see DrivenRig.give."""
        return self._commander.give(action, target, **fields)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait, with a check every 10 ms; see DrivenRig.wait. Raises StepFailed if the lease was lost."""
        end_s = time.monotonic() + seconds
        while True:
            if until():
                return True
            if time.monotonic() >= end_s:
                return False
            if self._commander.lost:
                raise StepFailed(f"lease lost: {self._commander.lost}")
            time.sleep(0.01)

    def states(self) -> list[RigState]:
        """Return the loop's states since the last call; see DrivenRig.states. Malformed ones are omitted."""
        return _taken(self._subscriber, RigState)

    def poses(self) -> list[Pose]:
        """Return the tracker's poses since the last call; see DrivenRig.poses. Malformed ones are omitted."""
        return _taken(self._pose_subscriber, Pose)

    def first_cause(self) -> str:
        """Return the newest cause that the rig published; see DrivenRig.first_cause."""
        newest = self._causes.take()
        if isinstance(newest, RigCause):
            self._cause = _cause_text(newest)
        return self._cause

    def operator(self, message: str) -> bool:
        """Ask the operator; see DrivenRig.operator."""
        return self._ask(message)

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan; see DrivenRig.publish_step."""
        self._steps.put(step)


def _cause_text(cause: RigCause) -> str:
    return f"{cause.says} {cause.remedy}" if cause.name else ""


def _taken(subscriber: Any, kind: type[MessageType]) -> list[MessageType]:
    taken: list[MessageType] = []
    while (sample := subscriber.try_recv()) is not None:
        try:
            taken.append(decode(kind, bytes(sample.payload)))
        except ValueError:
            continue
    return taken


def run_live(job: Job, ask_operator: Callable[[str], bool], progress: Progress = lambda step, share: None) -> ProtocolResult:
    """Run the protocol on the running rig of the rig file; its services record. Raises InputError, RuntimeError.

    The rig is armed where it is disarmed. At the end, and on Ctrl-C, it holds and is left armed.
    """
    with Session.of_rig(job.rig) as session, Commander(session, "protocol") as commander:
        driven = LiveDrive(session, commander, ask_operator)
        newest: list[RigState] = []

        def came() -> bool:
            newest.extend(driven.states())
            return bool(newest)

        patience_s = STATES_WITHIN_S if may_run(job.rig) else NOT_RUNNING_S
        if not driven.wait(patience_s, came):
            raise not_running(job.rig)
        taken = commander.take()
        if not taken.accepted:
            raise RuntimeError(taken.reason)
        if newest[-1].mode == "disarmed":
            armed = commander.arm()
            if not armed.accepted or not driven.wait(ARM_WITHIN_S, lambda: came() and newest[-1].mode == "hold"):
                raise RuntimeError(f"not armed: {armed.reason or 'the loop does not hold'}")
        try:
            return carry_out(job, driven, blank_result(job, False), progress)
        except BaseException:
            commander.hold()
            raise
