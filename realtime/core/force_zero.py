"""Zero of the force sensor: the mean of its last readings, when nothing touches the tip."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.errors import Description, InputError

# Readings that are averaged, and the fewest that make a mean (about 0.5 s and 0.25 s of a box at 1 kHz).
READINGS, LEAST_READINGS = 512, 250
# The newest reading is no older than this.
FRESH_NS = 100_000_000
# Readings that vary by more than this many times the sensor's noise come from a tip that touches something that moves.
QUIET_SIGMA, LEAST_QUIET_N = 5.0, 0.005
# A load above this share of the range is not a zero drift: something hangs on the sensor.
LARGEST_SHARE = 0.1

Array = npt.NDArray[np.float64]


class ForceZero:
    """Keeps the sensor's last readings and averages them.

    Args:
        noise_N: noise of the sensor, standard deviation of one axis.
        range_N: range of its calibration.
    """

    def __init__(self, noise_N: float, range_N: float) -> None:
        self._quiet_N, self._largest_N = max(QUIET_SIGMA * noise_N, LEAST_QUIET_N), LARGEST_SHARE * range_N
        self._readings_N, self._count, self._newest_ns = np.zeros((READINGS, 3)), 0, 0

    def take(self, force_N: Array, arrival_ns: int) -> None:
        """Store a reading (sensor frame, (3,) N) as the driver gave it, without any zero."""
        self._readings_N[self._count % READINGS] = force_N
        self._count += 1
        self._newest_ns = arrival_ns

    def measure(self, now_ns: int) -> Array:
        """Return the mean (3,) N of the last readings, sensor frame.

        Raises:
            InputError: readings are too few or too old, vary, or are larger than a zero can be.
        """
        if self._count < LEAST_READINGS or now_ns - self._newest_ns > FRESH_NS:
            raise InputError("zero", Description("too few fresh readings of the force sensor"), "a sensor that sends")
        readings_N = self._readings_N[: min(self._count, READINGS)]
        varies_N = float(np.max(np.std(readings_N, axis=0)))
        if not varies_N <= self._quiet_N:
            found = Description(f"a force that varies by {varies_N:.3f} N")
            raise InputError("zero", found, f"at most {self._quiet_N:.3f} N; the tip has to hang free")
        mean_N: Array = readings_N.mean(axis=0)
        size_N = float(np.linalg.norm(mean_N))
        if not size_N <= self._largest_N:
            raise InputError("zero", Description(f"{size_N:.3f} N"), f"at most {self._largest_N:.3f} N; check the mounting")
        return mean_N
