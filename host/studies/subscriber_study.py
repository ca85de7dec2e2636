"""Effect of subscribers on the loop: its timing on the wall clock with each kind of subscriber, in turn with none.

`seldinger latency-check --with ...` runs the simulated rig, the model process and, here, the realtime process.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet
from host.studies.bad_subscriber import KINDS, bad_subscriber
from protocol.rig_file import load_rig
from realtime.core.process import RealtimeProcess
from realtime.loop.latency import percentiles_us, run_cyclictest
from realtime.loop.native_loop import LATENESS_BIN_NS, WORK_BIN_NS

RECORDER_ONLY, IDLE = "recorder only", "cyclictest"
SAYS = {RECORDER_ONLY: "only the recorder"} | KINDS
ROUNDS = 3
_SETTLED_S, _OVER_S = 2.0, 1.0


@dataclass
class MeasuredLoop:
    """Sums over all slices of one kind. lateness, work: histograms as the loop keeps them; threads_s: how late a thread
    of the same process woke that wanted to sleep 1 ms, as those of the devices do."""

    lateness: np.ndarray
    work: np.ndarray
    ticks: int = 0
    missed: int = 0
    flooded: int = 0
    threads_s: list[float] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """Return the percentiles as JSON's types, times in us."""
        threads = np.percentile(self.threads_s, (50, 99)) * 1e6 if self.threads_s else (0.0, 0.0)
        return {
            "ticks": self.ticks,
            "missed": self.missed,
            "lateness_us": _of(self.lateness, LATENESS_BIN_NS),
            "tick_us": _of(self.work, WORK_BIN_NS),
            "queries_dropped": self.flooded,
            "threads_late_us": {"p50": float(threads[0]), "p99": float(threads[1])},
        }


@dataclass
class Study:
    """By kind, and what cyclictest found in slices between them (None: not installed, or failed)."""

    measured: dict[str, MeasuredLoop]
    cyclictest: np.ndarray | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as a dictionary for JSON."""
        idle = None if self.cyclictest is None else _of(self.cyclictest, LATENESS_BIN_NS)
        return {"subscribers": {kind: one.figures() for kind, one in self.measured.items()}, "cyclictest_us": idle}


def _of(histogram: np.ndarray, bin_ns: int) -> dict[str, float]:
    """The maximum is of the whole run, not of a kind: left out."""
    return {name: value for name, value in percentiles_us(histogram, bin_ns).items() if name != "max"}


def study(kinds: Sequence[str], seconds: float, board: str = "native") -> Study:
    """None and every kind in turn, ROUNDS times, `seconds` in all; the loop runs through, cyclictest between the rounds.

    Raises OSError where a process does not run.
    """
    slice_s = seconds / ROUNDS / (len(kinds) + 2)
    found = Study({})
    with tempfile.TemporaryDirectory() as folder:
        settings = DemoSettings(board=board, directory=Path(folder))
        with Fleet(settings, Path(folder) / "study.mcap", loop=False) as fleet:
            rig = load_rig(fleet.rig_file)
            process = RealtimeProcess(
                rig,
                board_port=fleet.ports["board"],
                tracker_port=fleet.ports["tracker"],
                force_port=fleet.ports["force_port"],
            )
            process.start()
            if process.loop.granted.warning:
                print(f"seldinger: {process.loop.granted.warning}", file=sys.stderr)
            time.sleep(_SETTLED_S)
            try:
                for _ in range(ROUNDS):
                    for kind in (RECORDER_ONLY, *kinds):
                        _slice(process, kind, slice_s, found.measured)
                    _reference(process, slice_s, found)
            finally:
                process.stop()
    return found


def _slice(process: RealtimeProcess, kind: str, seconds: float, measured: dict[str, MeasuredLoop]) -> None:
    loop = process.loop
    with bad_subscriber(kind, process.rig.name, process.rig.connect_endpoints[0]) as bad:
        late, work, before, flooded = loop.lateness.copy(), loop.work.copy(), loop.snapshot(), process.counts().flooded
        one = measured.setdefault(kind, MeasuredLoop(np.zeros_like(late), np.zeros_like(work)))
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            time.sleep(0.001)
            one.threads_s.append(time.monotonic() - now - 0.001)
            if bad is not None:
                bad.tend()
        for total, new, old in ((one.lateness, loop.lateness, late), (one.work, loop.work, work)):
            total[:-1] += new[:-1] - old[:-1]
            total[-1] = new[-1]
        after = loop.snapshot()
        one.ticks += after["tick"] - before["tick"]
        one.missed += after["missed"] - before["missed"]
        one.flooded += process.counts().flooded - flooded
    time.sleep(_OVER_S)


def _reference(process: RealtimeProcess, seconds: float, found: Study) -> None:
    """Measure the lateness of a program that only wakes, with the loop's priority on the loop's processor."""
    granted = process.loop.granted
    try:
        histogram = run_cyclictest(process.rig.control.loop_hz, seconds, granted.cpu, granted.priority or None)
    except (OSError, RuntimeError, ValueError, KeyError, subprocess.TimeoutExpired) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        return
    found.cyclictest = histogram if found.cyclictest is None else found.cyclictest + histogram


def page_section(found: Study, kinds: Sequence[str], seconds: float) -> str:
    """The section on subscribers in docs/reliability.md, times in us."""
    lines = [
        "## Subscribers and the loop",
        "",
        f"`seldinger latency-check --with {','.join(kinds)} --seconds {seconds:g} --docs docs/reliability.md`",
        "",
        "The loop at 1 kHz, the model process and the simulated rig run on one machine, on the wall clock. The kinds of",
        "subscriber take turns, so that other load of the machine affects all of them equally. Times are in us. In virtual",
        "time every step edge is the same with each kind (`pytest tests/host/test_subscribers.py`).",
        "",
        "| with | ticks | missed | lateness p50 | p99 | p99.9 | pass p50 | p99 | p99.9 | threads late p50 | p99 | "
        "queries dropped |",
        "|---|" + "---:|" * 11,
    ]
    for kind, one in found.measured.items():
        figures = one.figures()
        times = [figures[part][name] for part in ("lateness_us", "tick_us") for name in ("p50", "p99", "p999")]
        times += figures["threads_late_us"].values()
        lines.append(
            f"| {SAYS[kind]} | {one.ticks} | {one.missed} | "
            + " | ".join(f"{value:.1f}" for value in times)
            + f" | {one.flooded} |"
        )
    if found.cyclictest is not None:
        idle = _of(found.cyclictest, LATENESS_BIN_NS)
        lines.append(
            "| for comparison: cyclictest, which only wakes | | | "
            + " | ".join(f"{idle[name]:.1f}" for name in ("p50", "p99", "p999"))
            + " |"
            + " |" * 6
        )
    lines += [
        "",
        "*lateness*: time between the due time of a tick and the wake-up of the loop. *pass*: time of one pass of its work.",
        "*threads late*: lateness of a thread of the same process that sleeps for 1 ms, as the threads do that read the",
        "devices. The first row and cyclictest are the reference, because other load of the machine is in all rows.",
    ]
    return "\n".join(lines)
