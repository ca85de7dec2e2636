"""`seldinger experiment SCRIPT`: the script of a diagnosis, checked and shown; it moves only with --go or --simulated."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from host.cli.contract_io import write_json
from host.commissioning.experiment_script import Path3D, Script, check_script, read_script
from host.run.experiment_run import run_live, run_simulated
from protocol.errors import InputError
from protocol.rig_file import AXES, SIMULATED_RIG, Rig, load_rig


def experiment(
    script: Annotated[Path, typer.Argument(help="Script (TOML), as `seldinger diagnose --out` writes it.")],
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    go: Annotated[bool, typer.Option("--go", help="Command the running rig: take the lease, arm, move.")] = False,
    simulated: Annotated[bool, typer.Option("--simulated", help="Run it in virtual time on the simulated rig.")] = False,
    effect: Annotated[list[str] | None, typer.Option(help="With --simulated: plant an effect, as in `demo`.")] = None,
    board: Annotated[str, typer.Option(help="With --simulated: avr, native, or auto.")] = "auto",
    seed: Annotated[int, typer.Option(help="With --simulated: of all noise.")] = 1,
    directory: Annotated[Path, typer.Option("--dir", help="With --simulated: where the recording goes.")] = Path("runs"),
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Check a script against the rig's limits and show what it does; with --go or --simulated, do it."""
    if go and simulated:
        raise InputError("--go", "both --go and --simulated", "one of them")
    loaded, wanted = load_rig(rig), read_script(script)
    path = check_script(wanted, loaded)
    show(wanted, path, loaded)
    result: dict[str, Any] = {"script": str(script), "good": True, "seconds": path.seconds, "recording": None}
    if not (go or simulated):
        print("nothing was moved: --go commands the running rig, --simulated runs it in virtual time", file=sys.stderr)
    try:
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("experiment", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if simulated:
                recording = run_simulated(wanted, loaded, directory, board, seed, tuple(effect or ()), progress)
                result["recording"] = str(recording)
                print(f"recording: {recording}", file=sys.stderr)
            elif go:
                run_live(wanted, loaded, progress)
    except RuntimeError as error:
        print(f"seldinger: experiment: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if json:
        write_json(result)


def show(script: Script, path: Path3D, rig: Rig) -> None:
    """What the script does, on standard error."""
    ends = zip("xyz", 1e3 * path.low_m, 1e3 * path.high_m, strict=True)
    box = ", ".join(f"{axis} {low:.1f} to {high:.1f}" for axis, low, high in ends)
    rows = [
        script.says,
        f"{script.motion} motion, {len(script.rows)} commands in {path.seconds:.0f} s",
        f"tip (mm): {box}; fastest {1e3 * path.fastest_m_per_s:.1f} mm/s",
    ]
    for axis, name in enumerate(AXES):
        low, high = path.travel[name]
        rows.append(f"{name}: {low:.4g} to {high:.4g} of {rig.stage(axis).min_unit} to {rig.stage(axis).max_unit}")
    if script.motion == "contact":
        rows.append(f"force: {path.forces_N[0]:.3g} to {path.forces_N[1]:.3g} N, over-force at {rig.safety.over_force_N} N")
    print("\n".join(rows), file=sys.stderr)
