"""Estimation service: pairs each pose with the actuation at its time, estimates the force, and checks the estimate."""

from __future__ import annotations

import importlib
import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from host.estimation.interface import Actuation, Estimator, PoseReading, Reporting, TipForce
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.rig_file import Rig
from protocol.topics import ForceEstimate, Message, Pose, RigState, Stage

DEFAULT_ESTIMATOR = "host.estimation.rig_estimator:make_estimator"
HISTORY_NS = 500_000_000
PAIRED_WITHIN_NS = 5_000_000
TIP, SHAFT, REAR = "pose/tip", "pose/shaft", "pose/rear"
# Of a rehearsal: the angle by which the catheter is bent, its frames, those before it is pressed, those before it looks odd.
REHEARSED_TURN_rad = 0.8
REHEARSED_FRAMES, REHEARSED_FREE, REHEARSED_PRESSED, REHEARSED_EVERY_NS = 22, 12, 14, 25_000_000


def load_estimator(name: str, rig: Rig) -> Estimator:
    """Return the estimator that `module:function` makes for `rig`. Raises ValueError if there is no such function."""
    module, _, function = name.partition(":")
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"estimator: found {name!r} ({error}), wanted module:function") from None
    return make(rig)


def rehearse(estimator: Estimator, rig: Rig) -> None:
    """Let `estimator` answer made-up poses, so that its code is compiled before real ones come; it is of no use afterwards.

    The poses are those of a free catheter, then of one that is pressed, then poses that no force on the tip explains:
    what looks for a contact of the body runs as well.
    """
    distal_m = load_catheter(rig.catheter.name).distal_length_m
    curvature_per_m = REHEARSED_TURN_rad / distal_m
    service = EstimationService(estimator)
    for frame in range(REHEARSED_FRAMES):
        stamp_ns = (frame + 1) * REHEARSED_EVERY_NS
        pressed, odd = REHEARSED_FREE <= frame < REHEARSED_PRESSED, frame >= REHEARSED_PRESSED
        stage = Stage(
            stamp_ns=stamp_ns,
            command_insertion_m=0.0,
            command_roll_rad=0.0,
            command_knob_rad=0.0,
            joint_insertion_m=0.0,
            joint_roll_rad=0.0,
            joint_curvature_per_m=curvature_per_m,
        )
        mode, direction = ("contact", (0.0, 0.0, 1.0)) if pressed else ("position", None)
        state = RigState(stamp_ns=stamp_ns, mode=mode, safety_action="none", force_direction=direction)
        tip = _on_arc(1.5 * curvature_per_m if odd else curvature_per_m, distal_m, stamp_ns)
        behind = [_on_arc(curvature_per_m, max(distal_m - at_m, 0.0), stamp_ns) for at_m in rig.tracker.tool_offsets_m[1:]]
        shaft, rear = (*behind, None, None)[:2]
        service(tip, shaft, stage, state, rear)


def _on_arc(curvature_per_m: float, station_m: float, stamp_ns: int) -> Pose:
    """Return the pose at `station_m` of an arc that begins at the sheath's exit, bent at roll 0."""
    angle = curvature_per_m * station_m
    return Pose(
        stamp_ns=stamp_ns,
        arrival_ns=stamp_ns,
        frame=0,
        missing=False,
        position_m=(0.0, (math.cos(angle) - 1.0) / curvature_per_m, math.sin(angle) / curvature_per_m),
        quaternion_wxyz=(math.cos(0.5 * angle), math.sin(0.5 * angle), 0.0, 0.0),
    )


def _reading(pose: Pose) -> PoseReading:
    return PoseReading(np.array(pose.position_m, dtype=float), np.array(pose.quaternion_wxyz, dtype=float), pose.stamp_ns)


def _actuation(stage: Stage) -> Actuation | None:
    joints = (stage.joint_insertion_m, stage.joint_roll_rad, stage.joint_curvature_per_m)
    if joints[0] is None or joints[1] is None or joints[2] is None:
        return None
    return Actuation(joints[0], joints[1], joints[2], stage.stamp_ns)


