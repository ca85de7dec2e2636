"""Contact away from the tip while the rig runs: whether a force on the tip explains the poses, else where the body touches.

A quarter of a second of frames is averaged: the tracker's noise falls, and the mean of the poses is the pose at the mean
force to first order (FLOOR_m and FLOOR_rad are for what is not). The best force on the tip, with what is known of the
actuation, leaves a chi square. When that exceeds its limit in three windows in a row, the body touches, and a force on it is
looked for, alone and then with one on the tip (`several_contacts`). That takes a second of computing, so it is done in
parts, one at each frame.

With two sensors a contact of the body looks like a force on the tip and a shaft of another curvature. It is found as far as
the unloaded curvature is known, from free moments (`adaptation`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.adapted_rig import AdaptedRigEstimator
from host.estimation.interface import Actuation, Estimator, PoseReading, Reporting, TipForce
from host.estimation.lasting_errors import ALL_JOINTS, INSERTION, NOWHERE, ROLL, ActuationKnowledge, Prior
from host.estimation.sensor_noise import PoseSensor, chi_square_limit
from host.estimation.several_contacts import ActuationPrior, ContactsEstimate, search_contacts
from host.estimation.spatial_rig_kernels import TrackedFrame, fit, known_rows, new_fit
from host.mechanics.rod import rod_record
from protocol.catheter import Catheter
from protocol.enums import Phase
from protocol.errors import InputError
from protocol.rig_file import Rig
from protocol.topics import BodyContact, Message

Array = NDArray[np.float64]

# Frames that are averaged: a quarter of a second at the tracker's 40 Hz. Shorter than what a free pose waits for before the
# adaptation uses it (0.4 s), so that the curvature which a contact of the body pretends is never learned as free.
FRAMES = 10
EVERY = 5  # a window begins every so many frames
WINDOWS = 3  # in a row that no force on the tip explains, before the body is said to touch
# Two in a row are enough where the chi square is twice its limit: a third comes too late where the failsafe retracts because
# force sensor and estimate disagree, 0.44 s after a contact of 80 mN or more.
STRONG, STRONG_WINDOWS = 2.0, 2
CLEAR_WINDOWS = 4  # in a row that one explains, before it is said to be free again
# Of the mean pose: the models' own error, and what a mean of bent shapes differs from a bent mean.
FLOOR_m, FLOOR_rad = 0.03e-3, 0.0006
ODD_DEVIATIONS = 4.0
# A window in which the joints moved further is not one static shape.
STEADY_m, STEADY_per_m, STEADY_rad = 0.008, 6.0, 0.1
FORCE_SD_N, LARGEST_FORCE_N = 1.0, 1.0
# A contact of the body with the tip is preferred to one of the body alone where it explains so much more (chi square).
SIMPLER_BY = 15.0
WATCHED = frozenset(phase.label for phase in (Phase.HOLD, Phase.POSITION, Phase.APPROACH, Phase.CONTACT, Phase.JOG))
REPORTS_KEPT = 64

# Curvature (1/m) that the actuation gives without load, and its standard deviation, from what the curve of the knob gives.
FreeCurvature = Callable[[float], tuple[float, float]]


class _Frame(NamedTuple):
    poses: Array  # (k, 7)
    offsets: tuple[float, ...]
    joint: Array  # (3,) insertion (m), curvature (1/m), roll (rad)


class _Window(NamedTuple):
    """A mean frame, with what is known of the actuation there."""

    frame: _Frame
    prior: ActuationPrior
    excess: float  # chi square of the best force on the tip over its limit


class ContactWatch:
    """Takes each frame; `touched` says whether the body touches, `take` returns a report now and then."""

    def __init__(
        self,
        catheter: Catheter,
        position_std_m: float,
        angle_std_rad: float,
        knowledge: ActuationKnowledge,
        free_curvature: FreeCurvature,
    ) -> None:
        """Raises: InputError where the rod's stiffness is not known."""
        rod_record(catheter, 0.0, 0.0)
        self._catheter = catheter
        self._knowledge, self._free_curvature = knowledge, free_curvature
        self._position_std_m = float(np.hypot(position_std_m / np.sqrt(FRAMES), FLOOR_m))
        self._angle_std_rad = float(np.hypot(angle_std_rad / np.sqrt(FRAMES), FLOOR_rad))
        self._frames: deque[_Frame] = deque(maxlen=FRAMES)
        self._since_window = self._odd = self._clear = 0
        self._examination: Iterator[None] | None = None
        self._window: _Window | None = None  # that is examined
        self._found: ContactsEstimate | None = None  # the best explanation of it so far
        self.touched = False

    @property
    def suspects(self) -> bool:
        """Whether the newest window, or what was found before, says that the body may touch."""
        return self._odd > 0 or self.touched

    def take(self, sensors: list[tuple[float, PoseReading]], actuation: Actuation) -> BodyContact | None:
        """Take in the poses of one frame, each with its sensor's offset, from the tip backwards; return a report when due.

        Raises: InputError where the actuation is out of range.
        """
        if self._examination is not None and (report := self._go_on(sensors[0][1].stamp_ns)) is not None:
            return report
        if actuation.mode not in WATCHED:
            self._frames.clear()
            self._odd = 0
            return None
        joint = np.array([actuation.insertion_m, actuation.curvature_per_m, actuation.roll_rad])
        offsets = tuple(offset for offset, _ in sensors)
        poses = np.array([[*pose.position_m, *pose.quaternion_wxyz] for _, pose in sensors])
        if not np.isfinite(poses).all() or (self._frames and self._frames[-1].offsets != offsets):
            self._frames.clear()
            return None
        self._frames.append(_Frame(poses, offsets, joint))
        self._since_window += 1
        if len(self._frames) < FRAMES or self._since_window < EVERY or self._examination is not None:
            return None
        self._since_window = 0
        return self._judge(sensors[0][1].stamp_ns)

    def _judge(self, stamp_ns: int) -> BodyContact | None:
        joints = np.array([frame.joint for frame in self._frames])
        if np.any(np.ptp(joints, axis=0) > (STEADY_m, STEADY_per_m, STEADY_rad)):
            return None
        window = self._tip_alone(_mean(list(self._frames)))
        if window is None:
            return None
        if window.excess <= 1.0:
            self._odd, self._clear = 0, self._clear + 1
            if self._clear >= CLEAR_WINDOWS:
                self.touched = False
            if self.touched:
                return None
            return BodyContact(
                stamp_ns=stamp_ns, place="tip", sensors=len(window.frame.offsets), excess=min(window.excess, 1e12)
            )
        self._odd, self._clear = self._odd + 1, 0
        if self._odd >= (STRONG_WINDOWS if window.excess > STRONG else WINDOWS):
            self.touched = True  # warned of at once; the place follows
            self._window, self._examination = window, self._examine(window)
        return None

    def _tip_alone(self, mean: _Frame) -> _Window | None:
        """Return how well one force on the tip explains the mean frame; None if the fit does not converge."""
        insertion, curvature, roll = (float(value) for value in mean.joint)
        free, curvature_sd = self._free_curvature(curvature)
        start = self._knowledge.start
        prior = ActuationPrior(
            np.array([0.0, free - curvature, 0.0]), np.diag(np.square([start[INSERTION], curvature_sd, start[ROLL]]))
        )
        k = len(mean.offsets)
        frame = TrackedFrame(
            rod_record(self._catheter, insertion, curvature)[:6].copy(),
            self._catheter.distal_length_m,
            np.array([insertion, curvature, roll]),
            np.array(mean.offsets),
            mean.poses,
            self._position_std_m,
            self._angle_std_rad,
            *known_rows(Prior(NOWHERE, ALL_JOINTS, prior.mean, prior.covariance), FORCE_SD_N),
        )
        found = new_fit(k)
        found.x[3:] = prior.mean
        settled, cost = fit(frame, LARGEST_FORCE_N, found)
        excess = cost / chi_square_limit(6 * k - 3, ODD_DEVIATIONS)
        # A fit that did not settle, and explains nothing, is no better than one that did.
        return _Window(mean, prior, excess) if np.isfinite(excess) and (settled or excess > 1.0) else None

    def _examine(self, window: _Window) -> Iterator[None]:
        """Set `_found` to the better of a contact of the body alone and one with the tip; one part a step."""
        insertion, curvature, roll = (float(value) for value in window.frame.joint)
        noise = np.eye(3) * self._position_std_m**2, np.eye(3) * self._angle_std_rad**2
        sensors = [
            PoseSensor(offset, pose[:3], pose[3:], *noise)
            for offset, pose in zip(window.frame.offsets, window.frame.poses, strict=True)
        ]
        self._found = None
        for touching_tip in (False, True):
            try:
                found = yield from search_contacts(
                    self._catheter,
                    insertion,
                    curvature,
                    sensors,
                    roll_rad=roll,
                    actuation=window.prior,
                    touching_tip=touching_tip,
                )
            except (InputError, ArithmeticError):
                continue
            if self._found is None or found.chi_square < self._found.chi_square - SIMPLER_BY:
                self._found = found
            if self._found.converged:
                return  # nothing more is needed to explain the poses

    def _go_on(self, stamp_ns: int) -> BodyContact | None:
        """Run one more part of the examination; return the report when it is finished."""
        assert self._examination is not None and self._window is not None
        window = self._window
        try:
            next(self._examination)
        except StopIteration:
            found = self._found
        else:
            return None
        self._examination = None
        sensors = len(window.frame.offsets)
        if found is None or not found.converged:
            text = (
                "neither a force on the tip nor one on the body explains the poses: check curvature, insertion, registration"
            )
            return BodyContact(stamp_ns=stamp_ns, place="not observable", sensors=sensors, excess=window.excess, text=text)
        return _report(stamp_ns, window, found)


