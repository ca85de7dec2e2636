"""Lateness and working time of the loop, measured alternately with cyclictest on the same CPU."""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import tempfile
import threading
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol.enums import CommandKind
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.loop.clock import Clock
from realtime.loop.loop_thread import NativeLoop, input_mailboxes
from realtime.loop.mailbox import Mailbox
from realtime.loop.native_loop import BINS, BINS_PER_OCTAVE, HISTOGRAM_WORDS, LATENESS_BIN_NS, WORK_BIN_NS, bin_of
from realtime.loop.scheduling import RealtimeReport, RealtimeSettings

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
# Edges of the printed histogram, in us; finer where a good machine is.
EDGES_US = (0, 1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 70, 100, 200, 500, 1000, 2000, 5000, 10_000, BINS)
_SLICES = 5
_FEED_S = 0.005


def bin_edges_ns(index: float, bin_ns: int) -> float:
    """The shortest time that bin `index` of a histogram of `native_loop.count_in` counts, in ns."""
    return float(bin_ns * (index if index <= BINS else BINS * 2.0 ** ((index - BINS) / BINS_PER_OCTAVE)))


def percentiles_us(histogram: np.ndarray, bin_ns: int) -> dict[str, float]:
    """p50, p99, p999 (interpolated within a bin) and the exact max, in us.

    Args: histogram (HISTOGRAM_WORDS,) int64 as `native_loop.count_in` keeps it. All zero: every figure is 0.
    """
    counts, max_ns = histogram[:-1], int(histogram[-1])
    sums, out = np.cumsum(counts), {}
    for name, share in QUANTILES.items():
        rank = share * sums[-1]
        index = int(np.searchsorted(sums, rank))
        if sums[-1] == 0:
            value_ns = 0.0
        else:
            low_ns, high_ns = bin_edges_ns(index, bin_ns), bin_edges_ns(index + 1, bin_ns)
            value_ns = high_ns - (sums[index] - rank) / counts[index] * (high_ns - low_ns)
        out[name] = float(min(value_ns, max_ns)) * 1e-3
    return out | {"max": max_ns * 1e-3}


def coarse(histogram: np.ndarray) -> list[int]:
    """Counts between EDGES_US (the last: beyond) of a histogram with bins of 1 us."""
    starts = np.array(EDGES_US)
    return [int(part) for part in np.add.reduceat(histogram[:-1], starts)]


