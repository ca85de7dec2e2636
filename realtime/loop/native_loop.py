"""The wall-clock loop: sleep, read mailboxes, tick, write the set-point, publish; compiled, in its own thread.

Between start and stop the thread runs machine code only: no interpreter, no lock, no allocation, so that garbage
collection or a busy Python thread cannot delay a set-point. A tick that comes too late is skipped and counted; the
loop never catches up with a burst.
"""

from __future__ import annotations

import errno
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from protocol.setpoint_encoder import encode_setpoint
from realtime.loop.atomics import load_acquire, store_release
from realtime.loop.clock import sleep_until
from realtime.loop.libc import monotonic_ns, write_bytes
from realtime.loop.mailbox import mailbox_read, mailbox_write, ring_pop, ring_push

# One pass of the loop, published together with the tick's outputs. Times are CLOCK_MONOTONIC but for deadline_ns, which is
# the loop's clock. A gap is the time between the starts of two ticks; its place is one of GAP_PLACES.
LOOP = np.dtype(
    [
        ("tick", "i8"),
        ("deadline_ns", "i8"),
        ("woke_ns", "i8"),
        ("lateness_ns", "i8"),
        ("tick_ns", "i8"),
        ("exchange_ns", "i8"),
        ("missed", "i8"),
        ("sent", "i8"),
        ("refused", "i8"),
        ("write_error", "i8"),
        ("telemetry_dropped", "i8"),
        ("longest_gap_ns", "i8"),
        ("longest_gap_at_ns", "i8"),
        ("longest_gap_tick", "i8"),
        ("longest_gap_place", "i8"),
    ],
    align=True,
)
GAP_PLACES = ("none", "woken late", "in the tick", "in the exchange")

# Whole frames, with sequence number and check sum, that Python hands to the loop so that one thread alone writes.
FRAME_BYTES = 64
FRAME = np.dtype([("count", "i8"), ("bytes", "u1", FRAME_BYTES)], align=True)
_COMMANDS_PER_TICK = 4
PENDING_BYTES = 256
_EAGAIN, _EINTR = errno.EAGAIN, errno.EINTR

STOPPED, TICKS_DONE = 1, 2
# control[]: the stop flag, and on a cache line of its own the heartbeat (number of passes so far).
STOP, HEARTBEAT, CONTROL_WORDS = 0, 8, 16
# Histograms: BINS of LATENESS_BIN_NS and WORK_BIN_NS, then for what is longer bins that grow by 1.1 % each, up to a
# million times the longest of the first, then the exact maximum. A percentile is exact to its bin however long a tick was.
LATENESS_BIN_NS, WORK_BIN_NS, BINS = 1_000, 100, 20_000
BINS_PER_OCTAVE = 64
HISTOGRAM_WORDS = BINS + 20 * BINS_PER_OCTAVE + 1


class Schedule(NamedTuple):
    """When the loop ticks and where it writes: as in `make_loop`."""

    first_ns: int
    period_ns: int
    max_ticks: int
    fd: int


class LoopMemory(NamedTuple):
    """All that the compiled loop touches, made beforehand (`realtime.loop.loop_thread`)."""

    clock: np.ndarray
    control: np.ndarray  # (CONTROL_WORDS,) i8
    inputs: np.ndarray  # (1,) INPUTS
    input_words: np.ndarray  # the same memory as i8
    mailboxes: tuple[np.ndarray, ...]
    offsets: np.ndarray  # where each mailbox's record starts in input_words
    scratch: np.ndarray
    outputs: np.ndarray  # (1,) OUTPUTS, inside `published`
    loop: np.ndarray  # (1,) LOOP, inside `published`
    published: np.ndarray  # LOOP and OUTPUTS as i8 words
    latest: np.ndarray
    telemetry: np.ndarray
    commands: np.ndarray
    command: np.ndarray  # (1,) FRAME
    command_words: np.ndarray
    pending: np.ndarray  # (PENDING_BYTES,) u1, bytes that the line has not taken yet
    pending_count: np.ndarray  # (1,) i8
    frame: np.ndarray  # (FRAME_BYTES,) u1
    lateness: np.ndarray  # (HISTOGRAM_WORDS,) i8
    work: np.ndarray  # (HISTOGRAM_WORDS,) i8


