"""The simulated board on the wall clock: its UART as a pty that pyserial opens, its time paced to CLOCK_MONOTONIC."""

import errno
import os
import threading
import time
import tty
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np

from sim.board import BoardSlice, SimulatedBoard

SLICE_US = 1000


class BoardInputs(NamedTuple):
    """What the world puts on the board's inputs for one slice; as in Board.exchange."""

    limit_bits: int = 0
    estop: bool = False
    encoder_counts: Sequence[int] | np.ndarray = (0, 0, 0)


class PacingReport(NamedTuple):
    """How well the board kept to the wall clock."""

    slices: int
    longest_gap_ns: int  # between two slices; the board stood still meanwhile
    longest_gap_at_us: int  # board time at which it was
    dropped_bytes: int  # sent by the board while no process read the pty


class BoardPty:
    """A Board whose UART is a pty.

    path: what pyserial opens. The slave side is held open here too, so that the pty outlives the programs that
    open and close it. A pty has no DTR line: opening it does not reset the board, Board.reset() does.
    """

    def __init__(self, board: SimulatedBoard) -> None:
        self.board = board
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.dropped_bytes = 0

    def exchange(self, until_us: int, inputs: BoardInputs) -> BoardSlice:
        """Runs the board until `until_us` with what the host has written, and passes on what the board sends."""
        result = self.board.exchange(until_us, self._take(), inputs.limit_bits, inputs.estop, inputs.encoder_counts)
        self._give(result.uart_out)
        return result

    def close(self) -> None:
        """Closes the pty and ends the board."""
        self.board.close()
        for descriptor in (self._master, self._slave):
            os.close(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self) -> bytes:
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def _give(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self._master, data) :]
            except OSError as error:
                if error.errno != errno.EAGAIN:
                    raise
                self.dropped_bytes += len(data)
                return


def run_paced(
    pty: BoardPty, world: Callable[[BoardSlice | None], BoardInputs], stop: threading.Event, slice_us: int = SLICE_US
) -> PacingReport:
    """Runs the board at the rate of CLOCK_MONOTONIC until `stop` is set.

    world: called before each slice with the last one (None at first); returns the inputs for the next.
    After a stall the missed slices follow without a pause, so that board time keeps to the wall clock.
    """
    start_ns = time.monotonic_ns() - pty.board.time_us * 1000
    last_ns = time.monotonic_ns()
    slices = longest_ns = longest_at_us = 0
    result: BoardSlice | None = None
    while not stop.is_set():
        until_us = pty.board.time_us + slice_us
        wait_ns = start_ns + until_us * 1000 - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
        now_ns = time.monotonic_ns()
        if now_ns - last_ns > longest_ns:
            longest_ns, longest_at_us = now_ns - last_ns, until_us
        last_ns = now_ns
        result = pty.exchange(until_us, world(result))
        slices += 1
    return PacingReport(slices, longest_ns, longest_at_us, pty.dropped_bytes)
