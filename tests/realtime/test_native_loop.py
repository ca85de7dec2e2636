"""The compiled loop: every period ticked or counted as missed, frames whole, undisturbed by Python, stopped on request."""

import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numba import config, njit

from protocol.serial_codec import StreamDecoder, encode
from realtime.control.records import INPUTS, OUTPUTS, PARAMS, POSE, STATE, new
from realtime.loop.atomics import load_acquire, store_release
from realtime.loop.clock import NOW, Clock
from realtime.loop.loop_thread import NativeLoop, input_mailboxes
from realtime.loop.mailbox import Mailbox
from realtime.loop.native_loop import GAP_PLACES, HEARTBEAT, LOOP, STOPPED, TICKS_DONE, _note_gap, count_in
from tests.waiting import PATIENCE_S

PERIOD_NS = 1_000_000


@njit
def counting_tick(params, state, inputs, outputs):
    """Sends its own number as positions, and hands the newest tip through."""
    s, u, y = state[0], inputs[0], outputs[0]
    s.ticks += 1
    y.now_ns, y.valid, y.number, y.execute_us, y.expiry_us = u.now_ns, 1, s.ticks & 0xFFFF, u.now_ns // 1000, 5000
    for axis in range(3):
        y.position_steps[axis] = s.ticks * (axis + 1)
        y.tip_m[axis] = u.tip.position_m[axis]


@njit
def failing_tick(params, state, inputs, outputs):
    state[0].ticks += 1
    if state[0].ticks == 3:
        raise ValueError("tick three")


def make(tick=counting_tick, clock: Clock | None = None, **options) -> tuple[NativeLoop, dict[str, Mailbox]]:
    boxes = input_mailboxes(INPUTS)
    loop = NativeLoop(
        tick, new(PARAMS), new(STATE), INPUTS, OUTPUTS, boxes, clock=clock or Clock.virtual(), period_ns=PERIOD_NS, **options
    )
    return loop, boxes


@njit(nogil=True)
def hand_out(clock, control, start_ns, periods):
    """A world without the interpreter: gives one period of time, waits for the loop, gives the next."""
    for k in range(1, periods + 1):
        store_release(clock, NOW, start_ns + k * PERIOD_NS)
        while load_acquire(control, HEARTBEAT) < k:
            pass


def wait_for_heartbeat(loop: NativeLoop, periods: int) -> None:
    while loop.heartbeat < periods and loop.alive:
        time.sleep(1e-4)
    assert loop.heartbeat == periods


