"""`make chaos`: random kills, stalls, unplugged ports and full disks in contact, over all processes on the wall clock.

Each run starts the simulated rig, the model process and the realtime process, presses on the beating wall, and breaks one
or two things. It then watches for some seconds without doing anything, and at last stops the rig over every path. Force and
motion are the plant's, times are those of the rig's own clock, so that a busy machine does not change the verdict.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import multiprocessing
import os
import resource
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from host.recordings.recording import RecordingFile
from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet, Operator
from host.studies.reliability_page import write_section
from protocol.stop_client import stop_by_socket, stop_over
from protocol.worker_process import end_with_parent
from sim.scenario import TARGET_M, ContactJob

LIMIT_N = 0.55
TROUBLES = (
    "realtime killed",
    "host killed",
    "realtime stalled",
    "host stalled",
    "rig stalled",
    "board unplugged",
    "tracker unplugged",
    "disk full",
)
NAMES = {"host": "model process", "realtime": "realtime process", "rig": "simulated rig"}
# Stalls are drawn between these, evenly in their logarithm: from below the board's dead-man time to above every limit.
STALL_S = (0.02, 3.0)
# The rig is watched for so long after its trouble, and after the stop.
WATCHED_S, STOPPED_S = 3.0, 3.0
# Without a step edge for so long before the end of an interval the stages are at rest.
QUIET_S = 0.5
_TOUCH_S = 90.0
_ROOM_BYTES = 20_000


@dataclass(frozen=True)
class Trouble:
    """One thing that breaks. delay_s: after the one before; stall_s: of a stall."""

    what: str
    delay_s: float
    stall_s: float


@dataclass
class ChaosRun:
    """A run: its troubles, and what followed by the rig's clock and plant. True forces, N; times, s; None: it moves on."""

    number: int
    troubles: list[Trouble]
    contact: bool = False
    note: str = ""
    peak_N: float | None = None
    rest_s: float | None = None
    confirmed: bool = False
    answered: list[str] = field(default_factory=list)
    rest_after_stop_s: float | None = None
    force_left_N: float | None = None
    readable: bool = False
    broken: list[str] = field(default_factory=list)

    @property
    def reachable(self) -> bool:
        """Whether the realtime process is there to be stopped."""
        return not any(trouble.what == "realtime killed" for trouble in self.troubles)


def drawn_troubles(random: np.random.Generator) -> list[Trouble]:
    """Draw one trouble, or in every second run two different ones within half a second."""
    count = 1 + int(random.integers(2))
    low, high = map(math.log, STALL_S)
    return [
        Trouble(str(what), float(random.uniform(0.0, 0.5)), float(math.exp(random.uniform(low, high))))
        for what in random.choice(TROUBLES, size=count, replace=False)
    ]


def run_once(number: int, seed: int, settings: DemoSettings) -> ChaosRun:
    """Carry out run `number` of the campaign with `seed`."""
    random = np.random.default_rng([seed, number])
    result = ChaosRun(number, drawn_troubles(random))
    wait_s = float(random.uniform(0.5, 4.0))
    path = settings.directory / f"chaos-{number}.mcap"
    with Fleet(settings, path) as fleet:
        operator = Operator(fleet)
        with contextlib.closing(operator.session):
            result.contact = operator.touch(ContactJob(TARGET_M, force_N=settings.force_N, approach_s=120.0), _TOUCH_S)
            if not result.contact:
                result.note = f"phase {operator.mode() or 'unknown'}, {'; '.join(operator.causes[-2:]) or 'no cause'}"
            else:
                operator.wait(wait_s, lambda: False)
                # A machine too busy for the loop makes the rig leave the wall by itself: nothing is shown then.
                result.contact = operator.mode() == "contact"
                if result.contact:
                    _break(fleet, path, result.troubles)
                    _stop(fleet, operator, result)
                else:
                    result.note = (
                        f"phase {operator.mode() or 'unknown'} before the trouble; {'; '.join(operator.causes[-2:])}"
                    )
    if result.contact:
        _judge(result, fleet.rig_summary)
        with contextlib.suppress(ValueError, OSError):
            recording = RecordingFile(path)
            result.readable = recording.topics.get("state", 0) > 0 and len(recording.table("pose/tip")["x_m"]) > 0
        if not result.readable:
            result.broken.append("the recording cannot be read")
    path.unlink(missing_ok=True)
    return result


