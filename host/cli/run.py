"""`seldinger run PROTOCOL.toml`: a scripted experiment on the running rig or in the simulator, with a report."""

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
    writable_file,
    writable_folder,
)
from host.cli.progress import Progress
from protocol.errors import Description, InputError, one_of
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig

if TYPE_CHECKING:
    from host.run.protocol_file import DryRun, ScriptedProtocol
    from host.run.protocol_result import ProtocolResult
    from host.run.protocol_run import Job


def run(
    protocol: Annotated[Path, typer.Argument(help="Protocol (TOML), see docs/protocols.md.")],
    rig: RigFile = SIMULATED_RIG,
    simulated: Annotated[bool, typer.Option("--simulated", help="Run it in virtual time on the simulated rig.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the protocol against the rig's limits; nothing moves.")
    ] = False,
    resume: Annotated[Path | None, typer.Option(help="Result (JSON) of an earlier run to continue.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the rig moves, nor at steps that wait.")] = False,
    effect: Annotated[list[str] | None, typer.Option(help="With --simulated: effect to plant, as in `demo`.")] = None,
    board: Board = "auto",
    seed: Seed = 1,
    directory: Folder = Path("runs"),
    json: Json = False,
) -> None:
    """Run a protocol: go to points, touch, follow a line on the wall, wait. Exit status 1 if a step failed or is off."""
    one_of("--board", board, BOARDS)
    checked_seed(seed)
    effects = checked_effects(effect)
    if not (dry_run or simulated or yes or sys.stdin.isatty()):
        raise InputError(
            "--yes", Description("nothing"), "--yes without a terminal, because the protocol moves the catheter"
        )
    loaded = load_rig(rig)
    if not dry_run:
        writable_folder("--out", directory)
    # Loaded after the checks: models take seconds.
    from host.report.protocol_report import write_protocol_report
    from host.run import protocol_file, protocol_result, protocol_run

    steps = protocol_file.read_protocol(protocol, loaded)
    try:
        checked = protocol_file.dry_run(steps, loaded)
    except InputError as error:
        raise error.in_file(protocol) from None
    earlier = () if resume is None else protocol_result.read_result(resume, steps, loaded.name, simulated)
    if resume is not None and not dry_run:
        writable_file("--resume", resume)
    _show(steps, checked, loaded)
    if dry_run:
        if json:
            planned = {"actions": len(steps.actions), "seconds": checked.seconds}
            write_json({"protocol": steps.file.name, "good": True, **planned})
        return
    target = resume or protocol_result.new_result_path(directory)
    job = protocol_run.Job(steps, loaded, target, earlier)
    try:
        result = _carry_out(job, simulated, yes, directory, board, seed, effects)
    except RuntimeError as error:
        print(f"seldinger: run: {error}", file=sys.stderr)
        _print_resume(target)
        raise typer.Exit(1) from None
    except BaseException:  # Ctrl-C, a full disk, ...: said by the command line
        _print_resume(target)
        raise
    _print_result(result, target)
    report = write_protocol_report(result.as_json(), target.with_suffix(".html"))
    print(f"report     {report}", file=sys.stderr)
    if json:
        write_json({**result.as_json(), "result": str(target), "report": str(report)})
    if not result.good:
        raise typer.Exit(1)


def _carry_out(
    job: Job, simulated: bool, yes: bool, directory: Path, board: str, seed: int, effects: tuple[str, ...]
) -> ProtocolResult:
    from host.run import protocol_rigs

    with Progress() as bar:
        if simulated:
            from host.estimation.service import EstimationService, load_estimator
            from host.run.demo import DemoSettings

            estimator = EstimationService(load_estimator(DemoSettings().estimator, job.rig))
            return protocol_rigs.run_simulated(job, directory, board, seed, effects, estimator, bar)
        if not yes:
            typer.confirm("The catheter will move. Is a hand at the emergency stop?", abort=True, err=True)
        return protocol_rigs.run_live(job, lambda message: yes or typer.confirm(f"\n{message} Continue?", err=True), bar)


def _show(steps: ScriptedProtocol, checked: DryRun, rig: Rig) -> None:
    """Print the motion, forces and duration of the protocol."""
    ends = zip("xyz", 1e3 * checked.low_m, 1e3 * checked.high_m, strict=True)
    rows = [
        f"{steps.file.name}: {len(steps.file.steps)} steps, {len(steps.actions)} actions, about {checked.seconds:.0f} s",
        "tip (mm): " + ", ".join(f"{axis} {low:.1f} to {high:.1f}" for axis, low, high in ends),
    ]
    for axis, (name, (low, high)) in enumerate(checked.travel.items()):
        rows.append(f"{name}: {low:.4g} to {high:.4g} of {rig.stage(axis).min_unit} to {rig.stage(axis).max_unit}")
    if checked.forces_N:
        rows.append(
            f"force: {min(checked.forces_N):.3g} to {max(checked.forces_N):.3g} N, over-force at {rig.safety.over_force_N} N"
        )
    print("\n".join(rows), file=sys.stderr)


def _print_resume(target: Path) -> None:
    """Say how a protocol that ended early is continued, if anything of it was written."""
    if target.exists():
        print(f"to continue: the same command with --resume {target}", file=sys.stderr)


def _print_result(result: ProtocolResult, target: Path) -> None:
    """Print a line for each action, and the paths of the files."""
    for item in result.results:
        touch = item.touch
        figures = ""
        if touch is not None:
            figures = (
                f"  mean {touch.mean_force_N:.3f} N, integral {touch.force_time_integral_Ns:.2f} N s, "
                f"loss {100 * touch.contact_loss_share:.0f} %, "
                + ("no pose" if touch.tip_error_m is None else f"tip {1e3 * touch.tip_error_m:.2f} mm off")
            )
        print(f"{item.id:>6}  {item.kind:<6}{item.verdict:<17}{figures or '  ' + item.says}", file=sys.stderr)
    if result.ended:
        print(f"ended at {result.ended}", file=sys.stderr)
        _print_resume(target)
    for recording in result.recordings:
        print(f"recording  {recording}", file=sys.stderr)
    print(f"result     {target}", file=sys.stderr)
