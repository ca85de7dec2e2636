"""Watching a running rig: windows held against the twin, and an alarm with subsystem and probable cause when they part."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Problem, finish, minimize
from host.diagnosis.estimation.noise import Noise
from host.diagnosis.live.twin import FrameCollector, Twin, TwinFit
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.screening import screen
from protocol.rig_file import Rig
from protocol.topics import Alarm, ForceSensor, Message, Pose, RigState, Stage

Array = npt.NDArray[np.float64]
POSE_ROWS = 12
SMALLEST_SHARE = 0.1  # of the mismatch that a cause has to explain to be named
AS_GOOD = 1.15  # error relative to the best cause's with which another still counts
IDLE_S = 0.02
REST_S = 0.005
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class LiveSettings:
    """learn_s of motion calibrate the twin; then every every_s the last window_s are looked at.

    level, shift: how far RMS (as a factor) and mean (in spreads of a mean over a window) may go before an alarm;
    settle_s: so long it has to last; a cause is then sought in all that was received since.
    suspects: candidates fitted before one is named.
    """

    learn_s: float = 10.0
    window_s: float = 3.0
    every_s: float = 0.5
    level: float = 1.45
    shift: float = 6.0
    settle_s: float = 5.0
    suspects: int = 8


@dataclass(frozen=True)
class Baseline:
    """What was usual while learning, per output row: mean and RMS of the residual, spread of its mean over a window."""

    mean: Array
    rms: Array
    spread: Array


@dataclass(frozen=True)
class Suspect:
    """A cause that was fitted to the window: effect@subsystem, share of the mismatch explained, parameters."""

    name: str
    explained: float
    parameters: int


class Watch:
    """Receives the rig's messages; `look` gives an alarm when the last window is no longer what the twin expects.

    All time is the rig's own (stamps of its poses), so that recorded messages and virtual time do as well as a live rig.
    """

    def __init__(self, rig: Rig, settings: LiveSettings | None = None, rest: Callable[[], None] = lambda: None) -> None:
        """`rest` is called between the steps of long computations: a rig on the same machine must not be starved."""
        self.settings, self._rest = settings or LiveSettings(), rest
        self.twin = Twin(rig)
        self.frames = FrameCollector(rig, max(self.settings.learn_s, 30.0))
        self.candidate_effects = [c for c in candidates(self.twin.ports, True, self.twin.taken) if c.port.name != "contact"]
        self.calibration: TwinFit | None = None
        self.baseline: Baseline | None = None
        self._armed_at_ns: int | None = None
        self._next_ns = 0
        self._since_ns: int | None = None
        self.reported = False
        self.score = 0.0

    def receive(self, topic: str, message: Message) -> None:
        """Take in one message of the rig."""
        if isinstance(message, RigState):
            armed = message.mode not in ("disarmed", "homing", "stopped")
            if not armed:
                self._armed_at_ns = None
            elif self._armed_at_ns is None:
                self._armed_at_ns = message.stamp_ns
        self.frames.receive(topic, message)

    @property
    def phase(self) -> str:
        """What is being done: waiting, learning or watching."""
        return "watching" if self.baseline else "learning" if self._armed_at_ns is not None else "waiting"

    def look(self) -> Alarm | None:
        """Call often; every `every_s` of the rig's time something is done. An alarm comes once for each mismatch."""
        self.frames.settle()
        stamps = self.frames.stamps_ns
        if not stamps or stamps[-1] < self._next_ns or self._armed_at_ns is None:
            return None
        self._next_ns = stamps[-1] + round(self.settings.every_s * SECOND_NS)
        if self.baseline is None:
            if stamps[-1] - self._armed_at_ns >= self.settings.learn_s * SECOND_NS:
                self._learn()
            return None
        return self._compare()

    def _rows(self, seconds: float) -> int:
        return min(len(self.frames.rows), round(seconds * SECOND_NS / self.frames.period_ns))

    def _learn(self) -> None:
        """Calibrates the twin on what was received since arming, and notes how well it then agrees, second by second."""
        recording = self.frames.recording(-self._rows(self.settings.learn_s))
        self.calibration = self.twin.calibrate(recording, self._rest)
        segment, residual = self._residual(-self._rows(self.settings.learn_s))
        residual = residual[:, segment.n // 4 :]  # the approach differs from what follows
        mean, rms = np.nanmean(residual, axis=1), np.sqrt(np.nanmean(residual**2, axis=1))
        blocks = np.array_split(residual, max(3, round(0.75 * self.settings.learn_s)), axis=1)
        spread = np.std([np.nanmean(block, axis=1) for block in blocks], axis=0) / np.sqrt(self.settings.window_s)
        least = rms / np.sqrt(self._rows(self.settings.window_s))
        self.baseline = Baseline(mean, np.maximum(rms, 1e-9), np.maximum(spread, least))

    def _residual(self, first: int) -> tuple[Segment, Array]:
        """Rows from `first` on as a segment of the twin, and measured minus expected (12, n)."""
        assert self.calibration is not None
        segment = self.twin.prepare(self.calibration.applied(self.frames.recording(first)))
        self.twin.correct(segment, self.calibration.theta)
        segment.y[POSE_ROWS:] = np.nan
        expected = self.twin.simulate(segment, self.calibration.theta, [])
        return segment, (segment.y - expected)[:POSE_ROWS]

    def _compare(self) -> Alarm | None:
        """The last window against the baseline."""
        assert self.baseline is not None
        score = self._score(self._residual(-self._rows(self.settings.window_s))[1])
        self.score = float(np.max(score))
        now_ns = self.frames.stamps_ns[-1]
        if not np.max(score) > 1.0:
            self._since_ns, self.reported = None, False
            return None
        if self._since_ns is None:
            self._since_ns = now_ns
        since_s = (now_ns - self._since_ns) * 1e-9
        if since_s < self.settings.settle_s or self.reported:
            return None
        self.reported = True
        return self._alarm(score, since_s)

    def _score(self, residual: Array) -> Array:
        """How far each row (12,) is beyond what is allowed: above 1 is an alarm."""
        b, s = self.baseline, self.settings
        assert b is not None
        good = np.mean(np.isfinite(residual), axis=1) > 0.3
        filled = np.where(good[:, None], residual, 0.0)
        level = np.sqrt(np.nanmean(filled**2, axis=1)) / b.rms / s.level
        shift = np.abs(np.nanmean(filled, axis=1) - b.mean) / b.spread / s.shift
        return np.where(good, np.maximum(level, shift), 0.0)

    def _alarm(self, score: Array, since_s: float) -> Alarm:
        now_ns, row = self.frames.stamps_ns[-1], int(np.argmax(score))
        suspects = self._suspects(self._residual(-self._rows(since_s))[0])
        channel = self.twin.outputs[row].channel
        first, explained = (
            (suspects[0].name, suspects[0].explained) if suspects else (f"unlisted@{self.twin.outputs[row].subsystem}", 0.0)
        )
        effect, _, subsystem = first.partition("@")
        others = ", ".join(s.name for s in suspects[1:])
        words = (
            f"{subsystem}: probably {effect}, which explains {explained:.0%}"
            + (f" (indistinguishable from {others})" if others else "")
            + f"; {channel} has differed from the twin for {since_s:.1f} s"
        )
        return Alarm(
            stamp_ns=now_ns,
            subsystem=subsystem,
            effect=effect,
            channel=channel,
            score=float(score[row]),
            explained=float(np.clip(explained, 0.0, 1.0)),
            since_ns=now_ns - round(since_s * SECOND_NS),
            words=words,
        )

    def _suspects(self, segment: Segment) -> list[Suspect]:
        """Causes that explain the window about as well as any does, the one with the fewest parameters first."""
        b, calibration = self.baseline, self.calibration
        assert b is not None and calibration is not None
        segment.y[:POSE_ROWS] -= b.mean[:, None]
        scale = np.concatenate([b.rms, np.ones(len(self.twin.outputs) - POSE_ROWS)])
        segment.weight = scale
        problem = Problem(self.twin, [segment], [Noise(float(s), np.zeros(0), "while learning") for s in scale], scale)
        fit = finish(problem, Fit((), calibration.theta))
        ranked = screen(problem, fit, self.candidate_effects, lambda what, part: self._rest())[: self.settings.suspects]
        before = float(np.sum(problem.stacked((), calibration.theta) ** 2))
        found: dict[str, Suspect] = {}
        for item in ranked:
            self._rest()
            tried = minimize(
                problem, (item.term,), np.concatenate((calibration.theta, item.begin[0])), rounds=6, tolerance=1e-3
            )
            left = float(np.sum(problem.stacked(tried.terms, tried.values) ** 2)) / max(before, 1e-12)
            suspect = Suspect(item.candidate.name, 1.0 - left, len(item.term.parameters))
            if suspect.name not in found or found[suspect.name].parameters > suspect.parameters:
                found[suspect.name] = suspect
        most = max((s.explained for s in found.values()), default=0.0)
        if most < SMALLEST_SHARE:
            return []
        as_good = [s for s in found.values() if 1.0 - s.explained <= AS_GOOD * (1.0 - most)]
        return sorted(as_good, key=lambda s: (s.parameters, -s.explained))


def warm_up(rig: Rig) -> None:
    """Runs everything once on made-up rows, so that kernels are compiled before the rig is listened to."""
    watcher = Watch(rig, LiveSettings(learn_s=4.0, window_s=2.0, settle_s=0.5))
    period_ns = watcher.frames.period_ns
    watcher.receive(
        "state", RigState(stamp_ns=0, mode="hold", safety_action="none", cause="", poses_rejected=0, forces_rejected=0)
    )
    for frame in range(round(7.0 * SECOND_NS / period_ns)):
        now = frame * period_ns
        shift = 0.002 * math.sin(2e-9 * now)
        where = (0.0, -0.004 - (0.01 if now > 5 * SECOND_NS else 0.0), 0.02 + shift)
        watcher.receive(
            "stage",
            Stage(
                stamp_ns=now,
                command_insertion_m=shift,
                command_roll_rad=0.0,
                command_knob_rad=0.6,
                encoder_insertion_m=shift,
                encoder_roll_rad=shift,
                encoder_knob_rad=0.6 + shift,
            ),
        )
        watcher.receive("force/sensor", ForceSensor(stamp_ns=now, arrival_ns=now, force_N=(0.0, 0.0, 0.05)))
        for topic in ("pose/tip", "pose/shaft"):
            watcher.receive(
                topic,
                Pose(
                    stamp_ns=now,
                    arrival_ns=now,
                    frame=frame,
                    missing=False,
                    position_m=where,
                    quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
                ),
            )
        watcher.look()


class Bus(Protocol):
    """What `watch` needs of a zenoh session: all that came since the last call."""

    def take(self) -> list[tuple[str, Message, bytes]]:
        """Return (topic, message, payload) of the messages since the last call."""
        ...


def watch(
    rig: Rig, bus: Bus, publish: Callable[[Alarm], None], progress: Callable[[str], None], stop: Callable[[], bool]
) -> int:
    """Watches until `stop`; publishes alarms, and logs its phase when it changes. Returns the number of alarms."""
    watcher, said, count = Watch(rig, rest=lambda: time.sleep(REST_S)), "", 0
    while not stop():
        received = bus.take()
        for topic, message, _ in received:
            watcher.receive(topic, message)
        alarm = watcher.look()
        if alarm is not None:
            count += 1
            publish(alarm)
        if watcher.phase != said:
            said = watcher.phase
            progress(said)
        if not received:
            time.sleep(IDLE_S)
    return count
