"""Does it matter to the loop who listens? Its timing on the wall clock beside bad subscribers, in turn with none.

`python -m host.subscriber_study` runs the simulated rig, the model process and, here, the realtime process.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from host.bad_subscriber import KINDS, bad_subscriber
from host.demo import DemoSettings
from host.wall_clock import Fleet
from realtime.latency import percentiles_us
from realtime.native_loop import LATENESS_BIN_NS, WORK_BIN_NS
from realtime.process import RealtimeProcess
from realtime.rig_file import load_rig

NOBODY = "nobody"
SAYS = {NOBODY: "only the recorder listens"} | KINDS


@dataclass
class Measured:
    """Sums over all slices of one kind. lateness, work: histograms as the loop keeps them; threads_s: how late a thread
    of the same process woke that wanted to sleep 1 ms, as those of the devices do."""

    lateness: np.ndarray
    work: np.ndarray
    ticks: int = 0
    missed: int = 0
    flooded: int = 0
    threads_s: list[float] = field(default_factory=list)


def study(board: str, seconds: float, rounds: int) -> dict[str, Measured]:
    """Every kind in turn, `rounds` times `seconds` each; the loop runs through."""
    measured: dict[str, Measured] = {}
    with tempfile.TemporaryDirectory() as folder:
        settings = DemoSettings(board=board, directory=Path(folder))
        with Fleet(settings, Path(folder) / "study.mcap", loop=False) as fleet:
            rig = load_rig(fleet.rig_file)
            process = RealtimeProcess(rig, board_port=fleet.ports["board"], tracker_port=fleet.ports["tracker"],
                                      force_port=fleet.ports["force_port"])
            process.start()
            if process.loop.granted.warning:
                print(f"seldinger: {process.loop.granted.warning}", file=sys.stderr)
            time.sleep(2.0)
            try:
                for _ in range(rounds):
                    for kind in SAYS:
                        _slice(process, kind, seconds, measured)
            finally:
                process.stop()
    return measured


def _slice(process: RealtimeProcess, kind: str, seconds: float, measured: dict[str, Measured]) -> None:
    loop = process.loop
    with bad_subscriber(kind, process.rig.name, process.rig.zenoh.connect[0]) as bad:
        late, work, before, flooded = loop.lateness.copy(), loop.work.copy(), loop.snapshot(), process.counts().flooded
        one = measured.setdefault(kind, Measured(np.zeros_like(late), np.zeros_like(work)))
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


def page(measured: dict[str, Measured]) -> str:
    """The result as a table in Markdown, times in us."""
    lines = ["| beside | ticks | missed | late by p50 | p99 | p99.9 | pass p50 | p99 | p99.9 | threads late p50 | p99 | "
             "queries dropped |", "|---|" + "---:|" * 11]
    for kind, one in measured.items():
        times = [percentiles_us(one.lateness, LATENESS_BIN_NS), percentiles_us(one.work, WORK_BIN_NS)]
        figures = [part[name] for part in times for name in ("p50", "p99", "p999")]
        figures += [float(value) * 1e6 for value in np.percentile(one.threads_s, (50, 99))]
        lines.append(f"| {SAYS[kind]} | {one.ticks} | {one.missed} | " + " | ".join(f"{f:.1f}" for f in figures)
                     + f" | {one.flooded} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(prog="python -m host.subscriber_study", description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of one slice")
    parser.add_argument("--rounds", type=int, default=3, help="how often each kind has its turn")
    parser.add_argument("--board", choices=("native", "avr"), default="native")
    options = parser.parse_args()
    print(page(study(options.board, options.seconds, options.rounds)))


if __name__ == "__main__":
    main()