def _break(fleet: Fleet, recording: Path, troubles: list[Trouble]) -> None:
    """Break what was drawn, and watch. Stalled processes continue when their time is over."""
    fleet.send_line("mark trouble")
    going_on: list[tuple[float, int]] = []
    for trouble in troubles:
        time.sleep(trouble.delay_s)
        victim, _, how = trouble.what.partition(" ")
        if how == "killed":
            fleet.processes[victim].kill()
        elif how == "stalled":
            with contextlib.suppress(ProcessLookupError):
                os.kill(fleet.processes[victim].pid, signal.SIGSTOP)
            going_on.append((time.monotonic() + trouble.stall_s, fleet.processes[victim].pid))
        elif how == "unplugged":
            fleet.send_line(f"unplug {victim}")
        else:
            _fill_disk(fleet.processes["host"].pid, recording)
    end_s = time.monotonic() + WATCHED_S
    for until_s, pid in sorted(going_on):
        time.sleep(max(until_s - time.monotonic(), 0.0))
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    time.sleep(max(end_s - time.monotonic(), 0.0))


def _fill_disk(pid: int, recording: Path) -> None:
    """Let the recorder write no more than a little, as on a full disk: every write beyond fails (limit of a file's size)."""
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        room = recording.stat().st_size + _ROOM_BYTES
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (room, resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]))


def _stop(fleet: Fleet, operator: Operator, result: ChaosRun) -> None:
    local = operator.session.local
    assert local is not None
    fleet.send_line("mark stop")
    paths = {"socket": lambda: stop_by_socket(local), "zenoh": operator.commander.stop_by_zenoh}
    answers = stop_over(paths, others_s=2.0)
    result.confirmed = any(answer.confirmed for answer in answers)
    result.answered = [answer.path for answer in answers if answer.answered]
    time.sleep(STOPPED_S)
    fleet.send_line("mark end")
    time.sleep(0.05)


def _judge(result: ChaosRun, summary: dict[str, Any]) -> None:
    intervals = {interval["name"]: interval for interval in summary.get("intervals", [])}
    if not {"trouble", "stop"} <= intervals.keys():
        result.broken.append("the simulated rig gave no summary")
        return
    trouble, stop = intervals["trouble"], intervals["stop"]
    result.peak_N = max(trouble["peak_force_N"], stop["peak_force_N"])
    result.rest_s, result.rest_after_stop_s = _rest_s(trouble), _rest_s(stop)
    result.force_left_N = stop["force_N"]
    if result.peak_N > LIMIT_N:
        result.broken.append(f"true force {result.peak_N:.3f} N, limit {LIMIT_N} N")
    if result.rest_after_stop_s is None:
        result.broken.append("the stages still moved at the end")
    if result.reachable and "socket" not in result.answered:
        result.broken.append("the stop socket did not answer")


def _rest_s(interval: dict[str, Any]) -> float | None:
    """Time from the beginning of an interval to its last step edge, s; None where the stages moved on."""
    if interval["last_edge_s"] is None:
        return 0.0
    if interval["end_s"] - interval["last_edge_s"] < QUIET_S:
        return None
    return float(interval["last_edge_s"] - interval["begin_s"])