@njit(cache=True, nogil=True, error_model="numpy")
def bin_of(bin_ns: int, value_ns: int) -> int:
    """Return the bin of a histogram that counts `value_ns`, with its first BINS of `bin_ns` each."""
    index = max(value_ns // bin_ns, 0)
    if index < BINS:
        return index
    return min(BINS + int(math.log2(value_ns / (BINS * bin_ns)) * BINS_PER_OCTAVE), HISTOGRAM_WORDS - 2)


@njit(cache=True, nogil=True, error_model="numpy")
def count_in(histogram: np.ndarray, bin_ns: int, value_ns: int) -> None:
    """Count `value_ns` in `histogram`, (HISTOGRAM_WORDS,) int64."""
    histogram[min(bin_of(bin_ns, value_ns), histogram.shape[0] - 2)] += 1
    histogram[-1] = max(histogram[-1], value_ns)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(memory: LoopMemory) -> None:
    """Copy the newest value of every input mailbox into the input record."""
    for i in range(len(memory.mailboxes)):
        mailbox_read(memory.mailboxes[i], memory.scratch, memory.input_words[memory.offsets[i] :])


@njit(cache=True, nogil=True, error_model="numpy")
def _queue_bytes(memory: LoopMemory, source: np.ndarray, count: int) -> bool:
    at = memory.pending_count[0]
    if count > source.shape[0] or at + count > memory.pending.shape[0]:
        return False
    for i in range(count):
        memory.pending[at + i] = source[i]
    memory.pending_count[0] = at + count
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _flush(memory: LoopMemory, fd: int) -> None:
    """Write to the line what it takes now and keep the remaining bytes. An error keeps its number and drops them."""
    count = memory.pending_count[0]
    if count == 0 or fd < 0:
        memory.pending_count[0] = 0
        return
    written = write_bytes(fd, memory.pending, 0, count)
    if written < 0:
        if written != -_EAGAIN and written != -_EINTR:
            memory.loop[0].write_error = -written
            memory.pending_count[0] = 0
        return
    for i in range(count - written):
        memory.pending[i] = memory.pending[written + i]
    memory.pending_count[0] = count - written


@njit(cache=True, nogil=True, error_model="numpy")
def _exchange(memory: LoopMemory, fd: int) -> None:
    """Write the set-point to the line, then pending commands."""
    loop, outputs = memory.loop[0], memory.outputs[0]
    if memory.pending_count[0] > 0:
        _flush(memory, fd)
    if outputs.valid != 0:
        number = outputs.number
        count = encode_setpoint(
            memory.frame, number & 0xFF, number, outputs.execute_us, outputs.expiry_us, outputs.position_steps
        )
        if count > 0 and _queue_bytes(memory, memory.frame, count):
            loop.sent += 1
        else:
            loop.refused += 1
    for _ in range(_COMMANDS_PER_TICK):
        if memory.pending_count[0] + FRAME_BYTES > PENDING_BYTES or not ring_pop(memory.commands, memory.command_words):
            break
        _queue_bytes(memory, memory.command[0].bytes, memory.command[0].count)
    _flush(memory, fd)


@njit(cache=True, nogil=True, error_model="numpy")
def _publish(memory: LoopMemory) -> None:
    if not ring_push(memory.telemetry, memory.published):
        memory.loop[0].telemetry_dropped += 1
    mailbox_write(memory.latest, memory.published)


@njit(cache=True, nogil=True, error_model="numpy")
def _note_gap(loop: Any, woke_ns: int, lateness_ns: int) -> None:
    """Keep the longest time between two starts, and what took most of it. Called before the new times are stored."""
    gap_ns = woke_ns - loop.woke_ns
    if loop.woke_ns == 0 or gap_ns <= loop.longest_gap_ns:
        return
    loop.longest_gap_ns, loop.longest_gap_at_ns, loop.longest_gap_tick = gap_ns, woke_ns, loop.tick
    loop.longest_gap_place = 1
    if max(loop.tick_ns, loop.exchange_ns) > lateness_ns:
        loop.longest_gap_place = 2 if loop.tick_ns >= loop.exchange_ns else 3


@njit(inline="always", error_model="numpy")
def run_loop(
    tick: Callable[..., None],
    memory: LoopMemory,
    params: np.ndarray,
    state: np.ndarray,
    schedule: Schedule,
) -> int:
    """Tick until `stop` is set; see `make_loop`. Inlined, so that `tick` is a constant of the function that calls it.

    A loop for one known tick (`realtime.core.control_loop`) is then cached like any kernel; a closure cannot be.
    """
    first_ns, period_ns, max_ticks, fd = schedule
    loop, inputs = memory.loop[0], memory.inputs[0]
    deadline_ns, passes = first_ns, 0
    loop.woke_ns = 0
    while max_ticks <= 0 or passes < max_ticks:
        now = sleep_until(memory.clock, deadline_ns, memory.control)
        if load_acquire(memory.control, STOP) != 0:
            return STOPPED
        woke_ns, lateness_ns = monotonic_ns(), now - deadline_ns
        late_by = lateness_ns // period_ns
        if max_ticks > 0:
            late_by = min(late_by, max_ticks - passes - 1)
        loop.missed += late_by
        passes += late_by + 1
        deadline_ns += late_by * period_ns
        _note_gap(loop, woke_ns, lateness_ns)
        loop.tick += 1
        loop.deadline_ns, loop.woke_ns, loop.lateness_ns = deadline_ns, woke_ns, lateness_ns
        inputs.now_ns = deadline_ns
        _gather(memory)
        before_ns = monotonic_ns()
        tick(params, state, memory.inputs, memory.outputs)
        after_ns = monotonic_ns()
        _exchange(memory, fd)
        done_ns = monotonic_ns()
        loop.tick_ns = after_ns - before_ns
        loop.exchange_ns = done_ns - woke_ns - loop.tick_ns
        _publish(memory)
        count_in(memory.lateness, LATENESS_BIN_NS, lateness_ns)
        count_in(memory.work, WORK_BIN_NS, monotonic_ns() - woke_ns)
        store_release(memory.control, HEARTBEAT, passes)
        deadline_ns += period_ns
    return TICKS_DONE


@functools.cache
def make_loop(tick: Callable[..., None]) -> Callable[..., int]:
    """The loop around `tick(params, state, inputs, outputs)`, each a record array of length 1; tick returns None.

    Returns: `run(memory, params, state, schedule) -> reason`, compiled without the interpreter's lock. It ticks at
    first_ns, first_ns + period_ns, ... on the clock in `memory` until memory.control
    [STOP] is not zero (STOPPED, within one period) or, where max_ticks > 0, until that many periods have gone by,
    missed ones counted (TICKS_DONE). `fd` is a non-blocking file descriptor, or -1 to send nothing.
    inputs.now_ns is the deadline of the tick, so that set-points are spaced by whole periods however late it woke.
    """

    @njit(nogil=True, error_model="numpy")
    def run(memory: LoopMemory, params: np.ndarray, state: np.ndarray, schedule: Schedule) -> int:
        return run_loop(tick, memory, params, state, schedule)

    return run
