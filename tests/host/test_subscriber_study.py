"""`seldinger latency-check --with`: what it refuses, and that its page says what was measured."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from host.studies.bad_subscriber import KINDS
from host.studies.subscriber_study import RECORDER_ONLY, SAYS, MeasuredLoop, Study, page_section
from realtime.loop.native_loop import BINS


def measured(late_us: int, missed: int = 0) -> MeasuredLoop:
    lateness = np.zeros(BINS + 2, np.int64)
    lateness[late_us] = 1000
    lateness[-1] = 1000 * (late_us + 1)
    return MeasuredLoop(lateness, lateness.copy(), ticks=1000, missed=missed, flooded=7, threads_s=[1e-4] * 99 + [2e-3])


def test_the_page_has_a_row_for_each_kind_and_one_for_comparison() -> None:
    found = Study({RECORDER_ONLY: measured(4), "view": measured(9, missed=2)}, measured(3).lateness)
    rows = {line.split(" | ")[0]: line for line in page_section(found, ["view"], 60.0).splitlines() if line.startswith("| ")}
    assert len(rows) == 4 and f"| {SAYS['view']}" in rows
    assert [float(cell) for cell in rows[f"| {SAYS['view']}"].strip("| ").split(" | ")[1:]][:3] == [1000, 2, 9.5]
    assert "| 3.5 |" in rows["| for comparison: cyclictest, which only wakes"]
    figures = found.as_dict()["subscribers"]["view"]
    assert figures["missed"] == 2 and figures["queries_dropped"] == 7
    assert figures["threads_late_us"]["p50"] == pytest.approx(100.0)
    assert figures["lateness_us"]["p50"] == pytest.approx(9.5) and "max" not in figures["lateness_us"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--with", "frozen,nosy"], '--with: found "nosy", wanted one of ' + ", ".join(KINDS)),
        (["--docs", "page.md"], '--docs: found "page.md", wanted --with too'),
    ],
)
def test_what_it_refuses(arguments: list[str], says: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "host.cli.main", "latency-check", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and says in done.stderr
