"""The stepper board in simulation: a child process that runs the firmware in lock step with its world."""

import fcntl
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from protocol.board_pins import Build, build_of

FIRMWARE_DIR = Path(__file__).resolve().parent.parent / "firmware"
BUILD_DIR = FIRMWARE_DIR / "build"
KINDS = ("avr", "native", "auto")
MCUS = ("atmega2560", "atmega328p")
CPU_HZ = 16_000_000
CYCLES_PER_US = CPU_HZ // 1_000_000
STEP_TIMER_CYCLES = CPU_HZ // 20_000

_REQUEST = struct.Struct("<cBHIQ3i")
_REPLY = struct.Struct("<QQQQIIIIIIII")
_EDGE = np.dtype([("cycle", "<u8"), ("axis", "i1"), ("sign", "i1")])
_SIMAVR_HEADERS = (Path("/usr/include/simavr/sim_avr.h"), Path("/usr/local/include/simavr/sim_avr.h"))


_built: set[str] = set()  # programs that this process has seen up to date
USUAL_BUILD = build_of([])


class CpuStats(NamedTuple):
    """Load of the simulated processor since the child started."""

    step_isr_max_cycles: int  # 0 on the native board, as all cycle counts but idle
    step_isr_mean_cycles: float
    idle_share: float
    starts: int  # of the processor: 1, and one more for each reset
    rx_lost_bytes: int  # because the receiver's buffer was full
    stack_free_bytes: int  # between the variables and the deepest stack of all starts; 0 on the native board


