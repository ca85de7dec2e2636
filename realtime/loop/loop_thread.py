"""Python interface of the compiled loop: makes its memory, starts and stops its thread, hands frames over to it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from realtime.loop.atomics import get_word, put_word
from realtime.loop.clock import Clock
from realtime.loop.mailbox import Mailbox, Ring, n_words, record_with_words
from realtime.loop.native_loop import (
    CONTROL_WORDS,
    FRAME,
    FRAME_BYTES,
    HEARTBEAT,
    HISTOGRAM_WORDS,
    LOOP,
    PENDING_BYTES,
    STOP,
    LoopMemory,
    Schedule,
    make_loop,
)
from realtime.loop.scheduling import RealtimeReport, RealtimeSettings, realtime_thread

_OUTPUT_FIELDS = ("valid", "number", "execute_us", "expiry_us", "position_steps")
_COMMANDS_WAITING = 64


def input_mailboxes(inputs_dtype: np.dtype, numbered: bool = True) -> dict[str, Mailbox]:
    """A mailbox for every structured field of `inputs_dtype`, by the field's name; `numbered` as for `Mailbox`."""
    fields: Mapping[str, Any] = np.dtype(inputs_dtype).fields or {}
    return {name: Mailbox(field[0], numbered=numbered) for name, field in fields.items() if field[0].names}


