"""`seldinger faults`: random faults in virtual time; what is found, how soon, and what the rig does about it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from host.cli.contract_io import write_json
from host.studies.faults.campaign import RunResult, by_fault, run_campaign, summary_of
from host.studies.faults.report import page_section
from host.studies.reliability_page import write_section
from protocol.errors import InputError
from sim.board import KINDS, BoardUnavailable
from sim.fault_table import FAULTS


def faults(
    runs: Annotated[int, typer.Option(help="How many.")] = 100,
    seed: Annotated[int, typer.Option(help="Decides every run.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    jobs: Annotated[int, typer.Option(help="Processes at a time.")] = min(os.cpu_count() or 1, 2),
    board: Annotated[str, typer.Option(help="avr (the ELF in simavr), native, or auto.")] = "native",
    fault: Annotated[list[str] | None, typer.Option(help="Only this one; may be given several times.")] = None,
    docs: Annotated[Path | None, typer.Option(help="Page whose section on faults is to be written anew.")] = None,
) -> None:
    """Inject faults into the job, in approach, contact and hold. Exit status 1 when a run broke a rule."""
    if not 1 <= runs <= 100_000:
        raise InputError("--runs", runs, "1 to 100000")
    if not 1 <= jobs <= 64:
        raise InputError("--jobs", jobs, "1 to 64")
    if seed < 0:
        raise InputError("--seed", seed, "0 or more")
    if board not in KINDS:
        raise InputError("--board", board, " or ".join(KINDS))
    for name in fault or ():
        if name not in {row.name for row in FAULTS}:
            raise InputError("--fault", name, "one of " + ", ".join(row.name for row in FAULTS))
    try:
        results = _with_progress(runs, seed, jobs, board, tuple(fault or ()))
    except (BoardUnavailable, RuntimeError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    bad = [result for result in results if result.violations]
    _tell(results, bad)
    if docs is not None:
        write_section(docs, "faults", page_section(results, seed, board))
    if json:
        write_json(
            {
                "runs": len(results),
                "seed": seed,
                "board": board,
                "by_fault": by_fault(results),
                "violations": [_broken(result) for result in bad],
            }
        )
    raise typer.Exit(1 if bad else 0)


def _broken(result: RunResult) -> dict[str, object]:
    plan = result.plan
    return {
        "run": plan.index,
        "fault": plan.fault,
        "phase": plan.phase,
        "size": plan.size,
        "seconds": plan.seconds,
        "says": list(result.violations),
    }


def _with_progress(runs: int, seed: int, jobs: int, board: str, names: tuple[str, ...]) -> list[RunResult]:
    columns = (TextColumn("faults"), BarColumn(bar_width=30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("faults", total=runs)
        return run_campaign(runs, seed, jobs, board, names, lambda done, total: bar.update(task, completed=done))


def _tell(results: list[RunResult], bad: list[RunResult]) -> None:
    """A row per fault, and every broken rule, on standard error."""
    console = Console(stderr=True, highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for heading in (
        "fault",
        "runs",
        "must be detected",
        "missed",
        "detected after, ms",
        "peak, N",
        "actions",
        "broken rules",
    ):
        table.add_column(heading, no_wrap=heading == "fault")
    for row in FAULTS:
        mine = [result for result in results if result.plan.fault == row.name]
        if not mine:
            continue
        s = summary_of(mine)
        times = "" if s["detection_ms_p50"] is None else f"{s['detection_ms_p50']:.0f} (99 %: {s['detection_ms_p99']:.0f})"
        table.add_row(
            row.name,
            str(s["runs"]),
            str(s["must_detect"]),
            str(s["missed"]),
            times,
            f"{s['peak_force_N']:.3f}",
            ", ".join(f"{name} {count}" for name, count in s["actions"].items()),
            str(s["violations"] or ""),
        )
    console.print(table)
    for result in bad:
        console.print(
            f"run {result.plan.index}, {result.plan.fault} in {result.plan.phase} ({result.plan.size:.3g}, "
            f"{result.plan.seconds:.2f} s): {'; '.join(result.violations)}",
            markup=False,
        )
    console.print(f"{len(results)} runs, {len(bad)} broke a rule")
