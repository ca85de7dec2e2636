"""`seldinger home AXIS --rig FILE`: move to the axis' switch and set the position there to the rig file's.

A rig that runs homes itself. One that does not run is homed by this command, which then opens the board's port.
"""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.drive import Driver, Endpoint, Keys, Name, driving
from host.cli.options import Json, RigFile
from host.cli.progress import Working
from protocol.errors import InputError, one_of
from protocol.rig_file import AXES, Rig, load_rig
from protocol.stop_client import ask_socket
from protocol.topics import check_name

if TYPE_CHECKING:
    from realtime.drivers.homing import Home

# A disarmed rig shows in this time that it homes; then it may take as long as the axis needs for its travel.
_BEGINS_S, _ENDS_S = 2.0, 600.0


def home(
    axis: Annotated[str, typer.Argument(help="insertion, roll or knob.")],
    rig: RigFile,
    port: Annotated[str, typer.Option(help="Serial port of the board, if the rig does not run.")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the axis moves.")] = False,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Find the axis' home switch. The stage MOVES: nothing in the clamp, a hand at the emergency stop."""
    from realtime.core.home_run import home_of

    one_of("axis", axis, AXES)
    if port and endpoint:
        raise InputError("--port", port, "no --port with --endpoint, because a running rig has opened its port itself")
    try:
        check_name(name)
    except ValueError as error:
        raise InputError.from_sentence(str(error)) from None
    settings = load_rig(rig)
    wanted = home_of(settings, AXES.index(axis))
    if not yes:
        typer.confirm(
            f"{axis} will move slowly to its {settings.stage(wanted.axis).home_end} switch. "
            "Is the clamp empty, and a hand at the emergency stop?",
            abort=True,
            err=True,
        )
    if endpoint is not None or (not port and _runs(settings)):
        with driving("home", rig, json, name, endpoint, keys) as driver:
            _home_running(driver, axis)
        return
    report = _home_stopped(settings, wanted, port)
    if json:
        write_json(report)


def _runs(rig: Rig) -> bool:
    """Whether the rig's realtime process answers on this computer."""
    with contextlib.suppress(OSError, ValueError):
        ask_socket(rig.local, "status")
        return True
    return False


def _home_running(driver: Driver, axis: str) -> None:
    driver.rig.home(axis)
    lines: list[str] = []

    def ended(state: Any) -> bool:
        lines.extend(driver.rig.logged("home"))
        return bool(lines) and state.mode != "homing"

    with Working(f"{axis} moves slowly to its switch"):
        driver.wait(_BEGINS_S, lambda state: state.mode == "homing")  # type: ignore[attr-defined]
        if not driver.wait(_ENDS_S, ended):
            raise driver.failed(f"accepted, but {axis} is not homed within {_ENDS_S:g} s")
    driver.result |= {"axis": axis, "done": "switch found" in lines[-1], "text": lines[-1]}
    driver.say(lines[-1])
    if not driver.result["done"]:
        raise typer.Exit(1)


def _home_stopped(rig: Rig, wanted: Home, port: str) -> dict[str, Any]:
    """Home over the board's own port. Return what `--json` prints."""
    from host.commissioning.home_stage import home_stage
    from realtime.drivers.homing import HomingFailed

    axis, stage = AXES[wanted.axis], rig.stage(wanted.axis)
    try:
        with Working(f"{axis} moves slowly to its switch"):
            homing = home_stage(rig, wanted, port or rig.board.port)
    except (OSError, HomingFailed) as error:
        print(f"seldinger: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    print(
        f"{axis}: switch found, its position is {stage.home_unit:g} {'m' if axis == 'insertion' else 'rad'}; two touches "
        f"differ by {homing.difference_steps} steps; the board is disarmed, the stage is next to the switch",
        file=sys.stderr,
    )
    return {"axis": axis, "end": stage.home_end, "home_unit": stage.home_unit, "difference_steps": homing.difference_steps}