class EstimationService:
    """Answers poses with force messages; no clock and no transport of its own.

    estimator: called once per tip pose. timer_ns: measures only the computing time.
    """

    def __init__(self, estimator: Estimator, timer_ns: Callable[[], int] = time.perf_counter_ns) -> None:
        self._estimator, self._timer_ns = estimator, timer_ns
        self._stages: deque[Stage] = deque()
        self._behind: dict[str, Pose] = {}  # newest pose of the sensors behind the tip's, by topic
        self._force_direction: np.ndarray | None = None
        self._mode = ""
        self._waiting: Pose | None = None
        self.answered = 0
        self.unanswered = 0
        self.last_failure = ""

    def receive(self, topic: str, message: Message) -> None:
        """Take in a message; topics of no concern are ignored. A newer tip pose takes the place of one not answered."""
        if isinstance(message, Stage):
            self._stages.append(message)
            while message.stamp_ns - self._stages[0].stamp_ns > HISTORY_NS or message.stamp_ns < self._stages[0].stamp_ns:
                self._stages.popleft()
        elif isinstance(message, RigState):
            direction = message.force_direction
            self._force_direction = None if direction is None else np.array(direction)
            self._mode = message.mode
        elif isinstance(message, Pose) and topic in (SHAFT, REAR):
            self._behind[topic] = message
        elif isinstance(message, Pose) and topic == TIP and not message.missing:
            self._waiting = message

    def answer(self, now_ns: int) -> ForceEstimate | None:
        """Return the estimate for the newest tip pose; None if no pose has arrived since the last call.

        now_ns: the rig's clock, for `published_ns`.
        """
        tip, self._waiting = self._waiting, None
        if tip is None:
            return None
        actuation = self._actuation_at(tip.stamp_ns)
        if actuation is None:
            self.unanswered += 1
            self.last_failure = "no stage message from the time of the pose"
            return None
        return self._ask(tip, actuation, now_ns)

    def __call__(
        self,
        tip: Message,
        shaft: Message | None,
        stage: Message,
        state: Message | None = None,
        rear: Message | None = None,
    ) -> ForceEstimate | None:
        """Return the estimate for one pose at once, for lock step; the caller sets `published_ns`."""
        for topic, message in (("stage", stage), ("state", state), (SHAFT, shaft), (REAR, rear), (TIP, tip)):
            if message is not None:
                self.receive(topic, message)
        return self.answer(tip.stamp_ns)

    def _actuation_at(self, stamp_ns: int) -> Actuation | None:
        if not self._stages:
            return None
        nearest = min(self._stages, key=lambda stage: abs(stage.stamp_ns - stamp_ns))
        if abs(nearest.stamp_ns - stamp_ns) > HISTORY_NS:
            return None
        actuation = _actuation(nearest)
        if actuation is None:
            return None
        return actuation._replace(force_direction=self._force_direction, mode=self._mode)

    def reports(self) -> list[tuple[str, Message]]:
        """Return (topic, message) of what the estimator reports in addition to the force, new since the last call."""
        return self._estimator.reports() if isinstance(self._estimator, Reporting) else []

    def _of_frame(self, topic: str, tip: Pose) -> PoseReading | None:
        """Return the pose of another sensor that was measured with the tip's; None if there is none."""
        pose = self._behind.get(topic)
        if pose is None or pose.missing or abs(pose.stamp_ns - tip.stamp_ns) > PAIRED_WITHIN_NS:
            return None
        return _reading(pose)

    def _ask(self, tip: Pose, actuation: Actuation, now_ns: int) -> ForceEstimate:
        shaft, rear = (self._of_frame(topic, tip) for topic in (SHAFT, REAR))
        # An estimator of two sensors need not take a third: it is given only on a rig that has one.
        third = {} if rear is None else {"pose_rear": rear}
        begin_ns = self._timer_ns()
        try:
            answer = self._estimator.estimate(_reading(tip), shaft, actuation, **third)
        except (ValueError, ArithmeticError, InputError) as error:
            self.last_failure = f"{type(error).__name__}: {error}"
            answer = None
        compute_us = (self._timer_ns() - begin_ns) * 1e-3
        good = answer is not None and _good(answer) and (answer.nominal is None or _good(answer.nominal))
        self.answered += good
        self.unanswered += not good
        if answer is None or not good:
            return ForceEstimate(
                stamp_ns=tip.stamp_ns,
                frame="base",
                converged=False,
                published_ns=now_ns,
                body_contact=answer is not None and answer.body_contact,
                residual=None if answer is None else answer.residual,
                compute_us=compute_us,
            )
        return ForceEstimate(
            stamp_ns=tip.stamp_ns,
            frame="base",
            converged=True,
            published_ns=now_ns,
            force_N=_numbers(answer.force_N),
            covariance_N2=_numbers(answer.covariance_N2),
            lasting_covariance_N2=_numbers(answer.lasting_covariance_N2),
            nominal_force_N=_numbers(answer.nominal and answer.nominal.force_N),
            nominal_covariance_N2=_numbers(answer.nominal and answer.nominal.covariance_N2),
            body_contact=answer.body_contact,
            residual=answer.residual,
            compute_us=compute_us,
        )


def _numbers(values: np.ndarray | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(map(float, np.ravel(values)))


def _good(answer: TipForce) -> bool:
    return answer.converged and _plausible(answer.force_N, answer.covariance_N2)


def _plausible(force_N: np.ndarray, covariance_N2: np.ndarray) -> bool:
    """Whether shapes are right, values finite, and the covariance symmetric and positive semidefinite."""
    force_N, covariance_N2 = np.asarray(force_N), np.asarray(covariance_N2)
    if force_N.shape != (3,) or covariance_N2.shape != (3, 3):
        return False
    if not (np.isfinite(force_N).all() and np.isfinite(covariance_N2).all()):
        return False
    scale = float(np.abs(covariance_N2).max())
    symmetric = float(np.abs(covariance_N2 - covariance_N2.T).max()) <= 1e-9 * scale
    return symmetric and float(np.linalg.eigvalsh(covariance_N2).min()) >= -1e-9 * scale
