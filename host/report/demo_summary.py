"""How a demo went: the JSON that `seldinger demo --json` prints, from the recording, and a short table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from host.recordings.recording import RecordingFile
from host.report.run_report import duration, lateness_of, quantity, verdict_of
from host.report.run_summary import RunSummary, summarize


class FinishedRun(Protocol):
    """Information on a run that its recording does not contain: its end, and the counters of loop and board."""

    @property
    def recording(self) -> Path:
        """Return the path of the recording."""

    @property
    def outcome(self) -> Any:
        """Return the end of the scenario (`sim.scenario.Outcome`)."""

    @property
    def counts(self) -> Mapping[str, Any]:
        """Return the counters of the loop and the board, by name."""

    @property
    def interrupted(self) -> str:
        """Return the name of the signal that ended the run, empty if none did."""


def demo_result(recording: RecordingFile, run: FinishedRun, report: Path) -> dict[str, Any]:
    """Return the object of `seldinger demo --json`.

    Forces, tip and timing come from the recording. `run.counts` adds what happened between two recorded board messages
    (faults, crc_errors, underruns: the worse of both is given); `run.outcome` the steps, where there are pins to count.
    """
    summary, counts = summarize(recording), run.counts
    ticks, board = summary.ticks, summary.board
    result: dict[str, Any] = {
        "target_force_N": summary.target_force_N,
        "force_rms_error_N": summary.force_rms_error_N,
        "force_peak_N": summary.force_peak_N,
        "tip_rms_error_m": summary.tip_rms_error_m,
        "contact_seconds": summary.contact_seconds,
        "loop_hz": _whole(ticks.loop_hz),
        "tick_us": {"p50": ticks.p50_us, "p99": ticks.p99_us, "p999": ticks.p999_us, "max": ticks.max_us},
        "missed_ticks": max(ticks.missed, int(counts.get("missed_ticks", 0))),
        "firmware": {
            "faults": list(dict.fromkeys([*board.faults, *map(str, counts.get("faults", []))])),
            "crc_errors": max(board.crc_errors, int(counts.get("crc_errors", 0))),
            "underruns": max(board.underruns, int(counts.get("underruns", 0))),
        },
        "recording": str(recording.path),
        "report": str(report),
        "force_mean_N": summary.force_mean_N,
        "worst_safety_action": summary.worst_action,
        "verdict": verdict_of(summary).level,
        "interrupted": run.interrupted,
    }
    steps = {name: list(map(int, getattr(run.outcome, f"steps_{name}"))) for name in ("commanded", "on_pins", "reported")}
    if steps["on_pins"]:
        result["steps"] = steps
    if counts.get("digest"):
        result["digest"] = str(counts["digest"])
    return result


def _whole(value: float) -> float | int:
    return int(value) if math.isfinite(value) and value == int(value) else value


def print_summary(result: dict[str, Any], run: FinishedRun, console: Console | None = None) -> None:
    """Print verdict, a short table, and the paths of recording and report, on standard error."""
    console = console or Console(stderr=True, highlight=False)
    summary = summarize(RecordingFile(run.recording))
    verdict = verdict_of(summary)
    colour = {"good": "green", "fair": "yellow", "bad": "red"}[verdict.level]
    console.print(f"\n[bold {colour}]{verdict.sentence}[/]", markup=True)
    if verdict.remedy:
        console.print(f"  {verdict.remedy}", markup=False)
    for remark in verdict.followed or verdict.remarks:
        console.print(f"  {remark}", markup=False, style="dim" if verdict.followed else None)
    for note in run.outcome.notes:
        console.print(f"  {note}", markup=False, soft_wrap=True)
    if run.interrupted:
        console.print(f"  Ended early by {run.interrupted}.")
    console.print(_table(result, summary))
    for name in ("recording", "report"):
        console.print(f"{name:>10}  {result[name]}", soft_wrap=True, markup=False)


def _table(result: dict[str, Any], summary: RunSummary) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    firmware, ticks = result["firmware"], summary.ticks
    rows = [
        (
            "mean force",
            quantity(result["force_mean_N"], "N", 3),
            f"{summary.judged_over}; set-point {quantity(result['target_force_N'], 'N', 2)}",
        ),
        ("RMS force error", quantity(result["force_rms_error_N"], "N", 3), summary.judged_over),
        ("peak force", quantity(result["force_peak_N"], "N", 3), f"limit {quantity(summary.force_limit_N, 'N', 2)}"),
        ("tip error across the normal", quantity(result["tip_rms_error_m"] * 1e3, "mm", 2), "RMS, tracker noise included"),
        ("in contact", quantity(result["contact_seconds"], "s", 1), ""),
        (
            "tick",
            duration(ticks.p50_us),
            f"99.9 %: {duration(ticks.p999_us)}, longest {duration(ticks.max_us)}, {lateness_of(summary)}",
        ),
        (
            "firmware",
            ", ".join(firmware["faults"]) or "no fault",
            f"{firmware['crc_errors']} damaged frames, {firmware['underruns']} underruns",
        ),
    ]
    if "steps" in result:
        agree = len({tuple(steps) for steps in result["steps"].values()}) == 1
        shown = ", ".join(map(str, result["steps"]["on_pins"]))
        rows.append(
            (
                "steps at the end",
                "agree" if agree else "differ",
                f"on the pins: {shown}"
                if agree
                else "; ".join(f"{name.replace('_', ' ')} {steps}" for name, steps in result["steps"].items()),
            )
        )
    if ticks.longest_gap_ns:
        rows.append(("longest gap", f"{ticks.longest_gap_ns * 1e-6:.1f} ms", ticks.longest_gap_where))
    for row in rows:
        table.add_row(*map(escape, row))
    table.columns[0].style, table.columns[2].style = "dim", "dim"
    return table
