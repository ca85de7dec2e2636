"""Cross-checks that are slower than the tick: lost steps, force readings that disagree, a model process that is late."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.serial_frames import AXES
from realtime.control import safety
from realtime.control.records import N_AXES

Vector = NDArray[np.float64]

# Encoder and steps: the encoder follows within a status period at full speed (80 steps); a larger difference that lasts
# this long is an error. 150 steps are 0.5 mm of insertion, 4 degrees of handle.
STEPS_DIFFERENCE, STEPS_DIFFERENCE_NS = 150, 20_000_000
# Sensor and model: the planar model is 0.07 N off in contact and 0.2 N noisy at 40 Hz; averaged over a second
# 0.25 N is beyond both.
FORCE_DIFFERENCE_N, FORCE_AVERAGE_S = 0.25, 1.0
# The period of estimates; the first difference after a restart is weighted by it.
_ESTIMATE_PERIOD_S = 0.025
# A model process at 40 Hz that sends nothing for this long, or estimates for poses older than that, is logged.
HOST_SILENT_NS, HOST_LATE_NS = 250_000_000, 200_000_000


class SupervisionFinding(NamedTuple):
    """What a check found. `cause` is a bit of `realtime.control.safety`, 0 where the finding is only logged."""

    cause: int
    text: str


class StepCheck:
    """Encoder counts against commanded steps, of all axes, from the moment of arming on."""

    def __init__(self, encoder_counts_per_step: tuple[float, float, float]) -> None:
        self._ratio = np.array(encoder_counts_per_step)
        self._difference_at_rest: Vector | None = None
        self._since_ns: int | None = None

    def restart(self) -> None:
        """Take the difference at the next status as right; for arming."""
        self._difference_at_rest, self._since_ns = None, None

    def check(self, position_steps: Vector, encoder_counts: Vector, now_ns: int) -> SupervisionFinding | None:
        """Compare steps (3,) with counts (3,); return a finding once they have differed for STEPS_DIFFERENCE_NS."""
        difference = np.asarray(encoder_counts) / self._ratio - np.asarray(position_steps)
        if self._difference_at_rest is None:
            self._difference_at_rest = difference
        lost = np.abs(difference - self._difference_at_rest)
        axis = int(np.argmax(lost))
        if lost[axis] <= STEPS_DIFFERENCE:
            self._since_ns = None
            return None
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < STEPS_DIFFERENCE_NS:
            return None
        return SupervisionFinding(safety.STEPS_LOST, f"{AXES[axis]}: encoder and steps differ by {lost[axis]:.0f} steps")


class ForceCheck:
    """Two sources of one force: their difference, averaged, stays within the larger error of both.

    Args:
        first, second: names of the sources, as `Supervision.forces` gets them.
        cause: bit of `realtime.control.safety` when they disagree.
        difference_limit_N: allowed length of the averaged difference (N).
        average_s: time constant of the average (s).
    """

    def __init__(self, first: str, second: str, cause: int, difference_limit_N: float, average_s: float) -> None:
        self.first, self.second, self.cause = first, second, cause
        self._limit_N, self._average_s = difference_limit_N, average_s
        self._difference_N = np.zeros(3)
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Forget the average; for arming."""
        self._difference_N[:] = 0.0
        self._last_ns = None

    def check(self, first_N: Vector, second_N: Vector, now_ns: int) -> SupervisionFinding | None:
        """Take in a pair of readings (3,) N in the base frame. A pair with a NaN is left out."""
        difference_N = np.asarray(first_N, float) - np.asarray(second_N, float)
        if not np.all(np.isfinite(difference_N)):
            return None
        dt_s = _ESTIMATE_PERIOD_S if self._last_ns is None else max((now_ns - self._last_ns) * 1e-9, 0.0)
        self._last_ns = now_ns
        self._difference_N += (1.0 - math.exp(-dt_s / self._average_s)) * (difference_N - self._difference_N)
        if not np.linalg.norm(self._difference_N) > self._limit_N:
            return None
        return SupervisionFinding(self.cause, f"{self.first} and {self.second} differ by more than {self._limit_N} N")


class HostCheck:
    """Whether the model process answers, and in time. Its findings have no cause: they are only logged, once each."""

    def __init__(self) -> None:
        self._answered_ns: int | None = None
        self._complaint = ""

    def answered(self, stamp_ns: int, now_ns: int) -> SupervisionFinding | None:
        """Take in an estimate for a pose of `stamp_ns` that arrived at `now_ns` (ns)."""
        self._answered_ns = now_ns
        late = now_ns - stamp_ns > HOST_LATE_NS
        limit_ms = HOST_LATE_NS * 1e-6
        return self._new(f"estimates are more than {limit_ms:.0f} ms old: the model process is slow" if late else "")

    def overdue(self, now_ns: int) -> SupervisionFinding | None:
        """Return a finding when the last estimate is too long ago; nothing before the first estimate."""
        if self._answered_ns is None or now_ns - self._answered_ns <= HOST_SILENT_NS:
            return None
        return self._new(f"no estimate for {HOST_SILENT_NS * 1e-6:.0f} ms: the model process does not answer")

    def _new(self, complaint: str) -> SupervisionFinding | None:
        before, self._complaint = self._complaint, complaint
        return SupervisionFinding(0, complaint) if complaint and complaint != before else None


class Supervision:
    """All checks together. `causes` is the bit set of failsafe causes that stand; they stay until `restart`."""

    def __init__(self, encoder_counts_per_step: tuple[float, float, float]) -> None:
        self.steps, self.host = StepCheck(encoder_counts_per_step), HostCheck()
        self.force_checks = (
            ForceCheck("force sensor", "model", safety.FORCE_DISAGREES, FORCE_DIFFERENCE_N, FORCE_AVERAGE_S),
        )
        self.causes = 0

    def restart(self) -> None:
        """Forget all findings; for arming and clearing, when the operator has seen what was wrong."""
        self.steps.restart()
        for check in self.force_checks:
            check.restart()
        self.causes = 0

    def status(self, position_steps: Vector, encoder_counts: Vector, now_ns: int) -> SupervisionFinding | None:
        """Check a board's status while armed; steps and counts (3,). Return a new finding."""
        if self.causes & safety.STEPS_LOST:
            return None
        return self._kept(self.steps.check(position_steps[:N_AXES], encoder_counts[:N_AXES], now_ns))

    def forces(self, forces_N: Mapping[str, Vector], now_ns: int) -> SupervisionFinding | None:
        """Compare the sources in contact: name -> force (3,) N on the tissue, base frame. Return a new finding."""
        found = None
        for check in self.force_checks:
            if not self.causes & check.cause and check.first in forces_N and check.second in forces_N:
                found = self._kept(check.check(forces_N[check.first], forces_N[check.second], now_ns)) or found
        return found

    def host_answered(self, stamp_ns: int, now_ns: int) -> SupervisionFinding | None:
        """Take in that an estimate for a pose of `stamp_ns` arrived. Return a new finding."""
        return self._kept(self.host.answered(stamp_ns, now_ns))

    def host_overdue(self, now_ns: int) -> SupervisionFinding | None:
        """Check at every step that estimates keep coming. Return a new finding."""
        return self._kept(self.host.overdue(now_ns))

    def _kept(self, finding: SupervisionFinding | None) -> SupervisionFinding | None:
        if finding is not None:
            self.causes |= finding.cause
        return finding
