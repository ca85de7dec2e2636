"""`seldinger plan`: a collision-free, time-optimal path of the tip to a goal, from a JSON request (docs/navigation.md)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RequestFile, RigFile
from host.cli.progress import Working
from protocol.rig_file import SIMULATED_RIG


def plan(
    request: RequestFile,
    json: Json = False,
    rig: RigFile = SIMULATED_RIG,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, as `characterize` writes it.")] = None,
) -> None:
    """Plan a path of the tip past obstacles. Nothing moves. Exit status 1 where no path was found."""
    from host.commissioning.characterization import load_calibrated_rig
    from host.navigation import plan as search
    from host.navigation.request import read_plan_request

    loaded = load_calibrated_rig(rig, calibration)
    checked = read_plan_request(request)
    with Working("search for a path"):
        answer = search(checked, loaded, Path(".") if request == "-" else Path(request).parent)
    if answer is None:
        print(
            f"seldinger: no path found with {checked.samples} samples; try more samples or a smaller clearance_m",
            file=sys.stderr,
        )
        if json:
            write_json({"found": False})
        raise typer.Exit(1)
    print(
        f"{answer.time_s[-1]:.2f} s, {answer.waypoints} way points, least clearance {answer.clearance_m * 1e3:.2f} mm, "
        f"{answer.checks} collision checks",
        file=sys.stderr,
    )
    if json:
        write_json(answer.as_json())