def _report(stamp_ns: int, window: _Window, found: ContactsEstimate) -> BodyContact:
    """Return the message of a contact that explains the poses."""
    with_tip = bool(found.tip_force_N.any())
    if found.observable:
        place = "tip and body" if with_tip else "body"
        text = f"the body is touched {1e3 * found.body_offset_m:.0f} mm behind the tip"
    else:
        place, text = "not observable", "; ".join(found.warnings)

    def numbers(values: Array) -> tuple[float, ...]:
        return tuple(map(float, np.ravel(values)))

    return BodyContact(
        stamp_ns=stamp_ns,
        place=place,
        sensors=len(window.frame.offsets),
        excess=window.excess,
        body_offset_m=found.body_offset_m,
        body_offset_sd_m=min(found.body_offset_sd_m, 1.0),
        body_force_N=numbers(-found.body_force_N),
        body_covariance_N2=numbers(found.body_covariance_N2),
        tip_force_N=numbers(-found.tip_force_N) if with_tip else None,
        tip_covariance_N2=numbers(found.tip_covariance_N2) if with_tip else None,
        text=text,
    )


def _mean(frames: list[_Frame]) -> _Frame:
    """The frame in the middle of some: positions and joints averaged, quaternions of one sign averaged and normed."""
    poses = np.array([frame.poses for frame in frames])
    turned = poses[:, :, 3:]
    poses[:, :, 3:] = turned * np.where(np.sum(turned * turned[:1], axis=2, keepdims=True) < 0.0, -1.0, 1.0)
    mean = poses.mean(axis=0)
    mean[:, 3:] /= np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    return _Frame(mean, frames[0].offsets, np.mean([frame.joint for frame in frames], axis=0))


