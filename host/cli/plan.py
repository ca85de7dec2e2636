"""`seldinger plan`: a collision-free, time-optimal way of the tip to a goal, from a JSON request (docs/navigation.md)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.commissioning.characterization import load_calibrated_rig
from protocol.requests import read_json, validate
from protocol.rig_file import SIMULATED_RIG


def plan(
    request: Annotated[str, typer.Argument(help="the request: a JSON file, or - for standard input")],
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, as `characterize` writes it.")] = None,
) -> None:
    """Plan a way of the tip past obstacles. Nothing moves. Status 1 where no way was found."""
    from host.navigation import PlanRequest
    from host.navigation import plan as search

    loaded = load_calibrated_rig(rig, calibration)
    checked = validate(PlanRequest, _with_tuples(read_json(request)))
    answer = search(checked, loaded, Path(".") if request == "-" else Path(request).parent)
    if answer is None:
        print(
            f"seldinger: no way found in {checked.samples} samples; more samples or less clearance_m may find one",
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


def _with_tuples(value: Any) -> Any:
    """Lists of three numbers become tuples, as strict checking of points wants them."""
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        items = [_with_tuples(item) for item in value]
        if len(items) == 3 and all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in items):
            return tuple(float(item) for item in items)
        return items
    return value
