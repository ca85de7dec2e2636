"""Watch a running rig: compare it with its twin, and raise an alarm with subsystem and probable cause."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import Fit, Problem, finish, minimize
from host.diagnosis.estimation.noise import Noise, NoiseSource
from host.diagnosis.live.charts import Charts, ChartSettings, Usual
from host.diagnosis.live.local_field import LOCAL_FIELD
from host.diagnosis.live.twin import FrameCollector, Twin, TwinFit
from host.diagnosis.model.effect import Candidate
from host.diagnosis.model.model import Segment
from host.diagnosis.models.rig import FORCE_ROWS, POSE_ROWS, POSES
from host.diagnosis.selection.screening import screen
from protocol.rig_file import Rig
from protocol.topics import Alarm, ForceSensor, Message, Pose, RigState, Stage

Array = npt.NDArray[np.float64]
SMALLEST_SHARE = 0.1  # of the mismatch that a cause has to explain to be named
LEAST_PROBABILITY = 0.05  # of a cause that is listed as possible
CALM, CALM_S = 0.5, 10.0  # a mismatch is over once the score has been below CALM for CALM_S: the next one is reported again
IDLE_S = 0.02
REST_S = 0.005
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class LiveSettings:
    """learn_s of motion calibrate the twin; then every every_s (s) the new rows are added to the charts (`charts.py`).

    cause_s: the rows since a change began are collected for this time (s) before its cause is sought in them.
    lead_rows: rows before the new ones that are simulated too, because delay and filters reach back.
    suspects: candidates fitted before one is named. inflation: of the errors' variance, because no cause describes a rig
    exactly (see `probabilities`).
    """

    learn_s: float = 10.0
    every_s: float = 0.25
    cause_s: float = 2.0
    lead_rows: int = 6
    suspects: int = 8
    inflation: float = 20.0
    charts: ChartSettings = field(default_factory=ChartSettings)


@dataclass(frozen=True)
class Suspect:
    """A cause that was fitted to the rows since the change.

    name: effect@subsystem. error: weighted sum of squares that it leaves. explained: share of the mismatch that it explains.
    """

    name: str
    error: float
    explained: float
    parameters: int
    probability: float = 0.0  # among the causes that were fitted


def probabilities(suspects: list[Suspect], samples: int, inflation: float) -> list[Suspect]:
    """Return `suspects` with their probabilities, the likeliest first.

    A cause weighs exp(-(error - least error) / (2 phi inflation)) samples^(-parameters/2): the Bayesian information
    criterion (Schwarz 1978) of a quasi-likelihood (McCullagh and Nelder 1989, ch. 9). phi, the mean square that the best
    cause leaves, is at least the usual one. `samples`: squares in the errors.
    """
    least = min((s.error for s in suspects), default=0.0)
    phi = max(1.0, least / samples)
    cost = [0.5 * (s.error - least) / phi / inflation + 0.5 * s.parameters * math.log(samples / inflation) for s in suspects]
    weight = np.exp(np.min(cost, initial=np.inf) - np.array(cost))
    judged = [replace(s, probability=float(w / np.sum(weight))) for s, w in zip(suspects, weight, strict=True)]
    return sorted(judged, key=lambda s: -s.probability)


def _causes(twin: Twin) -> list[Candidate]:
    """The vocabulary at every port but the wall; a distorted field in the form that seconds of motion can show."""
    # A bias that began with the alarm is constant all through it: its instant is not one more unknown.
    listed = candidates(twin.ports, True, twin.taken | {LOCAL_FIELD.id, "sensor_bias:jump"})
    local = [Candidate(LOCAL_FIELD, port) for port in twin.ports if LOCAL_FIELD.port in port.kind.split("+")]
    return [c for c in (*listed, *local) if c.port.name != "contact"]


def is_armed(state: RigState) -> bool:
    """Return whether the rig follows commands in this state."""
    return state.mode not in ("disarmed", "homing", "stopped")


class Watch:
    """Receives the rig's messages; `look` gives an alarm when the residual is no longer what was usual.

    All time is the rig's own (stamps of its poses), so that recorded messages and virtual time do as well as a live rig.
    """

    def __init__(self, rig: Rig, settings: LiveSettings | None = None, rest: Callable[[], None] = lambda: None) -> None:
        """`rest` is called between the steps of long computations: a rig on the same machine must not be starved."""
        self.settings, self._rest = settings or LiveSettings(), rest
        self.twin = Twin(rig)
        self.frames = FrameCollector(rig, max(self.settings.learn_s, 30.0))
        self.candidate_effects = _causes(self.twin)
        self.calibration: TwinFit | None = None
        self.charts: Charts | None = None
        self._armed_at_ns: int | None = None
        self._next_ns = 0
        self._taken_ns = 0  # stamp of the newest row that the charts have taken
        self._since_ns: int | None = None  # begin of the mismatch that is being reported
        self._calm_ns = 0  # time from which on the score is small
        self.reported = False
        self.score = 0.0

    def receive(self, topic: str, message: Message) -> None:
        """Take in one message of the rig."""
        if isinstance(message, RigState):
            if is_armed(message):
                self.arm(message.stamp_ns)
            else:
                self._armed_at_ns = None
        self.frames.receive(topic, message)

    def arm(self, stamp_ns: int) -> None:
        """Note that the rig is armed, the first time at `stamp_ns`."""
        if self._armed_at_ns is None:
            self._armed_at_ns = stamp_ns

    @property
    def phase(self) -> str:
        """What is being done: waiting, learning or watching."""
        return "watching" if self.charts else "learning" if self._armed_at_ns is not None else "waiting"

    def look(self) -> Alarm | None:
        """Call often; every `every_s` of the rig's time something is done. An alarm comes once for each mismatch."""
        self.frames.settle()
        stamps = self.frames.stamps_ns
        if not stamps or stamps[-1] < self._next_ns or self._armed_at_ns is None:
            return None
        self._next_ns = stamps[-1] + round(self.settings.every_s * SECOND_NS)
        if self.charts is None:
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
        usual = Usual.of(residual[:, segment.n // 4 :])  # the approach differs from what follows
        self.charts = Charts(usual, self.frames.period_ns * 1e-9, self.settings.charts)
        self._taken_ns = self.frames.stamps_ns[-1]

    def _residual(self, first: int) -> tuple[Segment, Array]:
        """Rows from `first` on as a segment of the twin, and measured minus expected (12, n)."""
        assert self.calibration is not None
        segment = self.twin.prepare(self.calibration.applied(self.frames.recording(first)))
        self.twin.correct(segment, self.calibration.theta)
        segment.y[FORCE_ROWS] = np.nan
        expected = self.twin.simulate(segment, self.calibration.theta, [])
        return segment, (segment.y - expected)[POSE_ROWS]

    def _compare(self) -> Alarm | None:
        """New rows are added to the charts. A change is reported once, as soon as its cause can be sought."""
        charts, period_ns, now_ns = self.charts, self.frames.period_ns, self.frames.stamps_ns[-1]
        assert charts is not None
        new = min(round((now_ns - self._taken_ns) / period_ns), len(self.frames.rows))
        self._taken_ns = now_ns
        lead = min(new + self.settings.lead_rows, len(self.frames.rows))
        charts.take(self._residual(-lead)[1][:, -new:])
        self.score = float(np.max(charts.score))
        if self.score > CALM:
            self._calm_ns = now_ns
        if self._since_ns is None:
            if self.score <= 1.0:
                return None
            self._since_ns = now_ns - (charts.samples - charts.since) * period_ns
        elif self.reported and now_ns - self._calm_ns > CALM_S * SECOND_NS:
            self._since_ns, self.reported = None, False
            return None
        if self.reported or now_ns - self._since_ns < self.settings.cause_s * SECOND_NS:
            return None
        self.reported = True
        return self._alarm(charts, self._since_ns)

    def _alarm(self, charts: Charts, since_ns: int) -> Alarm:
        now_ns, row = self.frames.stamps_ns[-1], int(np.argmax(charts.score))
        since_s = (now_ns - since_ns) * 1e-9
        channel = self.twin.outputs[row].channel
        suspects = self._suspects(self._residual(-self._rows(since_s))[0])
        first = suspects[0] if suspects else Suspect(f"unlisted@{self.twin.outputs[row].subsystem}", 0.0, 0.0, 0)
        effect, _, subsystem = first.name.partition("@")
        return Alarm(
            stamp_ns=now_ns,
            subsystem=subsystem,
            effect=effect,
            channel=channel,
            score=float(charts.score[row]),
            explained=float(np.clip(first.explained, 0.0, 1.0)),
            probability=float(np.clip(first.probability, 0.0, 1.0)),
            since_ns=since_ns,
            words=words(suspects, channel, since_ns * 1e-9),
        )

    def _suspects(self, segment: Segment) -> list[Suspect]:
        """Causes that were fitted to the rows since the change, the likeliest first; none if no cause explains enough."""
        charts, calibration = self.charts, self.calibration
        assert charts is not None and calibration is not None
        segment.y[POSE_ROWS] -= charts.usual.mean[:, None]
        scale = np.concatenate([charts.usual.rms, np.ones(len(self.twin.outputs) - POSES)])
        segment.weight = scale
        problem = Problem(self.twin, [segment], [Noise(float(s), np.zeros(0), NoiseSource.LEARNED) for s in scale], scale)
        fit = finish(problem, Fit((), calibration.theta))
        ranked = screen(problem, fit, self.candidate_effects, lambda what, part: self._rest())[: self.settings.suspects]
        squares = problem.stacked((), calibration.theta) ** 2
        samples, before = int(np.count_nonzero(squares)), float(np.sum(squares))
        mismatch = max(before - samples, 1e-9)  # beyond the usual residual
        found: dict[str, Suspect] = {}
        for item in ranked:
            self._rest()
            begin = np.concatenate((calibration.theta, item.begin[0]))
            tried = minimize(problem, (item.term,), begin, rounds=6, tolerance=1e-3)
            error = float(np.sum(problem.stacked(tried.terms, tried.values) ** 2))
            suspect = Suspect(item.candidate.name, error, (before - error) / mismatch, len(item.term.parameters))
            if suspect.name not in found or found[suspect.name].parameters > suspect.parameters:
                found[suspect.name] = suspect
        if max((s.explained for s in found.values()), default=0.0) < SMALLEST_SHARE:
            return []
        return probabilities(list(found.values()), samples, self.settings.inflation)


def words(suspects: list[Suspect], channel: str, since_s: float) -> str:
    """Return the alarm in words: since when, where, the probable cause, its probability, and what is also possible.

    suspects: the likeliest first; none if no known cause explains the mismatch. since_s: on the rig's clock (s).
    """
    began = f"since {since_s:.1f} s, {channel} differs from the twin"
    if not suspects:
        return f"{began}; no known effect explains it"
    first = suspects[0]
    effect, _, subsystem = first.name.partition("@")
    text = (
        f"{subsystem}: probably {_plain(effect)} (probability {first.probability:.2f}, "
        f"explains {min(first.explained, 1.0):.0%} of the mismatch); {began}"
    )
    others = [s for s in suspects[1:] if s.probability >= LEAST_PROBABILITY]
    return text + "".join(
        f"{', ' if k else '; also possible: '}{_plain(s.name)} ({s.probability:.2f})" for k, s in enumerate(others)
    )


def _plain(name: str) -> str:
    effect, at, subsystem = name.partition("@")
    return effect.replace("_", " ") + at + subsystem


def warm_up(rig: Rig) -> None:
    """Runs everything once on made-up rows, so that kernels are compiled before the rig is listened to."""
    watcher = Watch(rig, LiveSettings(learn_s=4.0, cause_s=0.5))
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
