"""The main job on the simulated rig, in lock step: press on a beating wall, record it, report on it."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator
from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter, new_recording_path
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Message
from sim.board import SimulatedBoard
from sim.effects import parse
from sim.scenario import TARGET_M, ContactJob, Outcome, Scenario
from sim.world import World, simulated_plant

Progress = Callable[[str, float, float], None]


@dataclass(frozen=True)
class DemoSettings:
    """force_N: requested; hold_s: after contact; pace: 1 is real time, 0 unlimited; board: avr, native or auto.

    effects: planted in the simulated rig, as `sim.effects.parse` reads them.
    """

    board: str = "auto"
    seed: int = 1
    force_N: float = 0.2
    hold_s: float = 20.0
    pace: float = 1.0
    force_source: str = "sensor"
    estimator: str = DEFAULT_ESTIMATOR
    rig_file: Path = SIMULATED_RIG
    directory: Path = Path("runs")
    effects: tuple[str, ...] = ()


@dataclass
class DemoRun:
    """Result of a run: the recording, the end of the scenario, the counters of board and loop."""

    recording: Path
    outcome: Outcome
    board_kind: str
    counts: dict[str, Any] = field(default_factory=dict)
    interrupted: str = ""
    recording_failure: str = ""


def run_lockstep(settings: DemoSettings, progress: Progress = lambda phase, share, force: None) -> DemoRun:
    """Run the job and record it. SIGINT and SIGTERM end it in order; the recording is closed in any case.

    Raises InputError, BoardUnavailable, ValueError before anything moves.
    """
    rig = load_rig(settings.rig_file)
    service = EstimationService(load_estimator(settings.estimator, rig))
    plant = simulated_plant(rig, settings.seed, effects=tuple(map(parse, settings.effects)))
    with SimulatedBoard(settings.board) as board:
        world = World(rig, plant, board, settings.seed)
        path = new_recording_path(settings.directory, "demo")
        notes = {"board": board.kind, "job": f"hold {settings.force_N} N for {settings.hold_s} s"}
        with RecordingWriter(path, header_of(rig, "virtual", settings.seed, notes)) as recording:
            run = DemoRun(path, Outcome(), board.kind)

            def record(topic: str, message: Message) -> None:
                recording.write(topic, message, world.now_ns)

            scenario = Scenario(
                rig, world, record, estimator=service, force_source=settings.force_source, pace=settings.pace
            )
            with _SignalsStop(scenario, run):
                run.outcome = scenario.press(
                    ContactJob(target_m=TARGET_M, force_N=settings.force_N, hold_s=settings.hold_s),
                    lambda phase, share: progress(phase, share, float(scenario.loop.outputs[0].normal_force_N)),
                )
            run.counts = _counts(scenario, world, run.outcome)
        if recording.failure:
            run.recording_failure = recording.failure
    return run


def _counts(scenario: Scenario, world: World, outcome: Outcome) -> dict[str, Any]:
    """Return the counters that must agree and those that must be zero."""
    loop, status = scenario.loop, scenario.loop.core.link.status
    return {
        "missed_ticks": 0,
        "faults": list(loop.core.board_errors),
        "steps_commanded": outcome.steps_commanded,
        "steps_on_pins": outcome.steps_on_pins,
        "steps_reported": outcome.steps_reported,
        "crc_errors": 0 if status is None else status.crc_errors + loop.core.link.decoder.counters.crc_errors,
        "underruns": 0 if status is None else status.underruns,
        "edges": world.edges.tolist(),
        "digest": world.digest,
    }


class _SignalsStop:
    """While active, SIGINT and SIGTERM end the scenario instead of the process."""

    def __init__(self, scenario: Scenario, run: DemoRun) -> None:
        self._scenario, self._run = scenario, run
        self._before: dict[int, Any] = {}

    def __enter__(self) -> None:
        def on_signal(number: int, frame: FrameType | None) -> None:
            self._run.interrupted = signal.Signals(number).name
            self._scenario.stop()

        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, on_signal)

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


def exit_status(run: DemoRun, reached: bool) -> int:
    """Return 0 if the run was completed and recorded; 130 or 143 after a signal; 1 otherwise."""
    if run.interrupted:
        return 128 + int(getattr(signal, run.interrupted))
    return 0 if reached and not run.outcome.stopped and not run.recording_failure else 1


__all__ = ["DemoRun", "DemoSettings", "exit_status", "run_lockstep"]
