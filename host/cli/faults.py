"""`seldinger faults`: random faults in virtual time; which are detected, after which time, and how the rig reacts."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import (
    BOARDS,
    Board,
    Docs,
    Jobs,
    Json,
    Seed,
    checked_jobs,
    checked_seed,
    within,
    writable_file,
    writable_folder,
)
from host.cli.progress import Progress
from protocol.errors import one_of

if TYPE_CHECKING:
    from host.studies.faults.campaign import RunResult


def faults(
    runs: Annotated[int, typer.Option(help="Number of runs.")] = 100,
    seed: Seed = 1,
    json: Json = False,
    jobs: Jobs = 0,
    board: Board = "native",
    fault: Annotated[
        list[str] | None, typer.Option(help="Fault to inject; may be given several times. Default: all.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for finished runs; the same call goes on where it was stopped.")
    ] = None,
    docs: Docs = None,
) -> None:
    """Inject faults in approach, contact and hold. Exit status 1 when a run broke a rule."""
    from host.studies.faults.campaign import by_fault, plan_runs, run_campaign
    from host.studies.faults.finished import FinishedRuns
    from host.studies.faults.report import page_section
    from host.studies.reliability_page import write_section
    from sim.board import BoardUnavailable
    from sim.fault_table import FAULTS

    within("--runs", runs, 1, 100_000)
    processes = checked_jobs(jobs)
    checked_seed(seed)
    one_of("--board", board, BOARDS)
    for name in fault or ():
        one_of("--fault", name, [row.name for row in FAULTS])
    if docs is not None:
        writable_file("--docs", docs)
    names = tuple(fault or ())
    kept = None
    if out is not None:
        settings = {"runs": runs, "seed": seed, "board": board, "faults": list(names)}
        kept = FinishedRuns(writable_folder("--out", out), settings, plan_runs(runs, seed, names))
    try:
        with Progress() as bar:

            def progress(result: RunResult, done: int) -> None:
                if kept is not None:
                    kept.add(result)
                bar("faults", done / runs, f"{done}/{runs}")

            results = run_campaign(runs, seed, processes, board, names, kept.results if kept else (), progress)
    except (BoardUnavailable, RuntimeError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    bad = [result for result in results if result.violations]
    _print_table(results, bad)
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


def _print_table(results: list[RunResult], bad: list[RunResult]) -> None:
    """Print a row for each fault, and every broken rule, on standard error."""
    from rich.console import Console
    from rich.table import Table

    from host.studies.faults.campaign import summary_of
    from sim.fault_table import FAULTS

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
