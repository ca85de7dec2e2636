"""`seldinger characterize`: sine sweeps of each stage, on a simulated or a real rig; a calibration with plots."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from host.cli.contract_io import write_json
from host.commissioning.characterization import (
    Characterization,
    calibrated_rig_text,
    record_simulated,
    standard_sweeps,
    transmission_toml,
)
from host.commissioning.characterization import (
    characterize as identify,
)
from host.commissioning.characterization_report import lines_of, write_characterization
from host.commissioning.rig_sweeps import PortNames, in_words, record_on_rig
from host.commissioning.sweep_fits import Estimate
from host.recordings.recording import Recording, new_recording_path
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig
from realtime.core.sweep import Sweep
from realtime.drivers.net_ft import RDT_PORT
from sim.board import KINDS, BoardUnavailable


def characterize(
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    recording: Annotated[Path | None, typer.Option(help="Identify from this recording of sweeps; nothing moves.")] = None,
    repeats: Annotated[int, typer.Option(help="Cycles of each sweep.")] = 5,
    seed: Annotated[int, typer.Option(help="Of all noise.")] = 1,
    board: Annotated[str, typer.Option(help="avr (the ELF in simavr), native, or auto.")] = "auto",
    directory: Annotated[Path, typer.Option("--dir", help="Where recording, calibration and page go.")] = Path("runs"),
    real: Annotated[bool, typer.Option("--real", help="Move the rig at the rig file's ports, not a simulated one.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --real: the tip hangs free, do not ask.")] = False,
    board_port: Annotated[str | None, typer.Option(help="With --real, instead of the rig file's.")] = None,
    tracker_port: Annotated[str | None, typer.Option(help="With --real, instead of the rig file's.")] = None,
    force_port: Annotated[int, typer.Option(help="With --real: UDP port of the force box.")] = RDT_PORT,
) -> None:
    """Characterize a rig in free space: backlash, slopes, dead zones, curves; write its calibration."""
    if board not in KINDS:
        raise InputError("--board", board, " or ".join(KINDS))
    if not 1 <= repeats <= 20:
        raise InputError("--repeats", repeats, "1 to 20")
    if real and recording is not None:
        raise InputError("--real", "with --recording", "one of them: a recording moves nothing")
    if not 1 <= force_port <= 65535:
        raise InputError("--force-port", force_port, "1 to 65535")
    ports, loaded = PortNames(board_port, tracker_port, force_port), load_rig(rig)
    try:
        if real:
            source = _record_on_rig(loaded, standard_sweeps(loaded, repeats), ports, yes, directory)
        else:
            source = recording or _record(loaded, repeats, seed, board, directory)
        found = identify(Recording(source), loaded)
    except InputError:
        raise
    except ValueError as error:
        key, _, rest = str(error).partition(": found ")
        what, _, wanted = rest.partition(", wanted ")
        raise InputError(key, what, wanted) from None
    except (BoardUnavailable, RuntimeError, OSError) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    result = _write(found, loaded, rig, source, directory)
    for line in lines_of(found):
        print(f"{line.name:<22} {line.value:>12}  {line.beside}", file=sys.stderr)
    print(
        f"calibration: {result['calibration']}\nrig file:    {result['rig_file']}\npage:        {result['report']}",
        file=sys.stderr,
    )
    if json:
        write_json(result)


def _record(rig: Rig, repeats: int, seed: int, board: str, directory: Path) -> Path:
    sweeps = standard_sweeps(rig, repeats)
    path = new_recording_path(directory, "characterize")
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("sweeps", total=1.0)
        return record_simulated(rig, sweeps, path, seed, board, lambda share: bar.update(task, completed=share))


def _record_on_rig(rig: Rig, sweeps: Sequence[Sweep], ports: PortNames, yes: bool, directory: Path) -> Path:
    """Asks first: sweeps swing the tip through free space, and the command cannot see what stands there."""
    print(f"seldinger: {in_words(sweeps)}", file=sys.stderr)
    if not yes and not sys.stdin.isatty():
        raise InputError("--yes", "missing", "it, or somebody at the terminal who says that the tip hangs free")
    if not (yes or typer.confirm("Does the catheter's tip hang free, nothing within its reach?", err=True)):
        print("seldinger: nothing was moved", file=sys.stderr)
        raise typer.Exit(1)
    path = new_recording_path(directory, "characterize")
    return record_on_rig(rig, sweeps, path, ports, lambda share: print(f"sweeps: {share:.0%}", file=sys.stderr, flush=True))


def _write(found: Characterization, rig: Rig, rig_file: Path, source: Path, directory: Path) -> dict[str, Any]:
    """Calibration, rig file with it (checked by reading it back) and page, beside one another."""
    import tomllib

    directory.mkdir(parents=True, exist_ok=True)
    section = transmission_toml(found)
    text = calibrated_rig_text(rig_file.read_text(encoding="utf-8"), section)
    parse_rig(tomllib.loads(text), "calibrated rig")
    stem = directory / source.stem
    calibration, whole = stem.with_suffix(".calibration.toml"), stem.with_suffix(".rig.toml")
    calibration.write_text(section, encoding="utf-8")
    whole.write_text(text, encoding="utf-8")
    page = write_characterization(found, stem.with_suffix(".html"), rig.name, source.name)

    def told(value: Estimate, scale: float = 1.0) -> dict[str, Any]:
        return {"value": value.value * scale, "ci95": [value.low * scale, value.high * scale]}

    names = ("knob_lower_stop_rad", "knob_slack_from_rad", "knob_slack_to_rad", "knob_upper_stop_rad")
    return {
        "catheter": found.catheter,
        "insertion_backlash_m": told(found.insertion.width),
        "insertion_slope": told(found.insertion.slope),
        "insertion_at_home_m": told(found.insertion_at_home_m),
        "roll_slope": told(found.roll.slope),
        "roll_backlash_rad": told(found.roll_backlash_rad),
        **{name: told(edge) for name, edge in zip(names, found.knob.edges_rad, strict=True)},
        "knob_gain_per_m_rad": [told(gain) for gain in found.knob.gains_per_m_rad],
        "tracker_noise_m": found.insertion.noise,
        "roll_noise_deg": math.degrees(found.roll.noise),
        "calibration": str(calibration),
        "rig_file": str(whole),
        "report": str(page),
        "recording": str(source),
    }
