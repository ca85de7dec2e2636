"""The simulated rig on the wall clock: board and tracker on ptys, force box on UDP, paced to CLOCK_MONOTONIC."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pty
import signal
import sys
import time
import tty
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import numpy as np

from protocol.rig_file import load_rig
from realtime.drivers.openigtlink import address_of
from realtime.loop.service_notify import ServiceNotifier
from sim.board import SimulatedBoard
from sim.effects import parse
from sim.sensor_servers import AuroraPty, NetFtUdp
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

if TYPE_CHECKING:
    from sim.plus_server import PlusServer

SLICE_NS = 1_000_000
# After a stall the world catches up at most this much in one go, then looks at its lines again.
CATCH_UP_SLICES = 5


@dataclass
class Interval:
    """What was true between two marks, on the rig's own clock: peak force, last step edge, force at the end."""

    name: str
    begin_s: float
    end_s: float = 0.0
    last_edge_s: float | None = None
    peak_force_N: float = 0.0
    force_N: float = 0.0


class RigServer:
    """Owns the world and its lines. `serve` until `stop`.

    commands: a file descriptor with lines for it, -1 for none: `unplug board`, `unplug tracker`, `mark NAME`.
    """

    def __init__(self, world: World, commands: int = -1) -> None:
        self.world = world
        self._commands, self._words = commands, b""
        if commands >= 0:
            os.set_blocking(commands, False)
        self.intervals = [Interval("start", 0.0)]
        self._board_line, self._board_end = pty.openpty()
        tty.setraw(self._board_end)
        os.set_blocking(self._board_line, False)
        self.tracker, self.force_box = _tracker_server(world), NetFtUdp(world.force_box)
        self._running = True
        self.longest_stall_ns, self.longest_stall_at_ns = 0, 0
        self.last_byte_ns, self.last_edge_ns = 0, 0

    @property
    def ports(self) -> dict[str, str | int]:
        """Where the devices are to be found."""
        return {
            "board": os.ttyname(self._board_end),
            "tracker": self.tracker.path,
            "force_port": self.force_box.rdt_port,
            "page_port": self.force_box.web_port,
        }

    def stop(self) -> None:
        """Ends `serve` after the present slice."""
        self._running = False

    def serve(self) -> None:
        """Advance the simulated world with CLOCK_MONOTONIC until it is stopped."""
        manager = ServiceNotifier()
        manager.ready("devices are there")
        begin_ns = last_ns = time.monotonic_ns()
        while self._running:
            now_ns = time.monotonic_ns()
            if now_ns - last_ns > self.longest_stall_ns:
                self.longest_stall_ns, self.longest_stall_at_ns = now_ns - last_ns, self.world.now_ns
            last_ns = now_ns
            manager.beat(self.world.now_ns)
            self._obey()
            for _ in range(CATCH_UP_SLICES):
                if self.world.now_ns + SLICE_NS > now_ns - begin_ns:
                    break
                self._slice()
            ahead_ns = begin_ns + self.world.now_ns + SLICE_NS - time.monotonic_ns()
            if ahead_ns > 0:
                time.sleep(ahead_ns * 1e-9)

    def unplug_board(self) -> None:
        """Pull the board's cable: its port is gone, and the program that has it open gets an error."""
        for fd in (self._board_line, self._board_end):
            if fd >= 0:
                os.close(fd)
        self._board_line = self._board_end = -1

    def _obey(self) -> None:
        """Carry out the lines that have come."""
        if self._commands < 0:
            return
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._commands, 4096)
            self._words += data
            if not data:
                self._commands = -1
        *lines, self._words = self._words.split(b"\n")
        for line in lines:
            word, _, name = line.decode("ascii", "replace").partition(" ")
            if word == "mark":
                self.intervals.append(Interval(name, self.world.now_ns * 1e-9))
            elif (word, name) == ("unplug", "board"):
                self.unplug_board()
            elif (word, name) == ("unplug", "tracker"):
                self.tracker.unplug()

    def _slice(self) -> None:
        data = b""
        if self._board_line >= 0:
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._board_line, 4096)
        if data:
            self.last_byte_ns = self.world.now_ns
        out = self.world.advance(self.world.now_ns + SLICE_NS, data)
        if self.world.slice is not None and len(self.world.slice.edge_cycle):
            self.last_edge_ns = self.world.now_ns
        self._note()
        if out and self._board_line >= 0:
            with contextlib.suppress(BlockingIOError):
                os.write(self._board_line, out)
        self.tracker.step(self.world.now_ns)
        self.force_box.step(self.world.now_ns)

    def _note(self) -> None:
        now = self.intervals[-1]
        now.end_s = self.world.now_ns * 1e-9
        if self.last_edge_ns == self.world.now_ns:
            now.last_edge_s = now.end_s
        now.force_N = float(np.linalg.norm(self.world.plant.contact_force_N))
        now.peak_force_N = max(now.peak_force_N, now.force_N)

    def summary(self) -> dict[str, object]:
        """What the rig itself counted, for a test or a report."""
        world = self.world
        return {
            "virtual_s": world.now_ns * 1e-9,
            "steps_on_pins": world.steps.tolist(),
            "edges": world.edges.tolist(),
            "longest_stall_ms": self.longest_stall_ns * 1e-6,
            "longest_stall_at_s": self.longest_stall_at_ns * 1e-9,
            "last_byte_s": self.last_byte_ns * 1e-9,
            "last_edge_s": self.last_edge_ns * 1e-9,
            "peak_force_N": world.peak_force_N,
            "intervals": [asdict(interval) for interval in self.intervals],
            "board": world.board.kind,
        }

    def close(self) -> None:
        """Close the emulated tracker, the force sensor and the line of the board."""
        self.tracker.close()
        self.force_box.close()
        self.unplug_board()


