"""Home one axis: creep to its switch and give the place there its position from the rig file."""

from __future__ import annotations

import time

from protocol.errors import InputError
from protocol.rig_file import Rig
from protocol.serial_frames import AXES
from realtime.core.board_intake import axis_limits
from realtime.drivers.homing import Home, Homing, homing_limits
from realtime.drivers.stepper_board import StepperBoardLink
from realtime.drivers.transport import Transport, open_serial

_POLL_S = 0.001


def home_of(rig: Rig, axis: int) -> Home:
    """Read the home of `axis` from the rig file, in steps. Raises InputError where the axis has no switch."""
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


def home_stage(rig: Rig, wanted: Home, port: str) -> Homing:
    """Creep to the switch of `wanted.axis` on the board at `port` and set the position there; the board ends disarmed.

    Raises: OSError (the port), HomingFailed (no switch within the travel, a fault, lost steps).
    """
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
