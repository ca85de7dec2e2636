"""Slow cross-checks beside the tick: lost steps or encoder, force sensor against model, model process alive."""

from __future__ import annotations

import math

import numpy as np

from realtime.control import safety
from realtime.control.records import N_AXES

# Encoder and steps: the encoder follows within a status period at full speed (80 steps); more than that for this long is
# no lag. 150 steps are 0.5 mm of insertion, 4 degrees of handle.
STEPS_APART, STEPS_APART_NS = 150, 20_000_000
# Sensor and model: the planar model is 0.07 N off in contact and 0.2 N noisy at 40 Hz; averaged over a second
# 0.25 N is beyond both.
FORCE_APART_N, FORCE_AVERAGE_S = 0.25, 1.0
# A model process at 40 Hz that says nothing for this long, or speaks of poses older than that, is told.
HOST_SILENT_NS, HOST_LATE_NS = 250_000_000, 200_000_000


class StepCheck:
    """Encoder counts against commanded steps, of all axes, from the moment of arming on."""

    def __init__(self, encoder_counts_per_step: tuple[float, float, float]) -> None:
        self._ratio = np.array(encoder_counts_per_step)
        self._apart_at_rest: np.ndarray | None = None
        self._since_ns: int | None = None
        self.words = ""

    def restart(self) -> None:
        """Takes the difference at the next status as right; for arming."""
        self._apart_at_rest, self._since_ns, self.words = None, None, ""

    def failed(self, position_steps: np.ndarray, encoder_counts: np.ndarray, now_ns: int) -> bool:
        """Whether steps (3,) and counts (3,) have parted for good; `words` then says where and by how much."""
        apart = np.asarray(encoder_counts) / self._ratio - np.asarray(position_steps)
        if self._apart_at_rest is None:
            self._apart_at_rest = apart
        apart = np.abs(apart - self._apart_at_rest)
        axis = int(np.argmax(apart))
        if apart[axis] <= STEPS_APART:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        self.words = f"{('insertion', 'roll', 'knob')[axis]}: encoder and steps are {apart[axis]:.0f} steps apart"
        return now_ns - self._since_ns >= STEPS_APART_NS


class ForceCheck:
    """The force sensor against the model's estimate: their difference, averaged, stays within the model's error."""

    def __init__(self) -> None:
        self._apart_N = np.zeros(3)
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Forgets the average; for arming."""
        self._apart_N[:] = 0.0
        self._last_ns = None

    def failed(self, sensor_N: np.ndarray, estimate_N: np.ndarray, now_ns: int) -> bool:
        """Takes in a pair of readings (3,) N in the base frame, once an estimate. NaN in either is left out."""
        apart = np.asarray(sensor_N, float) - np.asarray(estimate_N, float)
        if not np.all(np.isfinite(apart)):
            return False
        dt_s = 0.025 if self._last_ns is None else max((now_ns - self._last_ns) * 1e-9, 0.0)
        self._last_ns = now_ns
        self._apart_N += (1.0 - math.exp(-dt_s / FORCE_AVERAGE_S)) * (apart - self._apart_N)
        return bool(np.linalg.norm(self._apart_N) > FORCE_APART_N)


class HostCheck:
    """Whether the model process answers, and in time. It moves nothing, so that it is told and no more."""

    def __init__(self) -> None:
        self._heard_ns: int | None = None
        self._complaint = ""

    def heard(self, stamp_ns: int, now_ns: int) -> str:
        """An estimate has come; returns a sentence to tell, or nothing."""
        self._heard_ns = now_ns
        late = now_ns - stamp_ns > HOST_LATE_NS
        return self._changed(
            f"estimates are more than {HOST_LATE_NS * 1e-6:.0f} ms old: the model process is slow" if late else ""
        )

    def silent(self, now_ns: int) -> str:
        """To be asked at every tick; returns a sentence to tell when the process has fallen silent, once."""
        if self._heard_ns is None or now_ns - self._heard_ns <= HOST_SILENT_NS:
            return ""
        return self._changed(f"no estimate for {HOST_SILENT_NS * 1e-6:.0f} ms: the model process is silent")

    def _changed(self, complaint: str) -> str:
        told, self._complaint = self._complaint, complaint
        return complaint if complaint != told else ""


class Supervision:
    """The three checks together. `flags` is the bit set of failsafe causes that stand; it stays until `restart`."""

    def __init__(self, encoder_counts_per_step: tuple[float, float, float]) -> None:
        self.steps, self.force, self.host = StepCheck(encoder_counts_per_step), ForceCheck(), HostCheck()
        self.flags = 0

    def restart(self) -> None:
        """For arming and clearing: the operator has seen what was wrong."""
        self.steps.restart()
        self.force.restart()
        self.flags = 0

    def status(self, position_steps: np.ndarray, encoder_counts: np.ndarray, now_ns: int) -> str:
        """A board's status while armed; returns what to log."""
        if self.flags & safety.STEPS_LOST or not self.steps.failed(position_steps[:N_AXES], encoder_counts[:N_AXES], now_ns):
            return ""
        self.flags |= safety.STEPS_LOST
        return self.steps.words

    def estimate(self, sensor_N: np.ndarray, estimate_N: np.ndarray, now_ns: int) -> str:
        """A converged estimate in contact; returns what to log."""
        if self.flags & safety.FORCE_DISAGREES or not self.force.failed(sensor_N, estimate_N, now_ns):
            return ""
        self.flags |= safety.FORCE_DISAGREES
        return f"force sensor and model are more than {FORCE_APART_N} N apart"