def text_histogram(columns: dict[str, np.ndarray], width: int = 30) -> str:
    """The lateness histograms side by side, a bar per row and column, as text.

    Args: columns: heading -> histogram with bins of 1 us; width of the longest bar in characters.
    """
    parts = {name: coarse(histogram) for name, histogram in columns.items()}
    rows = [i for i in range(len(EDGES_US)) if any(part[i] for part in parts.values())]
    lines = [f"{'lateness (us)':>14}  " + "".join(f"{name:<{width + 10}}" for name in parts).rstrip()]
    for i in rows:
        label = f"{EDGES_US[i]}-{EDGES_US[i + 1]}" if i + 1 < len(EDGES_US) else f"over {EDGES_US[i]}"
        cells = []
        for part in parts.values():
            length = -(-part[i] * width // max(1, max(part)))
            cells.append(f"{part[i]:>8} {'#' * length:<{width + 1}}")
        lines.append(f"{label:>14}  " + "".join(cells).rstrip())
    return "\n".join(lines)


@dataclass
class LatencyResult:
    """What one check found; histograms as `native_loop` keeps them."""

    hz: int
    lateness: np.ndarray
    work: np.ndarray
    ticks: int
    missed: int
    granted: RealtimeReport
    longest_gap_ns: int
    longest_gap_place: int
    cyclictest: np.ndarray | None = None
    cyclictest_failed: str | None = None


class _Feeder(threading.Thread):
    """Plays the driver threads of a rig at rest in contact: poses at 40 Hz, force and board status at 200 Hz.

    It also reads what the loop sends and publishes, and so keeps the interpreter about as busy as on a rig.
    """

    def __init__(self, mailboxes: dict[str, Mailbox], loop: NativeLoop, line: int) -> None:
        super().__init__(name="feeder", daemon=True)
        self._boxes, self._loop, self._line = mailboxes, loop, line
        self._done = threading.Event()
        self._clock = Clock.monotonic()

    def run(self) -> None:
        for turn in range(1 << 62):
            if self._done.wait(_FEED_S):
                return
            self._feed(turn)
            self._loop.telemetry.drain()
            while True:
                try:
                    os.read(self._line, 65536)
                except BlockingIOError:
                    break

    def _feed(self, turn: int) -> None:
        now = self._clock.now_ns()
        self._boxes["board"].publish(arrival_ns=now, ready=1, state=2)
        self._boxes["sensor"].publish(stamp_ns=now, arrival_ns=now, force_N=(0.0, 0.0, 0.2 if turn > 60 else 0.0))
        if turn % 5 == 0:
            self._boxes["tip"].publish(
                stamp_ns=now - 25_000_000,
                arrival_ns=now,
                position_m=(0.0, -0.006, 0.034),
                quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
            )
        if turn in (20, 40):
            self._boxes["command"].publish(
                kind=CommandKind.HOLD if turn == 20 else CommandKind.CONTACT,
                armed=1,
                target_m=(0.0, -0.006, 0.034),
                normal=(0.0, 0.0, -1.0),
                force_N=0.2,
            )

    def stop(self) -> None:
        self._done.set()
        self.join()


def _add(total: np.ndarray, part: np.ndarray) -> None:
    total[:-1] += part[:-1]
    total[-1] = max(total[-1], part[-1])


def run_cyclictest(hz: int, seconds: float, cpu: int | None, priority: int | None) -> np.ndarray:
    """Histogram of cyclictest's latencies, in the form of NativeLoop.lateness.

    Args: cpu to pin to, None for any; priority: SCHED_FIFO priority (with locked memory), None for neither.
    Raises: OSError, RuntimeError, ValueError, KeyError where cyclictest does not run or says something unknown.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "cyclictest.json"
        command = [
            "cyclictest",
            "--quiet",
            "--threads=1",
            f"--interval={round(1e6 / hz)}",
            f"--loops={max(1, round(seconds * hz))}",
            f"--histogram={BINS}",
            f"--json={report}",
        ]
        command += [f"--affinity={cpu}"] if cpu is not None else []
        command += ["--mlockall", f"--priority={priority}"] if priority is not None else []
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + 30, check=False)
        if done.returncode != 0 or not report.exists():
            said = " ".join((done.stdout + done.stderr).split())[:160]
            raise RuntimeError(f"cyclictest: found exit status {done.returncode} ({said}), wanted 0 and its report")
        thread = json.loads(report.read_text(encoding="utf-8"))["thread"]["0"]
    histogram = np.zeros(HISTOGRAM_WORDS, np.int64)
    for latency_us, count in thread["histogram"].items():
        histogram[min(int(latency_us), BINS)] += int(count)
    histogram[-1] = int(thread["max"]) * 1000
    # Where those are that were longer than its last bin, cyclictest does not say: at the longest, to be on the safe side.
    histogram[bin_of(LATENESS_BIN_NS, int(histogram[-1]))] += int(thread["cycles"]) - histogram[:-1].sum()
    return histogram


def check_latency(
    tick: Callable[..., None],
    params: np.ndarray,
    hz: int,
    seconds: float,
    realtime: RealtimeSettings | None,
    compare_cyclictest: bool = True,
    run: Callable[..., int] | None = None,
) -> LatencyResult:
    """Run the native loop with `tick` for `seconds`; where cyclictest is installed, it takes every other slice.

    Args: params: the tick's PARAMS for this hz; realtime: what to ask of the kernel for both; run: as for `NativeLoop`.
    Both run with the same priority, CPU and background load, so the half that each gets is comparable.
    """
    installed = compare_cyclictest and shutil.which("cyclictest") is not None
    slices = max(1, min(_SLICES, int(seconds // 2))) if installed else 1
    slice_s = seconds / (2 * slices if installed else slices)
    board, line = pty.openpty()
    tty.setraw(line)
    os.set_blocking(line, False)
    os.set_blocking(board, False)
    boxes = input_mailboxes(INPUTS)
    loop = NativeLoop(
        tick,
        params,
        new(STATE),
        INPUTS,
        OUTPUTS,
        boxes,
        clock=Clock.monotonic(),
        period_ns=round(1e9 / hz),
        fd=line,
        realtime=realtime,
        run=run,
    )
    loop.prepare()
    feeder = _Feeder(boxes, loop, board)
    feeder.start()
    result = LatencyResult(hz, loop.lateness, loop.work, 0, 0, loop.granted, 0, 0)
    try:
        for _ in range(slices):
            loop.start(max_ticks=max(1, round(slice_s * hz)))
            loop.join()
            if loop.error is not None:
                raise loop.error
            if installed and result.cyclictest_failed is None:
                _cyclictest_slice(result, loop.granted, slice_s, realtime)
    finally:
        loop.stop()
        loop.join()
        feeder.stop()
        os.close(board)
        os.close(line)
    last = loop.snapshot()
    result.ticks, result.missed, result.granted = last["tick"], last["missed"], loop.granted
    result.longest_gap_ns, result.longest_gap_place = last["longest_gap_ns"], last["longest_gap_place"]
    return result


def _cyclictest_slice(
    result: LatencyResult, granted: RealtimeReport, slice_s: float, realtime: RealtimeSettings | None
) -> None:
    priority = realtime.priority if realtime is not None and granted.priority else None
    try:
        histogram = run_cyclictest(result.hz, slice_s, granted.cpu, priority)
    except (OSError, RuntimeError, ValueError, KeyError, subprocess.TimeoutExpired) as error:
        result.cyclictest, result.cyclictest_failed = None, str(error)
        return
    if result.cyclictest is None:
        result.cyclictest = np.zeros_like(histogram)
    _add(result.cyclictest, histogram)


def as_contract(result: LatencyResult) -> dict[str, object]:
    """The figures of `result` as `seldinger latency-check --json` prints them, all times in us."""
    cyclictest = result.cyclictest
    return {
        "hz": result.hz,
        "lateness_us": percentiles_us(result.lateness, LATENESS_BIN_NS),
        "cyclictest_us": None if cyclictest is None else percentiles_us(cyclictest, LATENESS_BIN_NS),
        "tick_us": percentiles_us(result.work, WORK_BIN_NS),
        "missed": result.missed,
        "realtime_priority": result.granted.priority,
        "ticks": result.ticks,
        "histogram": {
            "edges_us": list(EDGES_US),
            "loop": coarse(result.lateness),
            "cyclictest": None if cyclictest is None else coarse(cyclictest),
        },
    }
