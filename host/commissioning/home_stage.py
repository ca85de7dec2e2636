"""Home one axis: creep to its switch and give the place there its position from the rig file."""

from __future__ import annotations

import time

from protocol.rig_file import Rig
from realtime.core.board_intake import axis_limits
from realtime.core.home_run import home_of
from realtime.drivers.homing import Home, Homing, homing_limits
from realtime.drivers.stepper_board import StepperBoardLink
from realtime.drivers.transport import Transport, open_serial

_POLL_S = 0.001


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


__all__ = ["home_of", "home_stage"]