class WatchedEstimator:
    """Implements `Estimator` and `Reporting`: another estimator, with its poses watched for a contact of the body."""

    def __init__(
        self,
        estimator: Estimator,
        watch: ContactWatch,
        offsets_m: tuple[float, ...],
        adapted: AdaptedRigEstimator | None = None,
    ) -> None:
        """`offsets_m`: of the sensors, from the tip; `adapted`: holds its stiffness while the watch suspects a contact."""
        self._estimator, self._watch, self._offsets_m, self._adapted = estimator, watch, offsets_m, adapted
        self._reports: deque[tuple[str, Message]] = deque(maxlen=REPORTS_KEPT)

    def estimate(
        self,
        pose_tip: PoseReading,
        pose_shaft: PoseReading | None,
        actuation: Actuation,
        pose_rear: PoseReading | None = None,
    ) -> TipForce:
        """The force by the estimator, marked while the body touches. Raises: InputError (bad input)."""
        if self._adapted is not None:
            self._adapted.held = "the catheter's body may touch something" if self._watch.suspects else ""
        answer = self._estimator.estimate(pose_tip, pose_shaft, actuation, pose_rear)
        poses = zip(self._offsets_m, (pose_tip, pose_shaft, pose_rear), strict=False)
        seen = [(offset_m, pose) for offset_m, pose in poses if pose is not None]
        if len(seen) > 1:
            report = self._watch.take(seen, actuation)
            if report is not None:
                self._reports.append(("contact", report))
        return answer._replace(body_contact=self._watch.touched)

    def reports(self) -> list[tuple[str, Message]]:
        """Return (topic, message) of what is new since the last call, and forget it."""
        reports = [*self._reports, *(self._estimator.reports() if isinstance(self._estimator, Reporting) else [])]
        self._reports.clear()
        return reports


def curvature_as_configured(rig: Rig) -> FreeCurvature:
    """Return the curvature of the knob curve without learning."""
    return lambda curvature_per_m: (curvature_per_m, rig.estimation.curvature_sd_per_m)