class BoardSlice(NamedTuple):
    """What left the board during one slice."""

    uart_out: bytes
    edge_time_us: np.ndarray  # (n,) i8, since the child started
    edge_axis: np.ndarray  # (n,) i1
    edge_sign: np.ndarray  # (n,) i1, +1 forwards
    edge_cycle: np.ndarray  # (n,) i8, processor cycles since the child started
    cpu: CpuStats
    uart_cycle: np.ndarray  # (len(uart_out),) i8, cycle at which each byte had left whole
    enabled: bool  # at the end of the slice the enable line powers the drives
    enable_changes: int  # of that line since the child started

    def timed_frames(self) -> Iterator[tuple[bytes, int]]:
        """uart_out in segments that each end with a frame's delimiter (or the slice), and when they had left, in us.

        A caller can stamp the arrival of a frame more finely than by the slice.
        """
        start = 0
        for part in self.uart_out.split(b"\0"):
            end = min(start + len(part) + 1, len(self.uart_out))
            if end > start:
                yield self.uart_out[start:end], -(-int(self.uart_cycle[end - 1]) // CYCLES_PER_US)
            start = end


def slice_of(reply: bytes) -> BoardSlice:
    """The slice in one reply of the board's program (reply_t in sim/board_src/lockstep.h and what follows it)."""
    (
        cycle,
        isr_cycles,
        isr_count,
        idle_cycles,
        isr_max,
        starts,
        rx_lost,
        stack_free,
        enabled,
        enable_changes,
        n_uart,
        n_edges,
    ) = _REPLY.unpack_from(reply)
    body = reply[_REPLY.size :]
    edges = np.frombuffer(body, _EDGE, n_edges, 9 * n_uart)
    cycles = edges["cycle"].astype(np.int64)
    mean = isr_cycles / isr_count if isr_count else 0.0
    cpu = CpuStats(isr_max, mean, idle_cycles / cycle if cycle else 0.0, starts, rx_lost, stack_free)
    return BoardSlice(
        body[:n_uart],
        cycles // CYCLES_PER_US,
        edges["axis"].copy(),
        edges["sign"].copy(),
        cycles,
        cpu,
        np.frombuffer(body, "<u8", n_uart, n_uart).astype(np.int64),
        bool(enabled),
        enable_changes,
    )


class BoardUnavailable(RuntimeError):
    """The board cannot be built or has died; the message is one line that says what to do."""


def _missing_tools(kind: str) -> list[str]:
    missing = [tool for tool in ("make", "gcc") if shutil.which(tool) is None]
    if kind == "avr":
        if shutil.which("avr-gcc") is None:
            missing.append("avr-gcc (Debian: gcc-avr avr-libc)")
        if not any(header.exists() for header in _SIMAVR_HEADERS):
            missing.append("libsimavr (Debian: libsimavr-dev)")
    return missing


def resolve_kind(kind: str) -> str:
    """Return "avr" or "native"; "auto" is avr where its tools are installed, else native with one line on standard error.

    Raises ValueError for another kind.
    """
    if kind not in KINDS:
        raise ValueError(f"board kind: found {kind!r}, wanted one of {', '.join(KINDS)}")
    if kind != "auto":
        return kind
    missing = _missing_tools("avr")
    if not missing:
        return "avr"
    print(f"seldinger: no {', no '.join(missing)}; the firmware runs compiled for the host instead", file=sys.stderr)
    return "native"


def ensure_built(kind: str, build: Build = USUAL_BUILD) -> Path:
    """Builds the board's program (and for avr the firmware's ELF files) where they are stale; returns the program.

    kind: "avr", "native" or "auto". build: with other pins or polarities than the usual ones.
    Raises BoardUnavailable with one line when a tool is missing or make fails.
    """
    kind = resolve_kind(kind)
    missing = _missing_tools(kind)
    if missing:
        raise BoardUnavailable(f"board {kind}: found no {', no '.join(missing)}; install it, or choose board native")
    program = FIRMWARE_DIR / build.folder / f"{kind}_board"
    if str(program) in _built and program.exists():
        return program
    BUILD_DIR.mkdir(parents=True, exist_ok=True)
    with open(BUILD_DIR / ".lock", "w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = ["make", "--silent", "-C", str(FIRMWARE_DIR), f"{kind}-board", *build.variables]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        said = [line for line in result.stderr.splitlines() if "error" in line.lower()] or ["make failed"]
        raise BoardUnavailable(f"board {kind}: `make -C firmware {kind}-board` failed: {said[0]}")
    _built.add(str(program))
    return program


class SimulatedBoard:
    """A simulated board. Time is microseconds since this object was made; it continues through resets.

    kind: "avr" runs the ELF in simavr, "native" the same core compiled for the host, "auto" the better one there is.
    mcu: of MCUS, for avr. build: of the firmware, with other pins or polarities than the usual ones.
    Deterministic: the same calls give the same bytes and the same edges to the cycle.
    Raises BoardUnavailable when it cannot be built, ValueError for a wrong kind or mcu.
    """

    def __init__(self, kind: str = "auto", mcu: str = "atmega2560", build: Build = USUAL_BUILD) -> None:
        if mcu not in MCUS:
            raise ValueError(f"mcu: found {mcu!r}, wanted one of {', '.join(MCUS)}")
        self.kind = resolve_kind(kind)
        self.mcu = mcu
        program = [str(ensure_built(self.kind, build))]
        if self.kind == "avr":
            program += [mcu, str(FIRMWARE_DIR / build.folder / f"seldinger-{mcu}.elf")]
        self.time_us = 0
        self._child: subprocess.Popen[bytes] = subprocess.Popen(
            program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
        )  # Ctrl-C is for the parent, which then ends its child in order
        assert self._child.stdin is not None and self._child.stdout is not None
        self._to_child = self._child.stdin.fileno()
        self._from_child = self._child.stdout.fileno()

    def exchange(
        self,
        until_us: int,
        uart_in: bytes = b"",
        limit_bits: int = 0,
        estop: bool = False,
        encoder_counts: Sequence[int] | np.ndarray = (0, 0, 0),
    ) -> BoardSlice:
        """Runs the board until `until_us` with these inputs and returns what left it.

        until_us: board time, not before the last. uart_in: bytes that start on the line at the beginning of the
        slice (at 500 kbaud; what does not fit goes on into the next). limit_bits: bit 2*axis for the lower end,
        2*axis+1 for the upper; set is hit. estop: True is hit. Each becomes the level that a switch of the polarity
        built in gives. encoder_counts: (3,) counts reached evenly by the
        end of the slice; the first call places the encoders there without motion.
        Raises ValueError for a time in the past, BoardUnavailable when the child has died.
        """
        if until_us < self.time_us:
            raise ValueError(f"until_us: found {until_us}, wanted at least {self.time_us}")
        counts = [int(c) for c in encoder_counts]
        self.time_us = until_us
        return self._call(_REQUEST.pack(b"X", estop, limit_bits, len(uart_in), until_us, *counts) + uart_in)

    def power_cycle(self) -> None:
        """Takes the supply away and brings it back: the board starts again, with its boot count one higher."""
        self._command(b"P")

    def reset(self) -> None:
        """Pulls the reset pin, as opening the port of an Arduino does."""
        self._command(b"R")

    def freeze(self) -> None:
        """Makes the processor hang, from the next slice on, until its hardware watchdog resets it."""
        self._command(b"F")

    def close(self) -> None:
        """Ends the child; a second call does nothing."""
        if self._child.poll() is None:
            self._child.terminate()
            self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                pipe.close()

    @property
    def pid(self) -> int:
        """Return the process id of the child."""
        return self._child.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _command(self, op: bytes) -> None:
        self._call(_REQUEST.pack(op, 0, 0, 0, self.time_us, 0, 0, 0))

    def _call(self, request: bytes) -> BoardSlice:
        try:
            os.write(self._to_child, request)
            head = self._read(_REPLY.size)
            n_uart, n_edges = _REPLY.unpack(head)[-2:]
            body = self._read(9 * n_uart + n_edges * _EDGE.itemsize)
        except (OSError, struct.error) as error:
            raise BoardUnavailable(f"board {self.kind}: the child process {self.pid} died ({error})") from error
        return slice_of(head + body)

    def _read(self, n: int) -> bytes:
        parts = []
        while n:
            part = os.read(self._from_child, n)
            if not part:
                raise OSError("end of its output")
            parts.append(part)
            n -= len(part)
        return b"".join(parts)
