"""The board's clock on the host: wraps, drift, delays."""

import numpy as np
import pytest

from realtime.drivers.mcu_clock import McuClock


def run(seconds: float, drift: float, seed: int = 0, start_us: int = 0) -> tuple[McuClock, int, int]:
    """Stamps at 200 Hz with delays of 0.2 ms and more; returns the clock, the last host time and true offset."""
    rng, clock = np.random.default_rng(seed), McuClock()
    now_ns = offset_ns = 0
    for k in range(round(seconds * 200)):
        mcu_us = 5000 * k
        true_ns = 7_000_000_000 + round(mcu_us * 1000 * (1 + drift))
        now_ns = true_ns + 200_000 + round(rng.exponential(300_000))
        offset_ns = true_ns - (start_us + mcu_us) * 1000
        clock.update((start_us + mcu_us) % 2**32, now_ns)
    return clock, now_ns, offset_ns


@pytest.mark.parametrize("drift", [0.0, 50e-6, -2e-3])
def test_offset_is_the_true_one_and_the_least_delay(drift: float) -> None:
    clock, now_ns, offset_ns = run(20.0, drift)
    assert abs(clock.offset_ns(now_ns) - offset_ns - 200_000) < 120_000


def test_the_wrap_of_the_boards_microseconds_does_not_show() -> None:
    start_us = 2**32 - 3_000_000
    clock, now_ns, offset_ns = run(10.0, 0.0, start_us=start_us)
    assert abs(clock.offset_ns(now_ns) - offset_ns - 200_000) < 120_000
    at = clock.to_mcu_us(now_ns, now_ns)
    assert abs(at - (start_us + 10_000_000) % 2**32) < 10_000


def test_nothing_is_known_before_the_first_stamp() -> None:
    clock = McuClock()
    assert not clock.known
    with pytest.raises(ValueError, match="found no stamp yet"):
        clock.offset_ns(0)
    clock.update(5, 1_000_000)
    assert clock.known
    clock.restart()
    assert not clock.known
