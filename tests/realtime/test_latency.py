"""The latency check: percentiles that are right, counts that add up, and no harm where something is not allowed."""

import json
import os
import stat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.rig_file import Rig
from realtime.control.configure import tick_parameters
from realtime.control.tick import tick
from realtime.loop.latency import EDGES_US, as_contract, check_latency, coarse, percentiles_us, text_histogram
from realtime.loop.native_loop import BINS, HISTOGRAM_WORDS, count_in
from realtime.loop.scheduling import RealtimeSettings, realtime_thread


def histogram_of(values_ns: list[int], bin_ns: int = 1000) -> np.ndarray:
    histogram = np.zeros(HISTOGRAM_WORDS, np.int64)
    for value in values_ns:
        count_in(histogram, bin_ns, value)
    return histogram


@given(st.lists(st.integers(0, BINS * 1000 - 1), min_size=1, max_size=300))
@settings(deadline=None, max_examples=50)
def test_percentiles_are_within_a_bin_of_the_exact_ones(values_ns: list[int]) -> None:
    found = percentiles_us(histogram_of(values_ns), 1000)
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        exact_us = np.quantile(values_ns, share, method="inverted_cdf") * 1e-3
        assert abs(found[name] - exact_us) <= 1.0 + 1e-9
    assert found["max"] == max(values_ns) * 1e-3
    assert found["p50"] <= found["p99"] <= found["p999"] <= found["max"]


def test_one_stall_does_not_make_the_percentiles_of_long_ticks_the_maximum() -> None:
    """Ticks of a busy machine: 2 % take 3 ms, longer than the last even bin, and one takes 1.7 s."""
    values_ns = [20_000] * 9799 + [3_000_000] * 200 + [1_742_511_000]
    found = percentiles_us(histogram_of(values_ns, 100), 100)
    assert found["p50"] == pytest.approx(20.0, abs=0.1) and found["max"] == 1_742_511.0
    assert found["p99"] == pytest.approx(3000.0, rel=0.012) and found["p999"] == pytest.approx(3000.0, rel=0.012)


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=300))
@settings(deadline=None, max_examples=50)
def test_percentiles_of_any_times_are_within_a_bin_of_the_exact_ones(values_ns: list[int]) -> None:
    found = percentiles_us(histogram_of(values_ns), 1000)
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        exact_us = np.quantile(values_ns, share, method="inverted_cdf") * 1e-3
        assert abs(found[name] - exact_us) <= 1.0 + 0.011 * exact_us


def test_no_values_give_zeros() -> None:
    assert set(percentiles_us(np.zeros(HISTOGRAM_WORDS, np.int64), 1000).values()) == {0.0}


@given(st.lists(st.integers(0, 30_000_000), max_size=50))
@settings(deadline=None, max_examples=30)
def test_coarse_histograms_keep_every_count(values_ns: list[int]) -> None:
    histogram = histogram_of(values_ns)
    assert sum(coarse(histogram)) == len(values_ns)
    text = text_histogram({"loop": histogram, "cyclictest": histogram})
    assert sum(int(line.split()[-1 if line.split()[-1].isdigit() else -2]) for line in text.splitlines()[1:]) == len(
        values_ns
    )


def fake_cyclictest(folder: Path, body: str) -> None:
    program = folder / "cyclictest"
    program.write_text("#!/bin/sh\n" + body, encoding="utf-8")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)


def check(rig: Rig, seconds: float = 0.4) -> dict:
    return as_contract(check_latency(tick, tick_parameters(rig), 1000, seconds, None))


def test_ticks_and_misses_add_up_without_cyclictest(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    found = check(rig)
    assert found["cyclictest_us"] is None and found["hz"] == 1000 and found["realtime_priority"] is False
    assert found["ticks"] + found["missed"] == 400 and sum(found["histogram"]["loop"]) == found["ticks"]
    assert found["tick_us"]["max"] > 0
    json.dumps(found, allow_nan=False)


def test_cyclictest_takes_every_other_slice(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    thread = {"histogram": {"2": 6, "9": 3}, "cycles": 10, "max": 31_000, "min": 2, "avg": 3.0}
    report = json.dumps({"thread": {"0": thread}})
    fake_cyclictest(tmp_path, f"for word; do case $word in --json=*) echo '{report}' > \"${{word#--json=}}\";; esac; done\n")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    found = check(rig)
    assert found["ticks"] + found["missed"] == 200
    assert found["cyclictest_us"]["max"] == 31_000.0 and sum(found["histogram"]["cyclictest"]) == 10
    assert dict(zip(EDGES_US, found["histogram"]["cyclictest"], strict=True))[2] == 6


@pytest.mark.parametrize("body", ["echo no >&2; exit 3\n", "exit 0\n"])
def test_a_cyclictest_that_fails_is_told_and_does_not_end_the_check(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str
) -> None:
    fake_cyclictest(tmp_path, body)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    result = check_latency(tick, tick_parameters(rig), 1000, 0.2, None)
    assert result.cyclictest is None and "found exit status" in str(result.cyclictest_failed)
    assert result.ticks + result.missed == 100


def test_what_the_kernel_refuses_is_one_line_and_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr("realtime.loop.scheduling._may_lock_all", lambda: False)
    monkeypatch.setattr("realtime.loop.scheduling._IDLE_LATENCY_DEVICE", "/proc/self/status")
    with realtime_thread(RealtimeSettings()) as granted:
        assert not (granted.priority or granted.memory_locked or granted.shallow_idle) and granted.cpu is None
        assert granted.warning is not None and "\n" not in granted.warning
        assert all(word in granted.warning for word in ("SCHED_FIFO", "CPU", "locked memory", "/proc/self/status"))


def test_what_was_granted_is_given_back() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    with realtime_thread(RealtimeSettings()) as granted:
        assert granted.cpu is None or os.sched_getaffinity(0) == {granted.cpu}
        assert (os.sched_getscheduler(0) == os.SCHED_FIFO) == granted.priority
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_nothing_is_asked_for_without_settings() -> None:
    with realtime_thread(None) as granted:
        assert granted.warning is None and not granted.priority
