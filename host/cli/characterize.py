"""`seldinger characterize`: sine sweeps of each stage, on a simulated or a real rig; a calibration with plots."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import BOARDS, Board, Folder, Json, RigFile, Seed, checked_seed, within, writable_folder
from host.cli.progress import share_bar
from host.cli.recordings import open_recording
from protocol.errors import Description, InputError, one_of
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig

if TYPE_CHECKING:
    from host.commissioning.rig_sweeps import PortNames


def characterize(
    json: Json = False,
    rig: RigFile = SIMULATED_RIG,
    recording: Annotated[Path | None, typer.Option(help="Identify from this recording of sweeps; nothing moves.")] = None,
    repeats: Annotated[int, typer.Option(help="Number of cycles of each sweep.")] = 5,
    seed: Seed = 1,
    board: Board = "auto",
    directory: Folder = Path("runs"),
    real: Annotated[
        bool, typer.Option("--real", help="Move the rig at the ports of the rig file instead of a simulated one.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --real: do not ask whether the tip hangs free.")] = False,
    board_port: Annotated[str | None, typer.Option(help="With --real: port to use instead of the rig file's.")] = None,
    tracker_port: Annotated[str | None, typer.Option(help="With --real: port to use instead of the rig file's.")] = None,
    force_port: Annotated[int, typer.Option(help="With --real: UDP port of the force box.", hidden=True)] = 49152,
) -> None:
    """Characterize a rig in free space: backlash, slopes, dead zones, curves; write its calibration."""
    from host.commissioning.calibration_files import write_calibration
    from host.commissioning.characterization import characterize as identify
    from host.commissioning.rig_sweeps import PortNames
    from host.recordings.recording import RecordingFile
    from realtime.core.sweep_ports import check_served
    from sim.board import BoardUnavailable

    one_of("--board", board, BOARDS)
    within("--repeats", repeats, 1, 20)
    within("--force-port", force_port, 1, 65535)
    checked_seed(seed)
    if real and recording is not None:
        raise InputError("--real", "with --recording", "one of them; a recording needs no motion")
    for option, port in (("--board-port", board_port), ("--tracker-port", tracker_port)):
        if port is not None and not real:
            raise InputError(option, port, "--real with it: without, a simulated rig is characterized")
    if yes and not real:
        raise InputError("--yes", Description("it alone"), "--real with it: without, a simulated rig is characterized")
    loaded = load_rig(rig)
    if real:
        check_served(loaded)
    if real and not (yes or sys.stdin.isatty()):
        raise InputError(
            "--yes", Description("nothing"), "a terminal, or --yes once the tip hangs free, because the catheter will move"
        )
    opened = None if recording is None else open_recording(recording)
    writable_folder("--out", directory)
    try:
        if real:
            source = _record_on_rig(loaded, repeats, PortNames(board_port, tracker_port, force_port), yes, directory)
        else:
            source = recording or _record_simulated(loaded, repeats, seed, board, directory)
        found = identify(opened or RecordingFile(source), loaded)
    except (BoardUnavailable, RuntimeError, OSError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    files = write_calibration(found, loaded, rig, source, directory)
    for line in files.lines:
        print(f"{line.name:<22} {line.value:>12}  {line.note}", file=sys.stderr)
    print(
        f"calibration: {files.calibration}\nrig file:    {files.rig_file}\npage:        {files.page}",
        file=sys.stderr,
    )
    if json:
        write_json(files.report)


def _record_simulated(rig: Rig, repeats: int, seed: int, board: str, directory: Path) -> Path:
    from host.commissioning.characterization import record_simulated, standard_sweeps
    from host.recordings.writer import new_recording_path

    sweeps, path = standard_sweeps(rig, repeats), new_recording_path(directory, "characterize")
    with share_bar("sweeps") as progress:
        return record_simulated(rig, sweeps, path, seed, board, progress)


def _record_on_rig(rig: Rig, repeats: int, ports: PortNames, yes: bool, directory: Path) -> Path:
    """Ask before the stages move: sweeps swing the tip through free space, and the command cannot detect obstacles there."""
    from host.commissioning.characterization import standard_sweeps
    from host.commissioning.rig_sweeps import describe, record_on_rig
    from host.recordings.writer import new_recording_path

    sweeps = standard_sweeps(rig, repeats)
    print(f"seldinger: {describe(sweeps)}", file=sys.stderr)
    if not (
        yes or typer.confirm("The catheter will move. Does its tip hang free, with nothing within its reach?", err=True)
    ):
        print("seldinger: nothing has moved", file=sys.stderr)
        raise typer.Exit(1)
    path = new_recording_path(directory, "characterize")
    return record_on_rig(rig, sweeps, path, ports, lambda share: print(f"sweeps: {share:.0%}", file=sys.stderr, flush=True))
