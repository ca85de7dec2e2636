"""`seldinger home AXIS --rig FILE`: creep to the axis' switch and set the position there to the rig file's."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile, one_of
from host.cli.progress import Working
from protocol.rig_file import AXES, load_rig


def home(
    axis: Annotated[str, typer.Argument(help="insertion, roll or knob.")],
    rig: RigFile,
    port: Annotated[str, typer.Option(help="Serial port of the board, instead of the rig file's.")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before it moves.")] = False,
    json: Json = False,
) -> None:
    """Find the axis' home switch. The stage MOVES: nothing in the clamp, a hand at the emergency stop."""
    from host.commissioning.home_stage import home_of, home_stage
    from realtime.drivers.homing import HomingFailed

    one_of("axis", axis, AXES)
    settings = load_rig(rig)
    wanted = home_of(settings, AXES.index(axis))
    stage, unit = settings.stage(wanted.axis), "m" if axis == "insertion" else "rad"
    if not yes:
        typer.confirm(
            f"{axis} will creep to its {stage.home_end} switch. Is the clamp empty, and a hand at the emergency stop?",
            abort=True,
            err=True,
        )
    try:
        with Working(f"{axis} creeps to its switch"):
            homing = home_stage(settings, wanted, port or settings.board.port)
    except (OSError, HomingFailed) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    print(
        f"{axis}: switch found, its position is {stage.home_unit:g} {unit}; two touches differ by "
        f"{homing.difference_steps} steps; the board is disarmed, the stage stands next to the switch",
        file=sys.stderr,
    )
    if json:
        write_json(
            {"axis": axis, "end": stage.home_end, "home_unit": stage.home_unit, "difference_steps": homing.difference_steps}
        )
