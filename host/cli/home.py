"""`seldinger home AXIS --rig FILE`: creep to the axis' switch and give the place there its position from the rig file."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from protocol.errors import InputError
from protocol.rig_file import Rig, load_rig
from protocol.serial_frames import AXES
from realtime.core.board_intake import axis_limits
from realtime.drivers.homing import Home, Homing, HomingFailed, homing_limits
from realtime.drivers.stepper_board import StepperBoardLink
from realtime.drivers.transport import Transport, open_serial

_POLL_S = 0.001


def home(
    axis: Annotated[str, typer.Argument(help="insertion, roll or knob.")],
    rig: Annotated[Path, typer.Option(help="Rig file; its stages.AXIS.home_end says which switch.")],
    port: Annotated[str, typer.Option(help="Serial port, in the place of the rig file's.")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before it moves.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Find the axis' home switch. The stage MOVES: nothing in the clamp, a hand at the emergency stop."""
    if axis not in AXES:
        raise InputError("axis", axis, " or ".join(AXES))
    settings = load_rig(rig)
    wanted = home_of(settings, AXES.index(axis))
    stage, unit = settings.stage(wanted.axis), "m" if axis == "insertion" else "rad"
    if not yes:
        typer.confirm(
            f"{axis} will creep to its {stage.home_end} switch. Nothing clamped, a hand at the emergency stop?",
            abort=True,
            err=True,
        )
    try:
        homing = _run(settings, wanted, port or settings.board.port)
    except (OSError, HomingFailed) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    print(
        f"{axis}: switch found, called {stage.home_unit:g} {unit}; touched twice, {homing.difference_steps} steps apart; "
        "disarmed beside it",
        file=sys.stderr,
    )
    if json:
        write_json(
            {"axis": axis, "end": stage.home_end, "home_unit": stage.home_unit, "difference_steps": homing.difference_steps}
        )


def home_of(rig: Rig, axis: int) -> Home:
    """What the rig file says of the home of `axis`, in steps. Raises InputError where it has none."""
    stage = rig.stage(axis)
    if not stage.home_end:
        raise InputError(f"stages.{AXES[axis]}.home_end", stage.home_end, "min or max, of an axis with a switch")
    return Home(
        axis,
        -1 if stage.home_end == "min" else 1,
        round(stage.home_unit * stage.steps_per_unit),
        round((stage.max_unit - stage.min_unit) * stage.steps_per_unit),
        stage.home_speed_unit_per_s * stage.steps_per_unit,
    )


def _run(rig: Rig, wanted: Home, port: str) -> Homing:
    link = StepperBoardLink(homing_limits(axis_limits(rig), wanted))
    homing = Homing(link, wanted)
    transport = open_serial(port, rig.board.baud)
    try:
        while not homing.done:
            now_ns = time.monotonic_ns()
            link.feed(transport.read(), now_ns)
            _send(transport, homing.advance(now_ns))
            time.sleep(_POLL_S)
    finally:
        _send(transport, link.disarm())
        time.sleep(0.05)
        transport.close()
    return homing


def _send(transport: Transport, data: bytes) -> None:
    if data:
        transport.write(data)
