"""Wall clock: one thread per sensor that moves bytes between its port and its client, and finds it again when unplugged."""

from __future__ import annotations

import os
import select
import socket
import termios
import threading
import time
from collections.abc import Callable

from realtime.drivers.aurora import AuroraClient, AuroraConfig
from realtime.drivers.aurora_session import LineAction
from realtime.drivers.device_events import DeviceEvent
from realtime.drivers.net_ft import RDT_PORT, ForceSample, NetFtClient, NetFtConfig
from realtime.drivers.pose_sample import PoseSample
from realtime.drivers.transport import Transport

REOPEN_S = 0.5
# Longest sleep: how late a stop is noticed.
_MAX_WAIT_S = 0.05
# A pty carries no break; there a zero byte at a speed below the device's, which is what a break looks like, stands for it.
_BREAK_BAUD = 300

OnEvent = Callable[[DeviceEvent], object]


class SensorThread(threading.Thread):
    """A daemon thread with `start()`, `stop()` and `failures` (times that the port or socket was lost or not there).

    `now_ns` is the clock of all stamps, CLOCK_MONOTONIC unless another is given.
    Events and samples are handed over in this thread; what the callbacks raise ends it and is kept in `error`.
    """

    def __init__(self, name: str, on_event: OnEvent | None, now_ns: Callable[[], int]) -> None:
        super().__init__(name=name, daemon=True)
        self._now_ns = now_ns
        self.failures = 0
        self.error: BaseException | None = None
        self._halt = threading.Event()
        self._on_event = on_event

    def stop(self, timeout_s: float = 1.0) -> None:
        """End the thread and wait for it."""
        self._halt.set()
        if self.is_alive():
            self.join(timeout_s)

    def run(self) -> None:
        """Serve the device until `stop`; after a loss try again every half second."""
        try:
            while not self._halt.is_set():
                try:
                    self._serve()
                except OSError as gone:
                    self.failures += 1
                    self._lost(str(gone))
                    self._halt.wait(REOPEN_S)
        except BaseException as error:
            self.error = error
            raise

    def _serve(self) -> None:
        raise NotImplementedError

    def _lost(self, why: str) -> None:
        raise NotImplementedError

    def _report(self, events: list[DeviceEvent]) -> None:
        for event in events if self._on_event is not None else ():
            assert self._on_event is not None
            self._on_event(event)


class AuroraThread(SensorThread):
    """Reads an Aurora. `open_transport()` opens the port at 9600 baud (OSError when it is not there)."""

    def __init__(
        self,
        open_transport: Callable[[], Transport],
        callback: Callable[[PoseSample], object],
        config: AuroraConfig | None = None,
        on_event: OnEvent | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__("aurora", on_event, now_ns)
        self.client = AuroraClient(config)
        self._open, self._callback = open_transport, callback

    def _serve(self) -> None:
        transport = self._open()
        try:
            while not self._halt.is_set():
                self._turn(transport)
        finally:
            transport.close()

    def _turn(self, transport: Transport) -> None:
        now_ns = self._now_ns()
        sending = self.client.outgoing(now_ns)
        for action in self.client.line_actions():
            apply_line_action(transport, action)
        if sending:
            transport.write(sending)
        self._report(self.client.take_events())
        due_ns = self.client.next_due_ns
        wait_s = 0.0 if due_ns is None else min(max((due_ns - self._now_ns()) * 1e-9, 0.0), _MAX_WAIT_S)
        if not select.select([transport.fileno()], [], [], wait_s)[0]:
            return
        data = transport.read()
        if not data:
            raise OSError("serial port hung up (unplugged?)")
        for sample in self.client.feed(data, self._now_ns()):
            self._callback(sample)

    def _lost(self, why: str) -> None:
        self.client.lost(self._now_ns(), why)
        self._report(self.client.take_events())


class NetFtThread(SensorThread):
    """Reads a Net F/T box by UDP. `request_bias()` may be called from any thread."""

    def __init__(
        self,
        host: str,
        callback: Callable[[ForceSample], object],
        config: NetFtConfig,
        on_event: OnEvent | None = None,
        port: int = RDT_PORT,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__("net_ft", on_event, now_ns)
        self.client = NetFtClient(config)
        self._address, self._callback = (host, port), callback
        self._bias_wanted = threading.Event()

    def request_bias(self) -> None:
        """Request the box to take the present load as zero."""
        self._bias_wanted.set()

    def _serve(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            # Connected: datagrams of other senders are not let through, and a refused port is an error at once.
            link.connect(self._address)
            link.setblocking(False)
            try:
                while not self._halt.is_set():
                    self._turn(link)
            finally:
                _send_quietly(link, self.client.stop() if self._halt.is_set() else b"")

    def _turn(self, link: socket.socket) -> None:
        sending = self.client.outgoing(self._now_ns())
        if sending:
            link.send(sending)
        if self._bias_wanted.is_set():
            self._bias_wanted.clear()
            link.send(self.client.bias())
        self._report(self.client.take_events())
        if not select.select([link], [], [], _MAX_WAIT_S)[0]:
            return
        datagram = link.recv(2048)
        sample = self.client.feed(datagram, self._now_ns())
        if sample is not None:
            self._callback(sample)

    def _lost(self, why: str) -> None:
        self.client.lost(self._now_ns(), why)
        self._report(self.client.take_events())


def apply_line_action(transport: Transport, action: LineAction) -> None:
    """Set the speed of a tty or pty and, if asked, hold a break. Raises OSError when the port is gone."""
    fd = transport.fileno()
    try:
        if action.break_s > 0:
            _hold_break(fd)
        _set_baud(fd, action.baud)
        termios.tcflush(fd, termios.TCIFLUSH)
    except termios.error as bad:
        raise OSError(f"serial port: {bad}") from bad


def _hold_break(fd: int) -> None:
    if os.ttyname(fd).startswith("/dev/pts/"):
        _set_baud(fd, _BREAK_BAUD)
        os.write(fd, b"\x00")
    else:
        termios.tcsendbreak(fd, 0)


def _set_baud(fd: int, baud: int) -> None:
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise OSError(f"baud: found {baud}, wanted a speed that this system knows")
    settings = termios.tcgetattr(fd)
    settings[4] = settings[5] = speed
    termios.tcsetattr(fd, termios.TCSADRAIN, settings)


def _send_quietly(link: socket.socket, data: bytes) -> None:
    """Send a last request to a box that may be gone; ignore errors."""
    if data:
        try:
            link.send(data)
        except OSError:
            return
