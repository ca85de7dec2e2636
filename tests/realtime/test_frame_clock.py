"""Frame numbers to time: accuracy under jitter and drift, and what upsets it not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers.frame_clock import FrameClock

PERIOD_NS = 25_000_000


def errors_ns(jitter_s: float, drift: float, seconds: float, seed: int = 1, clock: FrameClock | None = None) -> np.ndarray:
    """Error of the learnt time of every frame after the first two seconds; jitter exponential, latency left out."""
    rng = np.random.default_rng(seed)
    clock = clock or FrameClock(0.025)
    found = []
    for frame in range(round(seconds * 40)):
        truth_ns = round(frame * PERIOD_NS * (1 + drift)) + 7_000_000_000
        arrival_ns = truth_ns + round(rng.exponential(jitter_s) * 1e9)
        found.append(clock.observe(frame + 1000, arrival_ns) - truth_ns)
    return np.array(found[80:])


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize(("jitter_s", "rms_ns"), [(0.0005, 25_000), (0.002, 100_000), (0.008, 400_000)])
def test_times_are_right_to_a_twentieth_of_the_jitter(jitter_s: float, rms_ns: float, drift: float) -> None:
    errors = errors_ns(jitter_s, drift, seconds=120)
    print(f"jitter {1e3 * jitter_s} ms, drift {1e6 * drift:+.0f} ppm: RMS {np.sqrt(np.mean(errors**2.0)) * 1e-6:.3f} ms")
    assert np.sqrt(np.mean(errors**2.0)) < rms_ns


def test_drift_is_found() -> None:
    clock = FrameClock(0.025)
    errors_ns(0.001, 200e-6, seconds=60, clock=clock)
    assert clock.drift == pytest.approx(200e-6, abs=20e-6)


def test_drift_does_not_add_up_over_an_hour() -> None:
    errors = errors_ns(0.001, -150e-6, seconds=3600)
    assert np.max(np.abs(errors[-4000:])) < 1_000_000


@given(st.lists(st.floats(0, 0.9), min_size=1, max_size=200), st.integers(0, 2**40))
@settings(derandomize=True, deadline=None, max_examples=100)
def test_a_time_is_never_after_its_arrival(delays_s: list[float], start_ns: int) -> None:
    clock = FrameClock(0.025)
    for frame, delay_s in enumerate(delays_s):
        arrival_ns = start_ns + frame * PERIOD_NS + round(delay_s * 1e9)
        assert clock.observe(frame, arrival_ns) <= arrival_ns


def test_a_stalled_reader_does_not_move_the_times() -> None:
    clock = FrameClock(0.025)
    for frame in range(400):
        arrival_ns = frame * PERIOD_NS
        clock.observe(frame, max(arrival_ns, 300 * PERIOD_NS) if 280 <= frame < 300 else arrival_ns)
    assert clock.time_ns(400) == pytest.approx(400 * PERIOD_NS, abs=1000)
    assert clock.restarts == 0


def test_one_arrival_far_too_early_is_not_learnt() -> None:
    clock = FrameClock(0.025)
    for frame in range(400):
        clock.observe(frame, frame * PERIOD_NS - (20_000_000 if frame == 200 else 0))
    assert clock.strange == 1
    assert clock.time_ns(400) == pytest.approx(400 * PERIOD_NS, abs=1000)


def test_late_first_arrivals_are_unlearnt_at_once() -> None:
    clock = FrameClock(0.025)
    for frame in range(20):
        clock.observe(frame, frame * PERIOD_NS + (18_000_000 if frame < 5 else 0))
    assert clock.strange == 0
    assert clock.time_ns(20) == pytest.approx(20 * PERIOD_NS, abs=1000)


@pytest.mark.parametrize("step_ns", [-3_000_000_000, 3_000_000_000])
def test_a_stepped_clock_is_learnt_anew(step_ns: int) -> None:
    clock = FrameClock(0.025)
    for frame in range(400):
        clock.observe(frame, frame * PERIOD_NS + (step_ns if frame >= 200 else 0))
    assert clock.restarts == 1
    assert clock.time_ns(400) == pytest.approx(400 * PERIOD_NS + step_ns, abs=1000)


def test_without_an_arrival_there_is_no_time() -> None:
    with pytest.raises(ValueError, match="no arrival"):
        FrameClock(0.025).time_ns(3)
    with pytest.raises(ValueError, match="period_s"):
        FrameClock(0.0)
