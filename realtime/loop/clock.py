"""One clock type, two clocks: CLOCK_MONOTONIC for a rig, and virtual time that the simulated world hands out."""

from __future__ import annotations

import threading
import time

import numpy as np
from numba import njit

from realtime.loop.atomics import load_acquire, put_word
from realtime.loop.libc import monotonic_ns, sleep_until_ns

MONOTONIC, VIRTUAL = 0, 1
KIND, NOW = 0, 1
CLOCK_WORDS = 8
# How often compiled code looks whether virtual time has moved on; short against a lock-step tick.
_POLL_NS = 20_000


@njit(cache=True, nogil=True, error_model="numpy")
def now_ns(clock: np.ndarray) -> int:
    """Time of the clock whose `Clock.words`, (8,) int64, are given."""
    if clock[KIND] == MONOTONIC:
        machine_ns: int = monotonic_ns()
        return machine_ns
    virtual_ns: int = load_acquire(clock, NOW)
    return virtual_ns


@njit(cache=True, nogil=True, error_model="numpy")
def sleep_until(clock: np.ndarray, deadline_ns: int, stop: np.ndarray) -> int:
    """Sleep until the clock reads `deadline_ns`, or, under virtual time, until stop[0], (>= 1,) int64, is not zero.

    A sleep on CLOCK_MONOTONIC is to absolute time (no drift) and is not cut short by a signal.
    Returns: the clock's time on waking.
    """
    now = now_ns(clock)
    while now < deadline_ns:
        if clock[KIND] == MONOTONIC:
            sleep_until_ns(deadline_ns)
        elif load_acquire(stop, 0) != 0:
            return now
        else:
            sleep_until_ns(monotonic_ns() + _POLL_NS)
        now = now_ns(clock)
    return now


class Clock:
    """A source of time in ns that never goes back. Made by `Clock.monotonic()` or `Clock.virtual(start_ns)`.

    `words`, (8,) int64, is the same clock for compiled code (`now_ns(words)`, `sleep_until(words, ...)`).
    """

    def __init__(self, kind: int, start_ns: int = 0) -> None:
        self.words = np.zeros(CLOCK_WORDS, np.int64)
        self.words[KIND], self.words[NOW] = kind, start_ns
        self._moved = threading.Condition()

    @classmethod
    def monotonic(cls) -> Clock:
        """The machine's CLOCK_MONOTONIC."""
        return cls(MONOTONIC)

    @classmethod
    def virtual(cls, start_ns: int = 0) -> Clock:
        """Time that stands still until `advance_to`."""
        return cls(VIRTUAL, start_ns)

    @property
    def is_virtual(self) -> bool:
        """Whether time is handed out by `advance_to`."""
        return bool(self.words[KIND] == VIRTUAL)

    def now_ns(self) -> int:
        """Return the time in ns."""
        return int(self.words[NOW]) if self.is_virtual else time.monotonic_ns()

    def advance_to(self, time_ns: int) -> None:
        """Hand out virtual time up to `time_ns`. Raises ValueError on a monotonic clock, or where time would go back."""
        if not self.is_virtual:
            raise ValueError("clock: found monotonic, wanted virtual (only virtual time is handed out)")
        if time_ns < self.words[NOW]:
            raise ValueError(f"time_ns: found {time_ns}, wanted {self.words[NOW]} or later")
        with self._moved:
            put_word(self.words, NOW, time_ns)
            self._moved.notify_all()

    def sleep_until(self, deadline_ns: int, timeout_s: float | None = None) -> bool:
        """Block this Python thread until `deadline_ns`; True when it is reached.

        Args: timeout_s: give up after this wall-clock time (virtual clock only: its world may have died).
        """
        if not self.is_virtual:
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
            return True
        with self._moved:
            return self._moved.wait_for(lambda: self.now_ns() >= deadline_ns, timeout_s)