@contextmanager
def stormy_interpreter() -> Iterator[None]:
    """Garbage collections without pause and threads that never let go of the interpreter of their own will."""
    over = threading.Event()

    def collect() -> None:
        while not over.is_set():
            ring: list = [{} for _ in range(2000)]
            ring.append(ring)
            gc.collect()

    def spin() -> None:
        while not over.is_set():
            sum(i * i for i in range(20_000))

    threads = [threading.Thread(target=job) for job in (collect, spin, spin)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def test_every_virtual_period_is_ticked_once_and_none_missed_in_a_storm() -> None:
    clock, periods = Clock.virtual(500), 100 if config.DISABLE_JIT else 5000
    loop, _ = make(clock=clock)
    hand_out(clock.words, loop._memory.control, 500, 0)
    loop.start()
    with stormy_interpreter():
        hand_out(clock.words, loop._memory.control, 500, periods)
    loop.stop()
    assert loop.join(PATIENCE_S) and loop.reason == STOPPED
    records, numbers = loop.telemetry.drain(), np.arange(1, periods + 1)
    assert (records["outputs"]["now_ns"] == 500 + numbers * PERIOD_NS).all()
    assert (records["loop"]["tick"] == numbers).all()
    assert loop.snapshot()["missed"] == 0 and loop.lateness[:-1].sum() == periods == loop.work[:-1].sum()


def test_wall_clock_periods_are_ticked_or_counted_as_missed_in_a_storm() -> None:
    loop, _ = make(clock=Clock.monotonic())
    loop.prepare()
    with stormy_interpreter():
        loop.start(max_ticks=300)
        loop.join()
    last = loop.snapshot()
    assert loop.reason == TICKS_DONE and loop.error is None
    assert last["tick"] + last["missed"] == 300 == loop.heartbeat
    assert loop.lateness[:-1].sum() == last["tick"]
    times = loop.telemetry.drain()["outputs"]["now_ns"]
    assert (np.diff(times) >= PERIOD_NS).all() and (np.diff(times) % PERIOD_NS == 0).all()


def test_late_periods_are_skipped_and_counted_never_caught_up() -> None:
    clock = Clock.virtual()
    loop, _ = make(clock=clock)
    loop.start()
    clock.advance_to(PERIOD_NS)
    wait_for_heartbeat(loop, 1)
    clock.advance_to(10 * PERIOD_NS + PERIOD_NS // 2)
    wait_for_heartbeat(loop, 10)
    clock.advance_to(11 * PERIOD_NS)
    wait_for_heartbeat(loop, 11)
    loop.stop()
    loop.join()
    records = loop.telemetry.drain()
    assert list(records["loop"]["deadline_ns"] // PERIOD_NS) == [1, 10, 11]
    assert list(records["loop"]["lateness_ns"]) == [0, 8 * PERIOD_NS + PERIOD_NS // 2, 0]
    assert loop.snapshot()["missed"] == 8


def step(loop: NativeLoop, clock: Clock, periods: int) -> None:
    for _ in range(periods):
        clock.advance_to(clock.now_ns() + PERIOD_NS)
        wait_for_heartbeat(loop, clock.now_ns() // PERIOD_NS)


def test_inputs_reach_the_tick_and_outputs_the_latest_mailbox() -> None:
    clock = Clock.virtual()
    loop, boxes = make(clock=clock)
    loop.start()
    for k in range(1, 6):
        boxes["tip"].publish(position_m=(k, 2 * k, 3 * k))
        step(loop, clock, 1)
        record, number = loop.latest.read()
        assert number == k and list(record["outputs"]["tip_m"][0]) == [k, 2 * k, 3 * k]
    loop.stop()
    loop.join()


def test_set_points_and_commands_arrive_whole_and_in_order() -> None:
    out, line = os.pipe()
    os.set_blocking(line, False)
    clock = Clock.virtual()
    loop, _ = make(clock=clock, fd=line)
    loop.start()
    for k in range(20):
        assert loop.send(encode("PING", k))
        step(loop, clock, 1)
    loop.stop()
    loop.join()
    os.close(line)
    messages = StreamDecoder().feed(os.read(out, 1 << 16))
    os.close(out)
    points = [m for m in messages if m.name == "SETPOINT"]
    assert [m.fields["number"] for m in points] == list(range(1, 21)) == [m.sequence for m in points]
    assert [m.fields["position_steps"] for m in points] == [(k, 2 * k, 3 * k) for k in range(1, 21)]
    assert [m.fields["execute_us"] for m in points] == [k * 1000 for k in range(1, 21)]
    assert [m.sequence for m in messages if m.name == "PING"] == list(range(20))


def test_a_line_that_takes_nothing_costs_set_points_and_tears_no_frame() -> None:
    out, line = os.pipe()
    os.set_blocking(line, False)
    filler = 0
    try:
        while True:
            filler += os.write(line, b"\0")
    except BlockingIOError:
        pass
    clock = Clock.virtual()
    loop, _ = make(clock=clock, fd=line)
    loop.start()
    step(loop, clock, 50)
    blocked = loop.snapshot()
    os.read(out, filler)
    step(loop, clock, 50)
    loop.stop()
    loop.join()
    os.close(line)
    decoder = StreamDecoder()
    numbers = [m.fields["number"] for m in decoder.feed(os.read(out, 1 << 16))]
    os.close(out)
    last = loop.snapshot()
    assert blocked["refused"] > 0 and last["refused"] == blocked["refused"]
    assert last["sent"] + last["refused"] == 100 and last["write_error"] == 0
    assert decoder.counters.crc_errors == 0 and len(numbers) == last["sent"]
    assert numbers == sorted(numbers) and numbers[-50:] == list(range(51, 101))


def test_a_line_that_is_gone_is_told_and_does_not_end_the_loop() -> None:
    out, line = os.pipe()
    os.set_blocking(line, False)
    os.close(line)
    os.close(out)
    clock = Clock.virtual()
    loop, _ = make(clock=clock, fd=line)
    loop.start()
    step(loop, clock, 3)
    loop.stop()
    loop.join()
    assert loop.snapshot()["write_error"] == 9 and loop.snapshot()["tick"] == 3


def test_what_the_tick_raises_ends_the_loop_and_is_kept() -> None:
    clock = Clock.virtual()
    loop, _ = make(failing_tick, clock=clock)
    loop.start()
    clock.advance_to(PERIOD_NS)
    wait_for_heartbeat(loop, 1)
    clock.advance_to(2 * PERIOD_NS)
    wait_for_heartbeat(loop, 2)
    clock.advance_to(3 * PERIOD_NS)
    assert loop.join(PATIENCE_S) and not loop.alive
    assert isinstance(loop.error, ValueError) and loop.heartbeat == 2


def test_preparing_changes_nothing_and_sends_nothing() -> None:
    out, line = os.pipe()
    os.set_blocking(out, False)
    loop, _ = make(clock=Clock.monotonic(), fd=line)
    loop.prepare()
    assert loop.heartbeat == 0 and len(loop.telemetry) == 0 and loop.snapshot()["tick"] == 0
    with pytest.raises(BlockingIOError):
        os.read(out, 1)
    os.close(line)
    os.close(out)


def test_a_full_telemetry_ring_is_counted() -> None:
    clock = Clock.virtual()
    loop, _ = make(clock=clock, telemetry_capacity=4)
    loop.start()
    step(loop, clock, 10)
    loop.stop()
    loop.join()
    assert len(loop.telemetry) == 4 and loop.telemetry.dropped == 6 == loop.snapshot()["telemetry_dropped"]


def test_a_loop_can_be_started_again_but_not_twice() -> None:
    clock = Clock.virtual()
    loop, _ = make(clock=clock)
    loop.start()
    with pytest.raises(RuntimeError, match="found running"):
        loop.start()
    loop.stop()
    assert loop.join(PATIENCE_S)
    loop.start(max_ticks=2)
    clock.advance_to(PERIOD_NS)
    clock.advance_to(2 * PERIOD_NS)
    assert loop.join(PATIENCE_S) and loop.reason == TICKS_DONE


@pytest.mark.parametrize(
    ("previous", "lateness_ns", "place"),
    [
        ({"tick_ns": 10, "exchange_ns": 20}, 5_000, "woken late"),
        ({"tick_ns": 9_000, "exchange_ns": 20}, 8_000, "in the tick"),
        ({"tick_ns": 10, "exchange_ns": 9_000}, 8_000, "in the exchange"),
    ],
)
def test_the_longest_gap_names_its_place(previous: dict, lateness_ns: int, place: str) -> None:
    loop = np.zeros(1, LOOP).view(np.recarray)[0]
    loop.woke_ns, loop.tick = 1_000, 7
    loop.tick_ns, loop.exchange_ns = previous["tick_ns"], previous["exchange_ns"]
    _note_gap(loop, 11_000, lateness_ns)
    assert (loop.longest_gap_ns, loop.longest_gap_at_ns, loop.longest_gap_tick) == (10_000, 11_000, 7)
    assert GAP_PLACES[loop.longest_gap_place] == place
    loop.woke_ns = 11_000
    _note_gap(loop, 12_000, lateness_ns)
    assert loop.longest_gap_ns == 10_000


def test_histograms_count_everything_and_keep_the_exact_maximum() -> None:
    histogram = np.zeros(12, np.int64)
    for value in (-5, 0, 99, 100, 999, 1_000, 123_456):
        count_in(histogram, 100, value)
    assert list(histogram) == [3, 1, 0, 0, 0, 0, 0, 0, 0, 1, 2, 123_456]


def test_records_that_do_not_fit_are_refused() -> None:
    def build(boxes: dict, outputs: np.dtype = OUTPUTS, period_ns: int = PERIOD_NS) -> None:
        NativeLoop(
            counting_tick, new(PARAMS), new(STATE), INPUTS, outputs, boxes, clock=Clock.virtual(), period_ns=period_ns
        )

    with pytest.raises(ValueError, match="found none, wanted at least one"):
        build({})
    with pytest.raises(ValueError, match="mailboxes: found 'tap'"):
        build({"tap": Mailbox(POSE)})
    with pytest.raises(ValueError, match=r"mailboxes\['sensor'\]"):
        build({"sensor": Mailbox(POSE)})
    with pytest.raises(ValueError, match="found no field valid"):
        build({"tip": Mailbox(POSE)}, STATE)
    with pytest.raises(ValueError, match="period_ns: found 0"):
        build({"tip": Mailbox(POSE)}, period_ns=0)
    with pytest.raises(ValueError, match="found 65 bytes"):
        make()[0].send(b"x" * 65)


@pytest.mark.slow
@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled with NUMBA_DISABLE_JIT=1")
def test_the_compiled_loop_calls_neither_the_interpreter_nor_an_allocator() -> None:
    listed = subprocess.run(
        [sys.executable, "-m", "tests.realtime.list_compiled_calls"],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert {"clock_gettime", "clock_nanosleep", "write"} <= set(listed)
    forbidden = (
        "Py",
        "NRT_Allocate",
        "NRT_MemInfo_alloc",
        "NRT_Reallocate",
        "malloc",
        "calloc",
        "realloc",
        "numba_gil",
        "numba_unpickle",
        "numba_raise",
        "pthread",
        "puts",
        "printf",
    )
    assert [name for name in listed if name.startswith(forbidden)] == []
