"""`seldinger experiment SCRIPT`: the script of a diagnosis, checked and shown; it moves only with --go or --simulated."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    writable_folder,
)
from host.cli.progress import share_bar
from protocol.errors import InputError, one_of
from protocol.rig_file import AXES, SIMULATED_RIG, Rig, load_rig

if TYPE_CHECKING:
    from host.commissioning.experiment_script import Path3D, Script


def experiment(
    script: Annotated[Path, typer.Argument(help="Script (TOML), as `seldinger diagnose --out` writes it.")],
    rig: RigFile = SIMULATED_RIG,
    go: Annotated[bool, typer.Option("--go", help="Run it on the running rig: take the lease, arm, move.")] = False,
    simulated: Annotated[bool, typer.Option("--simulated", help="Run it in virtual time on the simulated rig.")] = False,
    effect: Annotated[list[str] | None, typer.Option(help="With --simulated: effect to plant, as in `demo`.")] = None,
    board: Board = "auto",
    seed: Seed = 1,
    directory: Folder = Path("runs"),
    json: Json = False,
) -> None:
    """Check a script against the rig's limits and show its motion; with --go or --simulated, run it."""
    from host.commissioning.experiment_script import check_script, read_script
    from host.run.experiment_run import run_live, run_simulated

    if go and simulated:
        raise InputError("--go", "both --go and --simulated", "one of them")
    one_of("--board", board, BOARDS)
    checked_seed(seed)
    effects = checked_effects(effect)
    loaded, wanted = load_rig(rig), read_script(script)
    path = check_script(wanted, loaded)
    show(wanted, path, loaded)
    result: dict[str, Any] = {"script": str(script), "good": True, "seconds": path.seconds, "recording": None}
    if not (go or simulated):
        print(
            "nothing has moved: --go runs the script on the running rig, --simulated runs it in virtual time",
            file=sys.stderr,
        )
    if simulated:
        writable_folder("--out", directory)
    try:
        with share_bar("experiment") as progress:
            if simulated:
                recording = run_simulated(wanted, loaded, directory, board, seed, effects, progress)
                result["recording"] = str(recording)
            elif go:
                run_live(wanted, loaded, progress)
    except RuntimeError as error:
        print(f"seldinger: experiment: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if result["recording"]:
        print(f"recording: {result['recording']}", file=sys.stderr)
    if json:
        write_json(result)


def show(script: Script, path: Path3D, rig: Rig) -> None:
    """Print what the script does, on standard error."""
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
