"""One run with a fault: the lock-step job with bad cables, pauses and a dying model process, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from protocol.enums import BoardState, Phase, SafetyAction
from protocol.rig_file import Rig
from protocol.topics import ForceEstimate, Log, Message
from realtime.control import safety
from realtime.core.lines import FromRig, ToRig
from realtime.core.lockstep import Publish
from sim.line_noise import LineNoise
from sim.scenario import Estimator, Scenario
from sim.world import World

MS = 1_000_000
# The counts of the drivers that say that something is wrong.
# The computer has been up for so long when the rig is switched on, so that its clock can be set back.
CLOCK_START_NS = 20_000_000_000
_BAD_STATUS = (
    "crc_errors",
    "sequence_errors",
    "underruns",
    "rejected",
    "expired",
    "overflows",
    "rx_overruns",
    "encoder_errors",
)
_BAD_TRACKER = (
    "poll_timeouts",
    "damaged",
    "unexpected",
    "frames_missed",
    "frames_strange",
    "missing",
    "not_a_pose",
    "frozen",
    "warnings",
    "errors",
)
_BAD_FORCE = ("malformed", "duplicates", "old", "strays", "lost", "status_errors", "wild", "frozen", "silences")


class FaultyScenario(Scenario):
    """A `Scenario` with faults that are injected while it runs: `noise` on the cables, and the attributes below.

    pause_ns: the computer stands still for so long before its next period, the world does not; clock_shift_ns: added
    to the computer's clock; host: "well", "dead" (never answers again) or "hung" (answers nothing); host_late_ns: more
    delay of every answer.
    """

    def __init__(
        self,
        rig: Rig,
        world: World,
        publish: Publish,
        seed: int,
        estimator: Estimator | None = None,
        force_source: str = "sensor",
    ) -> None:
        self.noise = LineNoise(seed)
        self.pause_ns = self.clock_shift_ns = self.host_late_ns = 0
        self.host = "well"
        self.wrong: Callable[[ForceEstimate], ForceEstimate] = lambda estimate: estimate
        self.watchers: list[Watcher] = []
        self.out = publish
        super().__init__(
            rig,
            world,
            self._publish_to_watchers,
            estimator=None if estimator is None else self._estimate_unless_failed,
            force_source=force_source,
        )
        self.clock_shift_ns = CLOCK_START_NS
        self._model = estimator

    def _publish_to_watchers(self, topic: str, message: Message) -> None:
        self.out(topic, message)
        for watcher in self.watchers:
            watcher.receive(topic, message)

    def _estimate_unless_failed(
        self, tip: Message, shaft: Message | None, stage: Message, state: Message | None, *third: Message
    ) -> ForceEstimate | None:
        if self.host != "well" or self._model is None:
            return None
        estimate = self._model(tip, shaft, stage, state, *third)
        return estimate if estimate is None else self.wrong(estimate)

    def step(self) -> None:
        """One period of the loop, after the pause that is due."""
        until_ns = self.world.now_ns + self.loop.period_ns + self.pause_ns
        self.pause_ns = 0
        leaving = self.noise.outgoing(self._leaving, self.world.now_ns)
        got = FromRig()
        while self.world.now_ns < until_ns:
            part = self.world.exchange(min(self.world.now_ns + MS, until_ns), leaving)
            leaving = ToRig()
            got = FromRig(got.board + part.board, got.tracker + part.tracker, got.force + part.force)
            for watcher in self.watchers:
                watcher.see_world()
        arriving = self.noise.incoming(got, until_ns)
        delay_ns = self._delay_ns
        self._delay_ns = delay_ns + self.host_late_ns
        self._leaving = self.loop.step(until_ns + self.clock_shift_ns, arriving)
        self._delay_ns = delay_ns
        for watcher in self.watchers:
            watcher.see_loop()


@dataclass
class FaultOutcome:
    """What came of one fault. Times in s from its injection; None: did not happen.

    large_s: since when it was so large, as long as `within_s` without a break, that it had to be found.
    """

    detected_s: float | None = None
    detected_by: str = ""
    large_s: float | None = None
    action: str = "none"
    board_fault: str = ""
    causes: list[str] = field(default_factory=list)
    peak_force_N: float = 0.0
    moved_after_m: float = 0.0
    rest_s: float = 0.0
    rearmed: bool = False
    final_phase: str = ""
    poses_lost: int = 0
    counts: dict[str, int] = field(default_factory=dict)


class Watcher:
    """Observes a run from the moment of the fault on and notes what happens. `close` gives the outcome.

    Detected is: a cause of the failsafe that did not stand before, a logged warning or error, or a driver's or the
    board's count of bad frames or readings that has grown; whichever is first. `large` and `within_s` are the fault's
    own (`sim.fault_table.FaultKind`).
    """

    def __init__(
        self, run: FaultyScenario, large: Callable[[FaultyScenario], bool] | None = None, within_s: float = 0.0
    ) -> None:
        self.run, self.outcome = run, FaultOutcome()
        self._large, self._within_s = large, within_s
        self._large_since_s: float | None = None
        self._begin_ns = run.world.now_ns
        self._causes = int(run.loop.outputs[0].cause)
        self._counts = _bad_counts(run)
        self._worst = int(SafetyAction.NONE)
        self._edges = int(run.world.edges.sum())
        self._from_m: float | None = None
        self._stopped = False
        self._poses = 0

    @property
    def now_s(self) -> float:
        """Return the time since the fault in s."""
        return (self.run.world.now_ns - self._begin_ns) * 1e-9

    def _detected(self, by: str) -> None:
        if self.outcome.detected_s is None:
            self.outcome.detected_s, self.outcome.detected_by = self.now_s, by

    def receive(self, topic: str, message: Message) -> None:
        """Take in a message that the loop published."""
        if topic == "pose/tip":
            self._poses += 1
        elif isinstance(message, Log) and message.level in ("warning", "error"):
            self._detected(f"log: {message.source}: {message.text}"[:120])

    def see_world(self) -> None:
        """After each millisecond of the world, also of one without a computer."""
        world, outcome = self.run.world, self.outcome
        outcome.peak_force_N = max(outcome.peak_force_N, float(np.linalg.norm(world.plant.contact_force_N)))
        edges = int(world.edges.sum())
        if edges != self._edges:
            self._edges, outcome.rest_s = edges, self.now_s
        if outcome.detected_s is not None:
            insertion_m = float(world.stages.position[0])
            if self._from_m is None:
                self._from_m = insertion_m
            outcome.moved_after_m = max(outcome.moved_after_m, insertion_m - self._from_m)
        self._see_size()

    def _see_size(self) -> None:
        """Whether the fault has been too large for too long to be overlooked."""
        if self._large is None or self.outcome.large_s is not None:
            return
        if not self._large(self.run):
            self._large_since_s = None
        elif self._large_since_s is None:
            self._large_since_s = self.now_s
        elif self.now_s - self._large_since_s > self._within_s:
            self.outcome.large_s = self._large_since_s

    def see_loop(self) -> None:
        """After each period of the loop."""
        outputs, status = self.run.loop.outputs[0], self.run.loop.core.link.status
        new = int(outputs.cause) & ~self._causes
        if new:
            self._detected("cause: " + ", ".join(safety.names(new)))
            for name in safety.names(new):
                if name not in self.outcome.causes:
                    self.outcome.causes.append(name)
        if self.outcome.detected_s is None:
            grown = [name for name, count in _bad_counts(self.run).items() if count > self._counts.get(name, 0)]
            if grown:
                self._detected("count: " + ", ".join(grown))
        self._worst = max(self._worst, int(outputs.action))
        if status is not None and status.state == BoardState.FAULT:
            self.outcome.board_fault = str(status.fault)
        phase = int(outputs.phase)
        if self._stopped and phase not in (Phase.STOPPED, Phase.DISARMED, Phase.RETRACT):
            self.outcome.rearmed = True
        self._stopped = self._stopped or (phase == Phase.STOPPED and int(outputs.action) == SafetyAction.STOP)

    def close(self) -> FaultOutcome:
        """The outcome of the run so far."""
        outcome, run = self.outcome, self.run
        outcome.action = SafetyAction(self._worst).label
        outcome.final_phase = Phase(run.phase).label
        expected = int(self.now_s * run.loop.rig.tracker.rate_hz)
        outcome.poses_lost = max(expected - self._poses - 1, 0)
        outcome.counts = {
            name: count - self._counts.get(name, 0)
            for name, count in _bad_counts(run).items()
            if count > self._counts.get(name, 0)
        }
        return outcome


def _bad_counts(run: FaultyScenario) -> dict[str, int]:
    """All counts of the drivers and of the board that only grow when something is wrong."""
    loop, sensors = run.loop, run.loop.sensors
    counts: dict[str, Any] = {f"board.{name}": getattr(loop.core.link.status, name, 0) for name in _BAD_STATUS}
    line = loop.core.link.decoder.counters
    counts |= {
        "line.crc_errors": line.crc_errors,
        "line.lost": line.lost,
        "line.repeated": line.repeated,
        "loop.missed_ticks": loop.missed_ticks,
    }
    counts |= {f"tracker.{name}": value for name, value in vars(sensors.tracker.counters).items() if name in _BAD_TRACKER}
    counts |= {f"force.{name}": value for name, value in vars(sensors.force_sensor.counters).items() if name in _BAD_FORCE}
    return counts


__all__ = ["FaultOutcome", "FaultyScenario", "Watcher"]
