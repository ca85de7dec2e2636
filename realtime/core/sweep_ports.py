"""The sweeps on a rig's own ports: `SweepLoop` fed from serial lines and UDP, in turn, at the loop's rate.

The process that holds the board's port commands the rig. The port is opened exclusively: the sweeps do not start while
a realtime process (or another sweep) has it, and no other process reaches the board while the sweeps run.
"""

from __future__ import annotations

import contextlib
import gc
import os
import socket
from collections.abc import Callable, Iterator
from typing import Protocol

from protocol.errors import InputError
from protocol.rig_file import Rig
from realtime.core.device_sources import AURORA, NET_FT
from realtime.core.lines import FromRig, ToRig
from realtime.core.sweep import SweepLoop
from realtime.drivers.net_ft import RDT_PORT
from realtime.drivers.sensor_threads import apply_line_action
from realtime.drivers.transport import Transport, open_serial
from realtime.loop.clock import Clock
from realtime.loop.scheduling import RealtimeSettings, realtime_thread

# The tracker answers at this speed until its driver asks for another.
TRACKER_BAUD = 9600
# A period that comes later than this many is left out, not made up for.
LATE_PERIODS = 3
_DATAGRAM = 2048


class Ports(Protocol):
    """The lines of a rig, as bytes."""

    def receive(self) -> FromRig:
        """Return the data since the last call. Raises OSError if the board's line is gone."""

    def send(self, leaving: ToRig) -> None:
        """Send the data. Raises OSError if the board's line is gone."""


def check_served(rig: Rig) -> None:
    """Refuse a rig whose tracker or force sensor RigPorts cannot read: a plug-in's, or another kind. Raises InputError."""
    for key, kind, wanted in (
        ("tracker.kind", rig.tracker.kind, AURORA),
        ("force_sensor.kind", rig.force_sensor.kind, NET_FT),
    ):
        if kind != wanted:
            raise InputError(
                key,
                kind,
                f"{wanted}, the only one that sweeps on a rig can read; nothing has moved. With this device, record sweeps "
                "by other means and pass them with --recording",
            )


class RigPorts:
    """Board and tracker on serial ports, the force box by UDP; addresses of the rig file, or given here.

    Raises OSError, naming the key, where one does not open or another process has it. Use as a context.
    """

    def __init__(
        self, rig: Rig, board_port: str | None = None, tracker_port: str | None = None, force_port: int = RDT_PORT
    ) -> None:
        self._opened: list[Transport] = []
        self.failures: dict[str, str] = {}
        try:
            self._board = self._open("board.port", board_port or rig.board.port, rig.board.baud)
            self._tracker = self._open("tracker.port", tracker_port or rig.tracker.port, TRACKER_BAUD)
            self._force = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._force.setblocking(False)
            self._force.connect((rig.force_sensor.address, force_port))
        except OSError:
            self.close()
            raise

    def _open(self, key: str, path: str, baud: int) -> Transport:
        try:
            line = open_serial(path, baud)
        except OSError as error:
            cause = error.__cause__
            said = os.strerror(cause.errno) if isinstance(cause, OSError) and cause.errno else str(cause or error)
            raise OSError(
                f"{key}: found {path} that does not open ({said}), wanted a device that no other process holds "
                "(a realtime process must be stopped first)"
            ) from None
        self._opened.append(line)
        return line

    def receive(self) -> FromRig:
        """Return the data that the devices have sent. A lost tracker or force box sends nothing, which ends the sweeps."""
        arriving = FromRig(board=self._board.read())
        try:
            arriving.tracker = self._tracker.read()
        except OSError as gone:
            self.failures["tracker"] = str(gone)
        try:
            while True:
                arriving.force.append(self._force.recv(_DATAGRAM))
        except BlockingIOError:
            pass
        except OSError as gone:
            self.failures["force sensor"] = str(gone)
        return arriving

    def send(self, leaving: ToRig) -> None:
        """Send, to the board first, because its set-points have a time of execution."""
        if leaving.board:
            self._board.write(leaving.board)
        try:
            for action in leaving.tracker_line:
                apply_line_action(self._tracker, action)
            if leaving.tracker:
                self._tracker.write(leaving.tracker)
        except OSError as gone:
            self.failures["tracker"] = str(gone)
        try:
            for datagram in leaving.force:
                self._force.send(datagram)
        except OSError as gone:
            self.failures["force sensor"] = str(gone)

    def close(self) -> None:
        """Close the lines and stop the force sensor's thread."""
        for line in self._opened:
            line.close()
        force = getattr(self, "_force", None)
        if force is not None:
            force.close()

    def __enter__(self) -> RigPorts:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Switch Python's garbage collector off: it may stall for longer than the board waits for a set-point."""
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


class Pace(Protocol):
    """Interface of a clock: `realtime.loop.clock.Clock`, or a simulated world with its own time."""

    def now_ns(self) -> int:
        """Return the clock's time in ns."""

    def sleep_until(self, deadline_ns: int) -> bool:
        """Sleep until `deadline_ns`, as `Clock.sleep_until` does."""


def run_sweeps(
    loop: SweepLoop,
    ports: Ports,
    clock: Pace | None = None,
    each: Callable[[], None] = lambda: None,
    stop: Callable[[], bool] = lambda: False,
    settings: RealtimeSettings | None = None,
) -> None:
    """Turn after turn until the sweeps are done and the stages stand, or `stop` says to break off (they are braked).

    clock: CLOCK_MONOTONIC unless another is given; `loop` keeps its stamps. each: called once a turn. When it returns,
    `loop.finished` or `loop.problem` say how it ended. Raises OSError when the board's line is gone: then the board, which
    receives nothing more, stops the stages by itself.
    """
    clock = clock or Clock.monotonic()
    with realtime_thread(settings), _no_collection():
        due_ns = clock.now_ns()
        ports.send(loop.step(due_ns, FromRig()))
        while not loop.done:
            due_ns += loop.period_ns
            clock.sleep_until(due_ns)
            now_ns = clock.now_ns()
            if now_ns - due_ns > LATE_PERIODS * loop.period_ns:
                due_ns = now_ns
            if stop():
                loop.break_off("operator: found a request to stop, wanted the sweeps to finish")
            ports.send(loop.step(now_ns, ports.receive()))
            each()
