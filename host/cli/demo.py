"""`seldinger demo`: the main task on the simulated rig, with a progress line, a table, a recording and a report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import (
    BOARDS,
    Board,
    Folder,
    Json,
    RigFile,
    Seed,
    checked_effects,
    checked_seed,
    within,
    writable_folder,
)
from host.cli.progress import Progress
from protocol.errors import Description, InputError, one_of
from protocol.rig_file import SIMULATED_RIG, load_rig

if TYPE_CHECKING:
    from host.run.demo import DemoRun, DemoSettings

_SHARES = {"approach": (0.0, 0.15), "hold": (0.15, 0.97), "retract": (0.97, 1.0)}


def demo(
    json: Json = False,
    board: Board = "auto",
    seed: Seed = 1,
    force: Annotated[float, typer.Option(help="Contact force to hold, N.")] = 0.2,
    hold: Annotated[float, typer.Option(help="Time to hold the force, s.")] = 20.0,
    fast: Annotated[bool, typer.Option("--fast", help="Run as fast as possible instead of in real time.")] = False,
    wall_clock: Annotated[
        bool, typer.Option("--wall-clock", help="Run every part as a process in real time, as on a rig.")
    ] = False,
    force_source: Annotated[str, typer.Option(help="Force that the loop controls: sensor or estimate.")] = "sensor",
    rig: RigFile = SIMULATED_RIG,
    directory: Folder = Path("runs"),
    effect: Annotated[
        list[str] | None,
        typer.Option(help="Effect to plant in the simulated rig: ID@PORT, or ID@PORT:NAME=VALUE,start_s=VALUE."),
    ] = None,
) -> None:
    """Bring the tip from rest to a beating wall and hold a force on it."""
    from host.recordings.recording import RecordingFile
    from host.report.demo_summary import demo_result, print_summary
    from host.report.run_report import write_report
    from host.run.demo import DemoSettings, exit_status
    from realtime.core.lines import tracker_config
    from sim.board import BoardUnavailable

    one_of("--board", board, BOARDS)
    one_of("--force-source", force_source, ("sensor", "estimate"))
    checked_seed(seed)
    effects = checked_effects(effect)
    read = load_rig(rig)
    tracker_config(read)  # reads the files that it names
    limit_N = read.safety.over_force_N
    if not 0.02 <= force < limit_N:
        raise InputError("--force", force, f"at least 0.02 and below safety.over_force_N {limit_N} (N)")
    within("--hold", hold, 1.0, 3600.0, "s")
    if fast and wall_clock:
        raise InputError("--fast", Description("--wall-clock, too"), "one of them: the wall clock cannot go faster")
    writable_folder("--out", directory)
    settings = DemoSettings(
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
    try:
        run = _with_progress(settings, wall_clock)
    except BoardUnavailable as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError.from_sentence(str(error)) from None
    recording = RecordingFile(run.recording)
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


def _with_progress(settings: DemoSettings, wall_clock: bool) -> DemoRun:
    """Run with a progress line on standard error."""
    from host.run.demo import run_lockstep
    from host.run.wall_clock import run_wall_clock

    with Progress() as bar:

        def progress(phase: str, share: float, force_N: float) -> None:
            first, last = _SHARES.get(phase, (0.0, 0.0))
            bar(phase, first + min(share, 1.0) * (last - first), f"{force_N:+.3f} N")

        return (run_wall_clock if wall_clock else run_lockstep)(settings, progress)
