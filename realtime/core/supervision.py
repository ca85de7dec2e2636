"""Cross-checks that are slower than the tick: lost steps, a displaced tracker, a model process that is late or silent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.rig_file import Rig
from protocol.serial_frames import AXES
from protocol.topics import ForceEstimate
from realtime.control import safety
from realtime.control.records import N_AXES
from realtime.core.tracker_check import TrackerCheck

Vector = NDArray[np.float64]

# Encoder and steps: the encoder follows the steps within a status period, and swings by some steps when a stage starts
# or stops. A difference larger than STEPS_SWING and MOVED times the steps since the status before, in two messages in a
# row, is an error: found 10 ms after a rotor began to slip at full speed. 40 steps are 0.13 mm of insertion.
STEPS_SWING, STEPS_MOVED, STEPS_MESSAGES = 40.0, 1.25, 2
# Both lines of an encoder changed between two samples of the board, so often since the status before: a rotor turns faster
# than the board counts (20000 counts/s; its stages reach 16000). Single ones come from electric noise.
IMPOSSIBLE_COUNTS = 10
# A model process at 40 Hz that sends nothing for this long, or estimates for poses older than that, is logged.
HOST_SILENT_NS, HOST_LATE_NS = 250_000_000, 200_000_000


class SupervisionFinding(NamedTuple):
    """Result of a check. `cause` is a bit of `realtime.control.safety`, 0 if the finding is only logged."""

    cause: int
    text: str


class StepCheck:
    """Encoder counts against commanded steps, of all axes, from the moment of arming on."""

    def __init__(self, encoder_counts_per_step: tuple[float, float, float]) -> None:
        self._ratio = np.array(encoder_counts_per_step)
        self._difference_at_rest: Vector | None = None
        self._steps: Vector | None = None
        self._messages = 0
        self._impossible: int | None = None

    def restart(self) -> None:
        """Take the difference at the next status as the reference; for arming."""
        self._difference_at_rest, self._steps, self._messages = None, None, 0
        self._impossible = None

    def check(self, position_steps: Vector, encoder_counts: Vector, impossible: int) -> SupervisionFinding | None:
        """Compare steps (3,) with counts (3,) of one status; return a finding once STEPS_MESSAGES in a row differ.

        impossible: the board's count of impossible transitions of all encoders, modulo 65536.
        """
        unseen = 0 if self._impossible is None else (impossible - self._impossible) % 65536
        self._impossible = impossible
        if unseen > IMPOSSIBLE_COUNTS:
            text = f"a rotor turns faster than the board counts: {unseen} impossible transitions of an encoder"
            return SupervisionFinding(safety.STEPS_LOST, text)
        steps = np.asarray(position_steps, float)
        difference = np.asarray(encoder_counts) / self._ratio - steps
        if self._difference_at_rest is None or self._steps is None:
            self._difference_at_rest, self._steps = difference, steps
            return None
        moved, self._steps = np.abs(steps - self._steps), steps
        lost = np.abs(difference - self._difference_at_rest)
        axis = int(np.argmax(lost - STEPS_MOVED * moved))
        if lost[axis] <= STEPS_SWING + STEPS_MOVED * moved[axis]:
            self._messages = 0
            return None
        self._messages += 1
        if self._messages < STEPS_MESSAGES:
            return None
        return SupervisionFinding(safety.STEPS_LOST, f"{AXES[axis]}: encoder and steps differ by {lost[axis]:.0f} steps")


class HostCheck:
    """Checks whether the model process answers in time. There is no finding before its first answer.

    `causes`, a bit set, holds the failsafe causes that stood at the last `overdue`: none, HOST_SILENT, or HOST_LOST as well.

    Args:
        lost_after_ns: without an answer for so long, contact ends (ns).
    """

    def __init__(self, lost_after_ns: int) -> None:
        self._lost_after_ns = lost_after_ns
        self._answered_ns: int | None = None
        self._complaint = ""
        self.causes = 0

    def answered(self, stamp_ns: int, now_ns: int) -> SupervisionFinding | None:
        """Note an estimate for a pose of `stamp_ns` that arrived at `now_ns` (ns)."""
        self._answered_ns = now_ns
        late = now_ns - stamp_ns > HOST_LATE_NS
        limit_ms = HOST_LATE_NS * 1e-6
        return self._new(0, f"estimates are more than {limit_ms:.0f} ms old: the model process is slow" if late else "")

    def overdue(self, now_ns: int) -> SupervisionFinding | None:
        """Return a finding, once, if the last estimate is too old."""
        late_ns = 0 if self._answered_ns is None else now_ns - self._answered_ns
        self.causes = safety.HOST_SILENT if late_ns > HOST_SILENT_NS else 0
        if not self.causes:
            return None
        if late_ns > self._lost_after_ns:
            self.causes |= safety.HOST_LOST
        return self._new(self.causes, f"no estimate for {HOST_SILENT_NS * 1e-6:.0f} ms: the model process does not answer")

    def _new(self, causes: int, complaint: str) -> SupervisionFinding | None:
        before, self._complaint = self._complaint, complaint
        return SupervisionFinding(causes, complaint) if complaint and complaint != before else None


class Supervision:
    """All checks together. `causes` is the bit set of failsafe causes that stand.

    Lost steps and a displaced tracker stay until `restart`; causes of the model process stand while it does not answer, a
    contact of the body while it reports one.
    """

    def __init__(self, rig: Rig) -> None:
        ratios = [rig.stage(axis).encoder_counts_per_step for axis in range(3)]
        self.steps = StepCheck((ratios[0], ratios[1], ratios[2]))
        self.host = HostCheck(round(rig.safety.host_lost_after_s * 1e9))
        tracker, backlash_m = rig.tracker, rig.transmission.insertion_backlash_m
        self.tracker = TrackerCheck(tracker.position_noise_m, tracker.orientation_noise_rad, backlash_m)
        stage = rig.stages.insertion
        self._m_per_step = rig.transmission.insertion_slope / stage.steps_per_unit
        self._m_per_count = self._m_per_step / stage.encoder_counts_per_step
        self._lasting = self._body_causes = 0

    @property
    def causes(self) -> int:
        """Return the bit set of active failsafe causes."""
        # The last message of a model process that does not answer is no longer valid.
        return self._lasting | (self.host.causes or self._body_causes)

    def restart(self) -> None:
        """Delete all findings; for arming and clearing, when the operator has seen them."""
        self.steps.restart()
        self.tracker.restart()
        self._lasting = 0

    def status(
        self, position_steps: Vector, encoder_counts: Vector, now_ns: int, impossible: int = 0
    ) -> SupervisionFinding | None:
        """Check a board's status that arrived at `now_ns` while armed; steps and counts (3,). Return a new finding.

        impossible: as in `StepCheck.check`.
        """
        by_steps_m, by_encoder_m = position_steps[0] * self._m_per_step, encoder_counts[0] * self._m_per_count
        self.tracker.take_stage(now_ns, float(by_steps_m), float(by_encoder_m))
        if self._lasting & safety.STEPS_LOST:
            return None
        finding = self.steps.check(position_steps[:N_AXES], encoder_counts[:N_AXES], impossible)
        if finding is not None:
            self._lasting |= finding.cause
        return finding

    def pose(self, is_tip: bool, pose: np.record) -> SupervisionFinding | None:
        """Check a POSE record that was filled while armed, the shaft's of a frame before the tip's. Return a new finding."""
        displaced_m = self.tracker.take_pose(is_tip, int(pose.stamp_ns), pose.position_m, pose.quaternion_wxyz)
        if not displaced_m or self._lasting & safety.TRACKER_MOVED:
            return None
        self._lasting |= safety.TRACKER_MOVED
        text = f"tip and shaft are at least {displaced_m * 1e3:.1f} mm from where the stages moved them"
        return SupervisionFinding(safety.TRACKER_MOVED, text)

    def host_answered(self, estimate: ForceEstimate, now_ns: int) -> SupervisionFinding | None:
        """Note an estimate that arrived at `now_ns`. Return a new finding."""
        self._body_causes = safety.BODY_CONTACT if estimate.body_contact else 0
        return self.host.answered(estimate.stamp_ns, now_ns)

    def host_overdue(self, now_ns: int) -> SupervisionFinding | None:
        """Check at every step that estimates keep coming. Return a new finding."""
        return self.host.overdue(now_ns)
