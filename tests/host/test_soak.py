"""The soak: its figures on a few virtual seconds, and that each figure out of bounds is named."""

import mmap

import pytest

from host.studies.soak import SoakResult, _judge, page_section, resident_mb, soak


def test_growing_memory_is_found_and_flat_memory_is_not() -> None:
    flat = SoakResult(virtual_s=7200.0, memory_mb=[150.0, 160.0] + [200.0] * 100, recording_readable=True)
    _judge(flat)
    assert flat.problems == [] and abs(flat.memory_slope_mb_per_h) < 1e-9
    minutes = [200.0 + 0.05 * minute for minute in range(120)]
    growing = SoakResult(virtual_s=7200.0, memory_mb=minutes, recording_readable=True)
    _judge(growing)
    assert growing.memory_slope_mb_per_h == pytest.approx(3.0) and "memory grows" in growing.problems[0]


def test_every_figure_out_of_bounds_is_named() -> None:
    bad = SoakResult(clock_error_s=2e-3, steps_exact=False, recording_mb_per_min=99.0, counts={"underruns": 2})
    _judge(bad)
    assert [problem.split()[0] for problem in bad.problems] == ["clocks", "steps", "recording", "recording", "underruns:"]
    assert "underruns 2" in page_section(bad, 1.0, 1, "native")


def test_resident_memory_is_that_of_this_process() -> None:
    before = resident_mb()
    with mmap.mmap(-1, 60_000_000) as block:  # not from what the heap of this process may have kept
        block.write(b"1" * len(block))
        assert resident_mb() - before > 50


@pytest.mark.slow
def test_some_seconds_keep_steps_clocks_and_counts() -> None:
    result = soak(0.1)
    assert result.steps_exact and result.edges > 10_000 and result.recording_readable
    assert result.clock_error_s < 1e-3 and not any(result.counts.values())
