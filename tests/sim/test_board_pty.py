"""The board behind a pty, through the driver that a real port has."""

import threading
from collections.abc import Iterator

import pytest

from protocol.serial_frames import BAUD
from realtime.drivers.stepper_board import LinkPhase, StepperBoardLink
from realtime.drivers.transport import open_serial
from sim.board import BoardSlice, SimulatedBoard
from sim.board_pty import BoardInputs, BoardPty, run_paced
from tests.sim.board_rig import LIMITS


@pytest.fixture
def pty() -> Iterator[BoardPty]:
    with BoardPty(SimulatedBoard("native")) as pty:
        yield pty


def test_pyserial_opens_it_and_the_handshake_passes(pty: BoardPty) -> None:
    port, link = open_serial(pty.path, BAUD), StepperBoardLink(LIMITS)
    for ms in range(1, 400):
        port.write(link.advance(ms * 1_000_000))
        pty.exchange(1000 * ms, BoardInputs())
        link.feed(port.read(), ms * 1_000_000)
        if link.phase is LinkPhase.READY:
            break
    port.close()
    assert link.phase is LinkPhase.READY and link.decoder.counters.crc_errors == 0


def test_every_byte_passes_untouched(pty: BoardPty) -> None:
    """Raw mode: no byte is echoed, translated or taken for a control character."""
    port = open_serial(pty.path, BAUD)
    every = bytes(range(256))
    port.write(every)
    assert pty._take() == every
    pty._give(every)
    assert port.read() == every
    port.close()


def test_it_outlives_the_program_that_opened_it(pty: BoardPty) -> None:
    for _ in range(2):
        port = open_serial(pty.path, BAUD)
        pty.exchange(pty.board.time_us + 20_000, BoardInputs())
        assert port.read()
        port.close()


def test_what_nobody_reads_is_dropped_and_counted(pty: BoardPty) -> None:
    for tenth in range(1, 200):
        pty.exchange(100_000 * tenth, BoardInputs())
    assert pty.dropped_bytes > 0


def test_paced_run_ends_when_told_and_hands_on_the_inputs(pty: BoardPty) -> None:
    stop, seen = threading.Event(), []

    def world(last: BoardSlice | None) -> BoardInputs:
        seen.append(last)
        if len(seen) == 20:
            stop.set()
        return BoardInputs(estop=True)

    report = run_paced(pty, world, stop)
    assert report.slices == 20 and pty.board.time_us == 20_000
    assert seen[0] is None and seen[-1] is not None and report.longest_gap_ns > 0
