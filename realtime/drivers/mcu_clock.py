"""The board's clock seen from the host: offset by the least delayed messages, drift by how these move."""

from collections import deque
from typing import NamedTuple

BUCKET_NS = 500_000_000
BUCKETS = 8
MAX_DRIFT = 0.01  # a ceramic resonator is within 0.5 %
_WRAP_US = 1 << 32


class _Least(NamedTuple):
    bucket: int
    host_ns: int
    offset_ns: int


class McuClock:
    """Estimates offset_ns = host clock - board clock from stamped messages that arrive with unknown delay.

    A message can only be late, never early, so the smallest difference in each half second is the best one; a line
    through these gives the drift. The offset holds the least transport delay that was seen.
    """

    def __init__(self) -> None:
        self._mcu_us: int | None = None
        self._least: deque[_Least] = deque(maxlen=BUCKETS)

    def restart(self) -> None:
        """Forgets everything (the board was reset)."""
        self._mcu_us = None
        self._least.clear()

    def update(self, mcu_time_us: int, sent_ns: int) -> int:
        """Takes one stamp; returns the board's time without wraps, in us.

        mcu_time_us: u32 as received. sent_ns: host time of arrival, less the time the frame needs on the line.
        """
        if self._mcu_us is None:
            self._mcu_us = mcu_time_us
        step = (mcu_time_us - self._mcu_us + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
        self._mcu_us += step
        sample = _Least(sent_ns // BUCKET_NS, sent_ns, sent_ns - self._mcu_us * 1000)
        if self._least and self._least[-1].bucket == sample.bucket:
            if sample.offset_ns < self._least[-1].offset_ns:
                self._least[-1] = sample
        else:
            self._least.append(sample)
        return self._mcu_us

    @property
    def known(self) -> bool:
        """Whether any stamp has arrived."""
        return bool(self._least)

    @property
    def drift(self) -> float:
        """Growth of the offset in ns per ns of host time; 0 until the stamps span three buckets."""
        if len(self._least) < 3:
            return 0.0
        first, last = self._least[0], self._least[-1]
        slope = (last.offset_ns - first.offset_ns) / (last.host_ns - first.host_ns)
        return min(max(slope, -MAX_DRIFT), MAX_DRIFT)

    def offset_ns(self, now_ns: int) -> int:
        """Host time minus board time at `now_ns`. Raises ValueError before the first stamp."""
        if not self._least:
            raise ValueError("board clock: found no stamp yet, wanted at least one STATUS")
        drift = self.drift
        return min(s.offset_ns + round(drift * (now_ns - s.host_ns)) for s in self._least)

    def to_mcu_us(self, host_ns: int, now_ns: int) -> int:
        """Board time (u32, us) of the host time `host_ns`, by the offset at `now_ns`."""
        return (host_ns - self.offset_ns(now_ns)) // 1000 % _WRAP_US
