"""Wall clock: the sensor emulators behind a pty (Aurora) and behind UDP with a web page (Net F/T)."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from sim.aurora_emulator import AuroraEmulator, Pose
from sim.net_ft_emulator import NetFtEmulator

STEP_S = 0.0005
_SPEEDS = {getattr(termios, f"B{baud}"): baud for baud in (300, 9600, 19200, 38400, 57600, 115200, 230400, 921600)}

PosesAt = Callable[[int], Sequence[Pose | None]]
LoadAt = Callable[[int], tuple[np.ndarray, np.ndarray]]


class AuroraPty:
    """An emulated Aurora on a pty. `path` is the port to open; `link` a stable name for it that survives replugging."""

    def __init__(self, emulator: AuroraEmulator, link: Path | None = None) -> None:
        self.emulator, self._link = emulator, link
        self._master, self._slave = -1, -1
        self.plug()

    @property
    def path(self) -> str:
        """Return the path of the port to open."""
        return str(self._link) if self._link is not None else os.ttyname(self._slave)

    def plug(self) -> None:
        """Make the port appear. The server's own hold on it keeps it alive while no host has it open."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Pull the cable: the port is gone, and the program that has it open gets an error."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    def step(self, now_ns: int) -> None:
        """Move what is due by now, both ways. The frames must have been sampled up to now."""
        if self._master < 0:
            self.emulator.read(now_ns)
            return
        # The pty's speed is the host's; a zero byte is never part of a command and stands for a break.
        self.emulator.set_line(_SPEEDS.get(termios.tcgetattr(self._master)[4], 0))
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._master, 4096)
            if b"\x00" in data:
                self.emulator.serial_break(now_ns)
            self.emulator.feed(data.replace(b"\x00", b""), now_ns)
        out = self.emulator.read(now_ns)
        if out:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, out)

    close = unplug


class NetFtUdp:
    """An emulated Net F/T box: RDT on a UDP port and netftapi2.xml on a web port, on loopback by default."""

    def __init__(self, emulator: NetFtEmulator, host: str = "127.0.0.1", rdt_port: int = 0, web_port: int = 0) -> None:
        self.emulator, self._host = emulator, host
        self._peer: tuple[str, int] | None = None
        self._link: socket.socket | None = None
        self.rdt_port = rdt_port
        self.plug()
        self._web = ThreadingHTTPServer((host, web_port), _page_handler(emulator))
        self.web_port = int(self._web.server_address[1])
        threading.Thread(target=self._web.serve_forever, name="net_ft page", daemon=True).start()

    def plug(self) -> None:
        """Bring the RDT port up, at the same number as before."""
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind((self._host, self.rdt_port))
        self._link.setblocking(False)
        self.rdt_port = int(self._link.getsockname()[1])

    def unplug(self) -> None:
        """Pull the network cable and the power: the port is gone, the stream forgotten."""
        if self._link is not None:
            self._link.close()
        self._link, self._peer = None, None
        self.emulator.power_cycle()

    def step(self, now_ns: int) -> None:
        """Move what is due by now, both ways. Records go to the client that asked last, as with the box."""
        records = self.emulator.read(now_ns)
        if self._link is None:
            return
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            while True:
                datagram, self._peer = self._link.recvfrom(2048)
                self.emulator.feed(datagram, now_ns)
        for record in records if self._peer is not None else ():
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                self._link.sendto(record, self._peer or ("", 0))

    def close(self) -> None:
        """End the servers of tracker and force sensor."""
        self.unplug()
        self._web.shutdown()
        self._web.server_close()


def _page_handler(emulator: NetFtEmulator) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """HTTP handler of the box's web page."""

        def do_GET(self) -> None:
            good = self.path.split("?")[0] == "/netftapi2.xml"
            page = emulator.page() if good else b""
            self.send_response(200 if good else 404)
            self.send_header("Content-Type", "text/xml")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing: the box has no console."""

    return Handler


class SensorServers(threading.Thread):
    """Both devices on CLOCK_MONOTONIC in one daemon thread; `poses_at` and `load_at` give the truth at a time in ns."""

    def __init__(
        self,
        aurora: AuroraPty | None,
        poses_at: PosesAt | None,
        net_ft: NetFtUdp | None = None,
        load_at: LoadAt | None = None,
    ) -> None:
        super().__init__(name="sensor servers", daemon=True)
        self._aurora, self._poses_at, self._net_ft, self._load_at = aurora, poses_at, net_ft, load_at
        self._halt = threading.Event()
        self.lock = threading.Lock()

    def run(self) -> None:
        """Step every half millisecond until `stop`."""
        while not self._halt.is_set():
            with self.lock:
                self._step(time.monotonic_ns())
            time.sleep(STEP_S)

    def stop(self) -> None:
        """End the thread; the ports stay for their owner to close."""
        self._halt.set()
        if self.is_alive():
            self.join(2.0)

    def _step(self, now_ns: int) -> None:
        if self._aurora is not None and self._poses_at is not None:
            emulator = self._aurora.emulator
            while emulator.next_frame_ns <= now_ns:
                emulator.sample(emulator.next_frame_ns, self._poses_at(emulator.next_frame_ns))
            self._aurora.step(now_ns)
        if self._net_ft is not None and self._load_at is not None:
            box = self._net_ft.emulator
            while box.next_sample_ns <= now_ns:
                box.sample(box.next_sample_ns, *self._load_at(box.next_sample_ns))
            self._net_ft.step(now_ns)
