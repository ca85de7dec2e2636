"""The main job in lock step: from rest to a beating wall, hold a force on it; computer and world in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np

from protocol.commander import Acknowledgement, CommandSender
from protocol.enums import Phase
from protocol.rig_file import Rig
from protocol.topics import Command, ForceEstimate, Message, Pose, Reply, SimulatedTruth, encode
from realtime.core.lines import FromRig
from realtime.core.lockstep import LockstepLoop, Publish
from realtime.drivers.stepper_board import LinkPhase
from sim.world import World

# Where the simulated wall stands and how the catheter is bent in front of it.
TARGET_M = (0.0, -0.0107, 0.025)

# Called with the newest poses of tip and shaft, stage and state (or None), and on a rig with a third sensor with its pose.
Estimator = Callable[..., ForceEstimate | None]


@runtime_checkable
class ReportingEstimator(Protocol):
    """An estimator that has more to publish than the force."""

    def reports(self) -> list[tuple[str, Message]]:
        """Return (topic, message) of what is new since the last call."""
        ...


SETTLE_S = 3.0
START_TIMEOUT_S = 10.0
TRUTH_EVERY = 10


@dataclass
class ContactJob:
    """What to do: press with `force_N` along `into` (unit, into the tissue) at `target_m`, `hold_s` after contact."""

    target_m: tuple[float, float, float]
    into: tuple[float, float, float] = (0.0, 0.0, 1.0)
    clearance_m: float = 0.004
    force_N: float = 0.2
    hold_s: float = 20.0
    approach_s: float = 15.0


@dataclass
class Outcome:
    """Result of a scenario. The steps (three axes) are taken at rest, before disarming."""

    contact: bool = False
    stopped: bool = False
    virtual_s: float = 0.0
    digest: str = ""
    steps_commanded: list[int] = field(default_factory=list)
    steps_on_pins: list[int] = field(default_factory=list)
    steps_reported: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class Scenario:
    """Runs `LockstepLoop` against `World`. `estimator` answers each tip pose after `estimator_delay_s`, if given.

    pace: 1.0 is real time, 0 is unlimited.
    """

    def __init__(
        self,
        rig: Rig,
        world: World,
        publish: Publish,
        *,
        estimator: Estimator | None = None,
        estimator_delay_s: float = 0.005,
        force_source: str = "sensor",
        pace: float = 0.0,
    ) -> None:
        self.world, self.pace = world, pace
        self._estimator, self._delay_ns = estimator, round(estimator_delay_s * 1e9)
        self._publish = publish
        self.loop = LockstepLoop(rig, force_source, self._on_message)
        self._leaving = self.loop.step(0, FromRig())
        self._latest: dict[str, Message] = {}
        self._commands = 0
        self.commander = CommandSender(self, "scenario", clock_ns=lambda: self.loop.now_ns, new_id=self._next_id)
        self._started = time.monotonic()
        self._stop = False

    @property
    def now_ns(self) -> int:
        """Return the virtual time in ns."""
        return self.world.now_ns

    def stop(self) -> None:
        """Ends the run after the present period; for signal handlers."""
        self._stop = True

    def _on_message(self, topic: str, message: Message) -> None:
        """All that the loop publishes goes out, and the estimator receives the poses."""
        self._publish(topic, message)
        self._latest[topic] = message
        if topic != "pose/tip" or self._estimator is None or "stage" not in self._latest:
            return
        shaft, state, rear = (self._latest.get(name) for name in ("pose/shaft", "state", "pose/rear"))
        third = () if rear is None else (rear,)
        estimate = self._estimator(message, shaft, self._latest["stage"], state, *third)
        if estimate is not None:
            assert isinstance(message, Pose)
            self.loop.estimate_at(msgspec.structs.replace(estimate, published_ns=message.arrival_ns + self._delay_ns))
        if isinstance(self._estimator, ReportingEstimator):
            for reported, report in self._estimator.reports():
                self._publish(reported, report)

    def step(self) -> None:
        """Run one period of the loop."""
        now_ns = self.world.now_ns + self.loop.period_ns
        arriving = self.world.exchange(now_ns, self._leaving)
        self._leaving = self.loop.step(now_ns, arriving)
        if self.loop.state[0].ticks % TRUTH_EVERY == 0:
            self._publish("sim/truth", _truth(self.world))
        if self.pace > 0:
            ahead_s = now_ns * 1e-9 / self.pace - (time.monotonic() - self._started)
            if ahead_s > 0.002:
                time.sleep(ahead_s)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Steps for `seconds` of virtual time, or until `until()`; True if that ended it."""
        end_ns = self.world.now_ns + round(seconds * 1e9)
        while self.world.now_ns < end_ns and not self._stop:
            self.step()
            if until():
                return True
        return False

    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        """Carry `command` to the loop, as its bytes, and the reply back."""
        return self.loop.request(command.commander, encode(command))

    def command(self, action: str, target: str = "none", **fields: object) -> Acknowledgement:
        """An operator's command, now, under the lease, which is taken first if it must be."""
        if not self.commander.lease_left_s:
            self.commander.take()
        return self.commander.give(action, target, **fields)

    def _next_id(self) -> str:
        self._commands += 1
        return f"scenario-{self._commands}"

    @property
    def phase(self) -> int:
        """Return the loop's phase (`realtime.control.records`)."""
        return int(self.loop.outputs[0].phase)

    def ready(self) -> bool:
        """Board configured, poses and forces arriving."""
        state = self.loop.state[0]
        return self.loop.core.link.phase is LinkPhase.READY and bool(state.predictor.started) and bool(state.force_seen)

    def arm(self) -> bool:
        """Wait for all devices, arm, and let the loop hold for a moment; False if that fails in START_TIMEOUT_S."""
        if not self.run(START_TIMEOUT_S, self.ready):
            return False
        self.command("arm")
        return self.run(1.0, lambda: bool(self.loop.outputs[0].valid))

    def press(self, job: ContactJob, progress: Callable[[str, float], None] = lambda phase, share: None) -> Outcome:
        """The whole job: arm, approach, hold, retract, disarm."""
        outcome = Outcome()
        if not self.arm():
            outcome.notes.append(f"devices not ready after {START_TIMEOUT_S} s of virtual time")
            return self._closed(outcome)
        self._shape(job)
        asked = self.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)
        if not asked.accepted:
            outcome.notes.append(f"contact not commanded: {asked.reason}")
        start_ns = self.world.now_ns

        def reporting(phase: str, seconds: float, done: Callable[[], bool]) -> bool:
            begin_ns = self.world.now_ns

            def watch() -> bool:
                if self.loop.state[0].ticks % 100 == 0:
                    progress(phase, (self.world.now_ns - begin_ns) / (seconds * 1e9))
                return done() or self.phase == Phase.STOPPED

            return self.run(seconds, watch) and done()

        outcome.contact = reporting("approach", job.approach_s, lambda: self.phase == Phase.CONTACT)
        if outcome.contact:
            reporting("hold", job.hold_s, lambda: False)
        else:
            outcome.notes.append(f"no contact within {(self.world.now_ns - start_ns) * 1e-9:.1f} s")
        outcome.stopped = self.phase == Phase.STOPPED
        if self._stop:
            self.command("target", "hold")
        else:
            self.command("target", "retract")
            reporting("retract", 2.0, lambda: self.phase == Phase.STOPPED)
        return self._closed(outcome)

    def _shape(self, job: ContactJob) -> bool:
        """Bend the catheter before the wall: a point `clearance_m` in front of the target, reached to 1 mm."""
        point = np.array(job.target_m) - job.clearance_m * np.array(job.into)
        self.command("target", "position", target_m=tuple(map(float, point)))
        inside_ns = 0

        def there() -> bool:
            nonlocal inside_ns
            off_m = np.linalg.norm(np.asarray(self.loop.outputs[0].tip_m) - point)
            inside_ns = inside_ns + self.loop.period_ns if off_m < 1e-3 else 0
            return inside_ns > 300_000_000

        return self.run(job.approach_s, there)

    def _closed(self, outcome: Outcome) -> Outcome:
        self._stop = False
        self.run(0.3)
        outcome.steps_commanded = [int(steps) for steps in self.loop.outputs[0].position_steps]
        outcome.steps_on_pins = self.world.steps.tolist()
        status = self.loop.core.link.status
        outcome.steps_reported = [] if status is None else [int(steps) for steps in status.position_steps]
        self.command("disarm")
        self.run(0.1)
        outcome.virtual_s = self.world.now_ns * 1e-9
        outcome.digest = self.world.digest
        return outcome


def _truth(world: World) -> SimulatedTruth:
    truth = world.plant.truth()
    tissue = world.plant.config.tissue
    wall_m = np.array(tissue.point_m) + truth["heart_m"] * np.array(tissue.normal)
    return SimulatedTruth(
        stamp_ns=world.now_ns,
        tip_m=tuple(map(float, truth["tip_m"])),
        wall_m=tuple(map(float, wall_m)),
        contact_force_N=tuple(map(float, truth["contact_force_N"])),
        distal_insertion_m=float(truth["insertion_m"]),
        distal_roll_rad=float(truth["roll_rad"]),
        distal_curvature_per_m=float(truth["curvature_per_m"]),
    )
