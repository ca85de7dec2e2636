"""The board as a library answers as the board in its child does, and both survive a fork."""

import os

import numpy as np

from sim.board import SimulatedBoard
from sim.forked_board import ForkableBoard, LibraryBoard, ReplayedBoard, forkable_board
from tests.sim.test_scenario import scenario


def brought_up(board: SimulatedBoard) -> tuple[str, int]:
    run = scenario(board, 4)
    assert run.arm()
    run.command("target", "position", target_m=(0.0, -0.0107, 0.021))
    run.run(0.6)
    return run.world.digest, int(run.world.edges.sum())


def test_the_library_gives_the_same_edges_as_the_child() -> None:
    with SimulatedBoard("native") as child, LibraryBoard() as library:
        expected, edges = brought_up(child)
        assert edges > 100
        assert brought_up(library) == (expected, edges)


def test_two_library_boards_are_two_boards() -> None:
    with LibraryBoard() as one, LibraryBoard() as other:
        one.exchange(50_000)
        first = other.exchange(50_000)
        assert first.cpu.starts == 1
        one.reset()
        assert one.exchange(60_000).cpu.starts == 2
        assert other.exchange(60_000).cpu.starts == 1


def _goes_on(board: ForkableBoard) -> bool:
    """Whether a forked copy of the board says for 20 ms what the original says after it."""
    board.exchange(100_000, b"")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            board.after_fork()
            os.write(writing, board.exchange(120_000, b"").uart_out)
            board.close()
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading, "rb") as pipe:
        copied = pipe.read()
    original = board.exchange(120_000, b"")
    return len(copied) > 50 and copied == original.uart_out and bool(np.all(np.diff(original.uart_cycle) > 0))


def test_a_board_goes_on_alike_on_both_sides_of_a_fork() -> None:
    with forkable_board("native") as library:
        assert isinstance(library, LibraryBoard)
        assert _goes_on(library)
    with ReplayedBoard("native") as replayed:
        assert _goes_on(replayed)