def _tracker_server(world: World) -> AuroraPty | PlusServer:
    """The simulated tracker as the rig file has it: an Aurora on a pty, or an OpenIGTLink server at the file's port."""
    tracker = world.rig.tracker
    if tracker.kind != "openigtlink":
        return AuroraPty(world.tracker)
    from sim.plus_server import PlusServer

    return PlusServer(world.tracker, address_of(tracker.port))


def _ask_for_priority() -> None:
    """A real board does not slow down with this computer; where allowed, neither does this one (below the loop)."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))


def _write_ports(path: Path, ports: dict[str, str | int]) -> None:
    """The ports as NAME=value lines, whole or not at all."""
    part = path.with_suffix(".part")
    part.write_text(
        "".join(
            f"{name}={ports[key]}\n"
            for name, key in (("BOARD_PORT", "board"), ("TRACKER_PORT", "tracker"), ("FORCE_PORT", "force_port"))
        ),
        encoding="ascii",
    )
    part.replace(path)


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT. First line of output: the ports; last line: the summary (JSON both)."""
    parser = argparse.ArgumentParser(prog="python -m sim.rig_server", description=__doc__)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--board", default="auto")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--ports-file", type=Path, help="Where to write the ports, for a service's EnvironmentFile.")
    parser.add_argument("--free", action="store_true", help="No wall within reach, for sweeps.")
    parser.add_argument("--effect", type=parse, action="append", default=[], help="ID@PORT:NAME=VALUE,start_s=VALUE")
    parser.add_argument("--commands", action="store_true", help="Obey lines on standard input: unplug board, mark NAME, ...")
    options = parser.parse_args(arguments)
    _ask_for_priority()
    rig = load_rig(options.rig)
    wall = TissueConfig(point_m=(0.0, 0.0, 10.0)) if options.free else TissueConfig()
    plant = simulated_plant(rig, options.seed, tissue=wall, effects=tuple(options.effect))
    with SimulatedBoard(options.board) as board:
        world = World(rig, plant, board, options.seed)
        world.advance(SLICE_NS, b"")
        server = RigServer(world, sys.stdin.fileno() if options.commands else -1)

        def on_signal(number: int, frame: FrameType | None) -> None:
            server.stop()

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)
        print(json.dumps(server.ports), flush=True)
        if options.ports_file is not None:
            _write_ports(options.ports_file, server.ports)
        server.serve()
        print(json.dumps(server.summary()), flush=True)
        server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
