"""The board's clock seen from the host: its wrapping microseconds, and the host time that belongs to them."""

from realtime.drivers.frame_clock import FrameClock

MAX_DRIFT = 0.006  # a ceramic resonator is within 0.5 %
_WRAP_US = 1 << 32


class McuClock:
    """Estimates offset_ns = host clock - board clock from stamped messages that arrive with unknown delay.

    The stamps are the frame numbers of a `FrameClock` with a frame a microsecond: a message can only be late, so
    the lower edge of the arrivals is followed, drift included. The offset holds the least transport delay seen.
    """

    def __init__(self) -> None:
        self._clock = FrameClock(1e-6, max_drift=MAX_DRIFT, early_s=0.02)
        self._mcu_us: int | None = None

    def restart(self) -> None:
        """Delete the state, because the board was reset."""
        self._mcu_us = None
        self._clock.reset()

    def update(self, mcu_time_us: int, sent_ns: int) -> int:
        """Takes one stamp; returns the board's time without wraps, in us.

        mcu_time_us: u32 as received. sent_ns: host time of arrival, less the time the frame needs on the line.
        """
        if self._mcu_us is None:
            self._mcu_us = mcu_time_us
        step = (mcu_time_us - self._mcu_us + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
        self._mcu_us += step
        self._clock.observe(self._mcu_us, sent_ns)
        return self._mcu_us

    @property
    def known(self) -> bool:
        """Return whether a stamp has arrived."""
        return self._mcu_us is not None

    @property
    def drift(self) -> float:
        """Return the growth of the offset in ns per ns of host time."""
        return self._clock.drift

    def offset_ns(self, now_ns: int) -> int:
        """Return host time minus board time (ns) at `now_ns`. Raises ValueError before the first stamp."""
        if self._mcu_us is None:
            raise ValueError("board clock: found no stamp yet, wanted at least one STATUS")
        stamped_ns = self._clock.time_ns(self._mcu_us)
        return stamped_ns - self._mcu_us * 1000 + round(self.drift * (now_ns - stamped_ns))

    def to_mcu_us(self, host_ns: int, now_ns: int) -> int:
        """Return the board time (u32, us) of the host time `host_ns`, by the offset at `now_ns`."""
        return (host_ns - self.offset_ns(now_ns)) // 1000 % _WRAP_US