class NativeLoop:
    """Runs `tick` in a thread of its own on `clock`, from input mailboxes to the serial line and the telemetry ring.

    Args:
        tick: as for `make_loop`, compiled with numba (or plain, with NUMBA_DISABLE_JIT=1).
        params, state: the tick's records, each shape (1,).
        inputs_dtype: has the field now_ns, and the fields that the mailboxes feed.
        outputs_dtype: has the fields valid, number, execute_us, expiry_us, position_steps.
        mailboxes: field of the inputs -> Mailbox of that field's dtype; at least one.
        period_ns: time between ticks.
        fd: non-blocking descriptor of the board's line, or -1.
        telemetry_capacity: records that the ring holds until they are drained.
        realtime: what to ask of the kernel, None for nothing.
        run: the loop around `tick` where it is compiled already (`realtime.core.control_loop.run`), else it is made.
    Raises: ValueError for records, fields or mailboxes that do not fit.

    While it runs: `latest` (a Mailbox) and `telemetry` (a Ring, one reader) hold records of `published`, the fields
    `loop` (LOOP) and `outputs`; `heartbeat`, `alive`, `error` and `granted` are its condition; `send` takes commands.
    `lateness` and `work` are histograms (see `realtime.loop.latency`); whole once the loop has stopped.
    """

    def __init__(  # noqa: PLR0913 - the records of the tick, and the ports of its loop by name
        self,
        tick: Callable[..., None],
        params: np.ndarray,
        state: np.ndarray,
        inputs_dtype: np.dtype,
        outputs_dtype: np.dtype,
        mailboxes: Mapping[str, Mailbox],
        *,
        clock: Clock,
        period_ns: int,
        fd: int = -1,
        telemetry_capacity: int = 8192,
        realtime: RealtimeSettings | None = None,
        run: Callable[..., int] | None = None,
    ) -> None:
        if period_ns <= 0:
            raise ValueError(f"period_ns: found {period_ns}, wanted more than 0")
        missing = [name for name in _OUTPUT_FIELDS if name not in (np.dtype(outputs_dtype).names or ())]
        if missing:
            raise ValueError(f"outputs_dtype: found no field {', '.join(missing)}, wanted {', '.join(_OUTPUT_FIELDS)}")
        self.clock, self.period_ns, self.fd = clock, period_ns, fd
        self._params, self._state, self._realtime = params, state, realtime
        self.published = np.dtype([("loop", LOOP), ("outputs", outputs_dtype)], align=True)
        self.latest, self.telemetry = Mailbox(self.published), Ring(self.published, telemetry_capacity)
        self._commands, self._sending = Ring(FRAME, _COMMANDS_WAITING), threading.Lock()
        self._inputs_dtype, self._mailboxes = np.dtype(inputs_dtype), dict(mailboxes)
        self._memory = self._allocate(clock, self.latest, self.telemetry, self._commands)
        self._run = make_loop(tick) if run is None else run
        self._prepared = False
        self._thread: threading.Thread | None = None
        self._ready = threading.Event()
        self.granted = RealtimeReport()
        self.reason = 0
        self.error: BaseException | None = None

    def _allocate(self, clock: Clock, latest: Mailbox, telemetry: Ring, commands: Ring) -> LoopMemory:
        inputs, input_words = record_with_words(self._inputs_dtype)
        published, published_words = record_with_words(self.published)
        command, command_words = record_with_words(FRAME)
        offsets = [_word_offset(self._inputs_dtype, name, box) for name, box in self._mailboxes.items()]
        if not offsets:
            raise ValueError("mailboxes: found none, wanted at least one")
        scratch = max(n_words(box.dtype) for box in self._mailboxes.values())
        return LoopMemory(
            clock=clock.words,
            control=np.zeros(CONTROL_WORDS, np.int64),
            inputs=inputs,
            input_words=input_words,
            mailboxes=tuple(box.words for box in self._mailboxes.values()),
            offsets=np.array(offsets, np.int64),
            scratch=np.zeros(scratch, np.int64),
            outputs=published["outputs"],
            loop=published["loop"],
            published=published_words,
            latest=latest.words,
            telemetry=telemetry.words,
            commands=commands.words,
            command=command,
            command_words=command_words,
            pending=np.zeros(PENDING_BYTES, np.uint8),
            pending_count=np.zeros(1, np.int64),
            frame=np.zeros(FRAME_BYTES, np.uint8),
            lateness=np.zeros(HISTOGRAM_WORDS, np.int64),
            work=np.zeros(HISTOGRAM_WORDS, np.int64),
        )

    def prepare(self) -> None:
        """Compile, and run one tick on copies with nothing sent, so that the first real one is like all others."""
        if self._prepared:
            return
        clock = Clock.virtual(self.clock.now_ns())
        memory = self._allocate(clock, Mailbox(self.published), Ring(self.published, 1), Ring(FRAME, 1))
        self._run(memory, self._params.copy(), self._state.copy(), Schedule(clock.now_ns(), self.period_ns, 1, -1))
        self._prepared = True

    def start(self, max_ticks: int = 0, first_ns: int | None = None) -> None:
        """Start the thread; the first tick is at `first_ns` on the clock (default: one period from now).

        Args: max_ticks: end after this many periods, 0: run until `stop`. Raises RuntimeError if it runs already.
        """
        if self.alive:
            raise RuntimeError("loop: found running, wanted stopped before start")
        self.prepare()
        put_word(self._memory.control, STOP, 0)
        self._ready.clear()
        self.reason, self.error = 0, None
        self._thread = threading.Thread(target=self._main, args=(max_ticks, first_ns), name="loop", daemon=True)
        self._thread.start()
        self._ready.wait()

    def _main(self, max_ticks: int, first_ns: int | None) -> None:
        try:
            with realtime_thread(self._realtime) as self.granted:
                first_ns = self.clock.now_ns() + self.period_ns if first_ns is None else first_ns
                self._ready.set()
                schedule = Schedule(first_ns, self.period_ns, max_ticks, self.fd)
                self.reason = self._run(self._memory, self._params, self._state, schedule)
        except Exception as error:  # what the tick raised: kept for the process that watches the loop
            self.error = error
        finally:
            self._ready.set()

    def stop(self) -> None:
        """Ask the loop to end, which it does within one period."""
        put_word(self._memory.control, STOP, 1)

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the thread's end; False where it still runs after `timeout_s`."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return not self.alive

    def send(self, frame: bytes) -> bool:
        """Hand over one whole encoded frame, at most 64 bytes, to be written after the next set-point.

        From any Python thread. Returns False where too many wait. Raises ValueError for a frame that is too long.
        """
        if not 0 < len(frame) <= FRAME_BYTES:
            raise ValueError(f"frame: found {len(frame)} bytes, wanted 1 to {FRAME_BYTES}")
        with self._sending:
            return self._commands.push(count=len(frame), bytes=np.frombuffer(frame.ljust(FRAME_BYTES, b"\0"), np.uint8))

    @property
    def alive(self) -> bool:
        """Whether the thread runs. It ends by `stop`, by max_ticks, or because the tick raised (`error`)."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def heartbeat(self) -> int:
        """Periods gone by since the start, missed ones included; stands still when the loop does."""
        return int(get_word(self._memory.control, HEARTBEAT))

    @property
    def lateness(self) -> np.ndarray:
        """Histogram of the time between a tick's deadline and its start: 1 us a bin at first, the maximum last."""
        return self._memory.lateness

    @property
    def work(self) -> np.ndarray:
        """Histogram of the time that a whole pass takes after waking: 0.1 us a bin at first, the maximum last."""
        return self._memory.work

    def snapshot(self) -> dict[str, Any]:
        """The LOOP record of the newest pass as a dictionary, all zero before the first."""
        loop = self.latest.read()[0]["loop"][0]
        return {name: int(loop[name]) for name in LOOP.names or ()}


def _word_offset(inputs_dtype: np.dtype, name: str, mailbox: Mailbox) -> int:
    """Where field `name` starts in the words of an input record. Raises ValueError."""
    fields: Mapping[str, Any] = inputs_dtype.fields or {}
    if name not in fields:
        raise ValueError(f"mailboxes: found {name!r}, wanted fields of the inputs: {', '.join(inputs_dtype.names or ())}")
    field, offset = fields[name][:2]
    if field != mailbox.dtype or offset % 8 or field.itemsize % 8:
        raise ValueError(f"mailboxes[{name!r}]: found {mailbox.dtype} at byte {offset}, wanted {field} on a word boundary")
    return int(offset) // 8
