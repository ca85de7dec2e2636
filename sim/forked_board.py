"""Boards that survive a fork of their process: the native one as a library in it, the AVR one by replay."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sim.board import (
    _EDGE,
    _REPLY,
    BUILD_DIR,
    FIRMWARE_DIR,
    BoardSlice,
    BoardUnavailable,
    SimulatedBoard,
    resolve_kind,
    slice_of,
)

BOARD_SRC = Path(__file__).parent / "board_src"
_BATCH = 100  # requests in flight: a few kB, which a pipe always holds


class LibraryBoard(SimulatedBoard):
    """The native board without a child process: the same firmware, answers and edges, some ten times faster.

    A fork copies its state with the process. Raises BoardUnavailable where it cannot be compiled.
    """

    def __init__(self) -> None:
        self.kind, self.mcu, self.time_us = "native", "atmega2560", 0
        # A copy of its own, since a library that is loaded twice under one name is one board.
        with tempfile.TemporaryDirectory() as folder:
            copy = shutil.copy(_built_library(), folder)
            self._native_call = ctypes.CDLL(copy).native_call
        self._native_call.restype = ctypes.c_size_t
        self._native_call.argtypes = [ctypes.c_char_p, ctypes.POINTER(ctypes.c_void_p)]

    def _call(self, request: bytes) -> BoardSlice:
        answer = ctypes.c_void_p()
        length = self._native_call(request, ctypes.byref(answer))
        assert answer.value is not None
        return slice_of(ctypes.string_at(answer.value, length))

    def after_fork(self) -> None:
        """Nothing to do: the copy has the state."""

    def close(self) -> None:
        """Do nothing: the native board has no process of its own."""

    @property
    def pid(self) -> int:
        """Return the id of this process, in which the native board runs."""
        return os.getpid()


class ReplayedBoard(SimulatedBoard):
    """A `SimulatedBoard` in a child process. It keeps its inputs, so that `after_fork` can replay them in a new child."""

    def __init__(self, kind: str, mcu: str = "atmega2560") -> None:
        self._asked: list[bytes] = []
        super().__init__(kind, mcu)

    def _call(self, request: bytes) -> BoardSlice:
        self._asked.append(request)
        return super()._call(request)

    def after_fork(self) -> None:
        """In the forked process: leave the parent's board alone and bring up one in the same state."""
        old = self._child
        for pipe in (old.stdin, old.stdout):
            if pipe is not None:
                pipe.close()
        self._child = subprocess.Popen(old.args, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        assert self._child.stdin is not None and self._child.stdout is not None
        self._to_child, self._from_child = self._child.stdin.fileno(), self._child.stdout.fileno()
        for start in range(0, len(self._asked), _BATCH):
            batch = self._asked[start : start + _BATCH]
            os.write(self._to_child, b"".join(batch))
            for _ in batch:
                head = _REPLY.unpack(self._read(_REPLY.size))
                self._read(9 * head[-2] + head[-1] * _EDGE.itemsize)


ForkableBoard = LibraryBoard | ReplayedBoard


def forkable_board(kind: str) -> ForkableBoard:
    """A board of `kind` ("native", "avr", "auto"). Raises BoardUnavailable, ValueError."""
    kind = resolve_kind(kind)
    return LibraryBoard() if kind == "native" else ReplayedBoard(kind)


def _built_library() -> Path:
    """The compiled library, made again when a source is newer. Raises BoardUnavailable."""
    library = BUILD_DIR / "native_board.so"
    core = [path for path in sorted((FIRMWARE_DIR / "src").glob("*.c")) if path.name != "avr_main.c"]
    sources = [BOARD_SRC / "native_library.c", BOARD_SRC / "lockstep.c", *core]
    watched = [*sources, BOARD_SRC / "native_board.c", BOARD_SRC / "lockstep.h", *(FIRMWARE_DIR / "src").glob("*.h")]
    if library.exists() and library.stat().st_mtime >= max(path.stat().st_mtime for path in watched):
        return library
    if shutil.which("gcc") is None:
        raise BoardUnavailable("board native: found no gcc; install it (Debian: gcc libc6-dev)")
    BUILD_DIR.mkdir(parents=True, exist_ok=True)
    part = library.with_suffix(f".{os.getpid()}.part")
    command = [
        "gcc",
        "-std=c99",
        "-D_POSIX_C_SOURCE=200809L",
        "-O2",
        "-fPIC",
        "-shared",
        "-fno-common",
        "-Wl,-Bsymbolic",
        f"-I{FIRMWARE_DIR / 'src'}",
        f"-I{BOARD_SRC}",
        *map(str, sources),
        "-o",
        str(part),
    ]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        said = [line for line in result.stderr.splitlines() if "error" in line] or ["gcc failed"]
        raise BoardUnavailable(f"board native: the library does not compile: {said[0]}")
    part.replace(library)
    return library