def section(runs: list[ChaosRun], seed: int) -> str:
    """Return the section of docs/reliability.md on these runs."""
    done = [run for run in runs if run.contact]
    broken = [run for run in done if run.broken]
    peaks = [run.peak_N for run in done if run.peak_N is not None]
    lines = [
        "## Chaos on the wall clock",
        "",
        f"`make chaos RUNS={len(runs)} SEED={seed}`",
        "",
        f"In {len(runs)} runs the simulated rig, the model process and the realtime process were separate processes. "
        f"{len(done)} of them were in contact with the beating wall when one or two troubles drawn at random began. The rig "
        f"was watched for {WATCHED_S:g} s, and it was stopped over both paths. Forces are those of the plant, times "
        "those of the rig's clock.",
        "",
        f"Runs that broke a rule: **{len(broken)}**. Largest true force: {max(peaks, default=math.nan):.3f} N "
        f"(limit {LIMIT_N} N).",
        "",
        "| trouble (alone or with another) | runs | peak, N | at rest before the stop | time to rest, ms (median, longest) "
        "| stop confirmed | rest after the stop, ms (longest) | force left, N (largest) | recording readable |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for what in TROUBLES:
        some = [run for run in done if any(trouble.what == what for trouble in run.troubles)]
        if some:
            lines.append(_row(what, some))
    victim_words = ", ".join(f"{key}: {name}" for key, name in NAMES.items())
    lines += [
        "",
        f"- *{victim_words}*. Stalls last {STALL_S[0]:g} to {STALL_S[1]:g} s. *disk full*: every further write of the "
        "recorder fails (limit of a file's size).",
        "- *at rest before the stop*: runs whose stages came to rest by themselves; in the others the loop stayed in "
        "contact and followed the wall, until the stop.",
        "- *stop confirmed*: of the runs in which the realtime process was not killed. After it was killed, the board has "
        "stopped the stages, and a stop is reported as not confirmed.",
        "- A simulated rig that is killed leaves no data of its plant; `tests/host/test_wall_clock.py` covers this case.",
    ]
    if len(done) < len(runs):
        lines.append(
            f"- {len(runs) - len(done)} runs were not in contact at the trouble, on this machine, and are not in the table."
        )
    lines += ["", *(_broken_line(run) for run in broken)] if broken else ["", "No run broke a rule."]
    return "\n".join(lines)


def _row(what: str, some: list[ChaosRun]) -> str:
    rest_ms = [run.rest_s * 1e3 for run in some if run.rest_s is not None]
    stopped_ms = [run.rest_after_stop_s * 1e3 for run in some if run.rest_after_stop_s is not None]
    reachable = [run for run in some if run.reachable]
    victim, _, how = what.partition(" ")
    cells = [
        f"{NAMES.get(victim, victim)} {how}",
        str(len(some)),
        f"{max((run.peak_N for run in some if run.peak_N is not None), default=math.nan):.3f}",
        str(len(rest_ms)),
        f"{statistics.median(rest_ms):.0f}, {max(rest_ms):.0f}" if rest_ms else "",
        f"{sum(run.confirmed for run in reachable)} of {len(reachable)}" if reachable else "",
        f"{max(stopped_ms):.0f}" if stopped_ms else "",
        f"{max((run.force_left_N for run in some if run.force_left_N is not None), default=math.nan):.3f}",
        f"{sum(run.readable for run in some)} of {len(some)}",
    ]
    return f"| {' | '.join(cells)} |"


def _broken_line(run: ChaosRun) -> str:
    troubles = ", ".join(
        f"{trouble.what}{f' {trouble.stall_s:.2f} s' if 'stalled' in trouble.what else ''}" for trouble in run.troubles
    )
    return f"- run {run.number} ({troubles}): {'; '.join(run.broken)}"


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign. Exit status 1 where a run broke a rule or none reached contact."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.chaos", description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time; each has three processes")
    parser.add_argument("--docs", type=Path, help="page whose section is to be written again")
    parser.add_argument("--results", type=Path, help="file for one JSON line a run; finished runs in it are not repeated")
    options = parser.parse_args(arguments)
    runs = _finished(options.results)
    # Each run in a fresh process: nothing of one run is left to the next.
    fresh = multiprocessing.get_context("spawn").Pool(options.jobs, end_with_parent, maxtasksperchild=1)
    with tempfile.TemporaryDirectory(prefix="seldinger-chaos-") as folder, fresh as pool:
        settings = DemoSettings(board="native", directory=Path(folder), force_N=0.15)
        left = sorted(set(range(options.runs)) - {run.number for run in runs})
        one = functools.partial(run_once, seed=options.seed, settings=settings)
        for run in pool.imap_unordered(one, left):
            runs.append(run)
            print(_progress(run), file=sys.stderr, flush=True)
            if options.results is not None:
                with options.results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(run)) + "\n")
    runs.sort(key=lambda run: run.number)
    if options.docs is not None:
        write_section(options.docs, "chaos", section(runs, options.seed))
    print(section(runs, options.seed))
    broken = Counter(bool(run.broken) for run in runs if run.contact)
    return 0 if broken[False] and not broken[True] else 1


def _finished(results: Path | None) -> list[ChaosRun]:
    if results is None or not results.exists():
        return []
    found = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    return [ChaosRun(**{**one, "troubles": [Trouble(**trouble) for trouble in one["troubles"]]}) for one in found]


def _progress(run: ChaosRun) -> str:
    said = "; ".join(run.broken) if run.broken else "in order" if run.contact else f"no contact: {run.note}"
    peak = "" if run.peak_N is None else f", {run.peak_N:.3f} N"
    return f"seldinger: run {run.number}: {', '.join(trouble.what for trouble in run.troubles)}{peak}: {said}"


if __name__ == "__main__":
    sys.exit(main())
