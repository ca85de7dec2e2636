"""`seldinger demo`: the main job on the simulated rig, with a progress line, a table, a recording and a report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from host.cli.contract_io import write_json
from host.recordings.recording import Recording
from host.report.demo_summary import demo_result, print_summary
from host.report.run_report import write_report
from host.run.demo import DemoRun, DemoSettings, exit_status, run_lockstep
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig
from sim.board import KINDS, BoardUnavailable
from sim.effects import parse

_SHARES = {"approach": (0.0, 0.15), "hold": (0.15, 0.97), "retract": (0.97, 1.0)}


def demo(
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    board: Annotated[str, typer.Option(help="avr (the ELF in simavr), native, or auto.")] = "auto",
    seed: Annotated[int, typer.Option(help="Of all noise and of the heart.")] = 1,
    force: Annotated[float, typer.Option(help="Contact force to hold, N.")] = 0.2,
    hold: Annotated[float, typer.Option(help="Seconds to hold it.")] = 20.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as it goes instead of at real time.")] = False,
    wall_clock: Annotated[bool, typer.Option("--wall-clock", help="As on a rig: processes, ptys, real time.")] = False,
    force_source: Annotated[str, typer.Option(help="What closes the force loop: sensor or estimate.")] = "sensor",
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    directory: Annotated[Path, typer.Option("--dir", help="Where recording and report go.")] = Path("runs"),
    effect: Annotated[
        list[str] | None, typer.Option(help="Plant an effect: ID@PORT, or ID@PORT:NAME=VALUE,start_s=VALUE.")
    ] = None,
) -> None:
    """Bring the tip from rest to a beating wall and hold a force on it."""
    settings = _settings(board, seed, force, hold, fast, force_source, rig, directory, tuple(effect or ()))
    try:
        run = _with_progress(settings, wall_clock)
    except BoardUnavailable as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError.from_sentence(str(error)) from None
    recording = Recording(run.recording)
    try:
        report = write_report(recording, run.recording.with_suffix(".html"))
    except OSError as error:
        print(f"seldinger: report {run.recording.with_suffix('.html')}: {error.strerror or error}", file=sys.stderr)
        raise typer.Exit(1) from None
    result = demo_result(recording, run, report)
    print_summary(result, run)
    if json:
        write_json(result)
    raise typer.Exit(exit_status(run, result["contact_seconds"] > 0))


def _settings(
    board: str,
    seed: int,
    force: float,
    hold: float,
    fast: bool,
    force_source: str,
    rig: Path,
    directory: Path,
    effects: tuple[str, ...],
) -> DemoSettings:
    if board not in KINDS:
        raise InputError("--board", board, " or ".join(KINDS))
    if force_source not in ("sensor", "estimate"):
        raise InputError("--force-source", force_source, "sensor or estimate")
    for text in effects:
        try:
            parse(text)
        except ValueError as error:
            found, _, wanted = str(error).partition(": found ")[2].partition(", wanted ")
            raise InputError(f"--effect {text}", found, wanted) from None
    limit = load_rig(rig).safety.over_force_N
    if not 0.02 <= force < limit:
        raise InputError("--force", force, f"at least 0.02 and below safety.over_force_N {limit} (N)")
    if not 1.0 <= hold <= 3600.0:
        raise InputError("--hold", hold, "1 to 3600 (s)")
    return DemoSettings(
        board=board,
        seed=seed,
        force_N=force,
        hold_s=hold,
        pace=0.0 if fast else 1.0,
        force_source=force_source,
        rig_file=rig,
        directory=directory,
        effects=effects,
    )


def _with_progress(settings: DemoSettings, wall_clock: bool) -> DemoRun:
    """Run with a line on standard error that says what goes on."""
    columns = (
        TextColumn("{task.description:<9}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[force]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("start", total=1.0, force="")

        def progress(phase: str, share: float, force_N: float) -> None:
            first, last = _SHARES.get(phase, (0.0, 0.0))
            bar.update(
                task, description=phase, completed=first + min(share, 1.0) * (last - first), force=f"{force_N:+.3f} N"
            )

        if wall_clock:
            from host.run.wall_clock import run_wall_clock

            return run_wall_clock(settings, progress)
        return run_lockstep(settings, progress)
