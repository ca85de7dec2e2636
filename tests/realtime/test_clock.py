"""One clock type: the machine's time goes on, virtual time only as it is handed out; compiled code sees the same."""

import threading
import time

import numpy as np
import pytest

from realtime.loop.clock import Clock, now_ns, sleep_until


def test_the_monotonic_clock_is_the_machine_s_in_python_and_in_compiled_code() -> None:
    clock = Clock.monotonic()
    now_ns(clock.words)
    times = [time.monotonic_ns(), clock.now_ns(), now_ns(clock.words), time.monotonic_ns()]
    assert times == sorted(times) and not clock.is_virtual


def test_a_monotonic_sleep_never_ends_early() -> None:
    clock, stop = Clock.monotonic(), np.zeros(1, np.int64)
    for _ in range(5):
        deadline = clock.now_ns() + 300_000
        assert sleep_until(clock.words, deadline, stop) >= deadline
        assert clock.sleep_until(deadline + 100_000) and clock.now_ns() >= deadline + 100_000


def test_virtual_time_stands_still_until_it_is_handed_out() -> None:
    clock = Clock.virtual(5)
    assert (clock.now_ns(), now_ns(clock.words)) == (5, 5)
    clock.advance_to(1_000)
    assert (clock.now_ns(), now_ns(clock.words)) == (1_000, 1_000)


def test_time_goes_back_on_no_clock() -> None:
    clock = Clock.virtual(10)
    with pytest.raises(ValueError, match="wanted 10 or later"):
        clock.advance_to(9)
    with pytest.raises(ValueError, match="found monotonic, wanted virtual"):
        Clock.monotonic().advance_to(1)


def test_sleepers_in_python_and_in_compiled_code_wake_at_the_virtual_time_they_wait_for() -> None:
    clock, stop, woke = Clock.virtual(), np.zeros(1, np.int64), {}

    def compiled() -> None:
        woke["compiled"] = sleep_until(clock.words, 1_000, stop)

    def python() -> None:
        assert clock.sleep_until(1_000)
        woke["python"] = clock.now_ns()

    threads = [threading.Thread(target=job) for job in (compiled, python)]
    for thread in threads:
        thread.start()
    clock.advance_to(999)
    assert not woke
    clock.advance_to(1_000)
    for thread in threads:
        thread.join()
    assert woke == {"compiled": 1_000, "python": 1_000}


def test_a_virtual_sleep_ends_when_told_to_stop_or_when_its_world_is_gone() -> None:
    clock = Clock.virtual(3)
    assert sleep_until(clock.words, 1_000, np.ones(1, np.int64)) == 3
    assert clock.sleep_until(1_000, timeout_s=0.01) is False
