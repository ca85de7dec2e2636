"""Mailboxes and rings: what is read was written whole, in order, whoever is stopped where."""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from types import FunctionType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import config, njit

from realtime.loop import mailbox
from realtime.loop.mailbox import (
    NEWEST,
    Mailbox,
    Ring,
    mailbox_read,
    mailbox_write,
    n_words,
    record_with_words,
    ring_pop,
    ring_push,
    words_of,
)

SAMPLE = np.dtype([("count", "i8"), ("stamp_ns", "i8"), ("position_m", "f8", 3), ("flags", "u1", 5)])
SHORT = np.dtype([("words", "i8", 4)])
PLAIN = np.dtype([("words", "i8", 37)])
ROUNDS, LONG_ROUNDS = (3_000, 200) if config.DISABLE_JIT else (400_000, 400_000)


@njit(nogil=True)
def write_many(words, payload, rounds):
    for number in range(1, rounds + 1):
        for i in range(payload.shape[0]):
            payload[i] = number * 10_000 + i
        mailbox_write(words, payload)


@njit(nogil=True)
def read_until(words, payload, scratch, last):
    """Reads until the value `last` came; returns (torn, went back, reads that gave nothing after the first)."""
    torn, back, nothing, seen = 0, 0, 0, 0
    while seen < last:
        number = mailbox_read(words, scratch, payload)
        if number == 0:
            nothing += 1 if seen > 0 else 0
            continue
        for i in range(payload.shape[0]):
            torn += payload[i] != number * 10_000 + i
        back += number < seen
        seen = number
    return torn, back, nothing


@njit(nogil=True)
def push_many(words, payload, rounds):
    refused = 0
    for number in range(rounds):
        payload[:] = number
        while not ring_push(words, payload):
            refused += 1
    return refused


def run_together(*jobs) -> None:
    threads = [threading.Thread(target=job) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize(("words", "rounds"), [(37, ROUNDS), (4000, LONG_ROUNDS)])
def test_compiled_readers_never_see_a_torn_record_of_a_compiled_writer(words: int, rounds: int) -> None:
    """The long record makes readers lose the processor in the middle of a copy, and the writer overtake them."""
    box, found = Mailbox(np.dtype([("words", "i8", words)])), []

    def read() -> None:
        found.append(read_until(box.words, np.zeros(words, np.int64), np.zeros(words, np.int64), rounds))

    run_together(lambda: write_many(box.words, np.zeros(words, np.int64), rounds), read, read, read)
    assert [(torn, back) for torn, back, _ in found] == [(0, 0)] * 3


def test_python_readers_never_see_a_torn_record_of_a_compiled_writer() -> None:
    box, torn = Mailbox(PLAIN), []

    def read() -> None:
        number = 0
        while number < ROUNDS:
            record, number = box.read()
            if number and not np.array_equal(record["words"][0], number * 10_000 + np.arange(37)):
                torn.append(number)

    run_together(lambda: write_many(box.words, np.zeros(37, np.int64), ROUNDS), read, read)
    assert torn == []


def test_a_compiled_reader_never_sees_a_torn_record_of_a_python_writer() -> None:
    box, found, rounds = Mailbox(PLAIN), [], min(ROUNDS, 20_000)

    def write() -> None:
        for number in range(1, rounds + 1):
            box.publish(words=number * 10_000 + np.arange(37))

    run_together(write, lambda: found.append(read_until(box.words, np.zeros(37, np.int64), np.zeros(37, np.int64), rounds)))
    assert found[0][:2] == (0, 0)


class Stopped(Exception):
    """The thread under test stops here, for good."""


def interpreted(function: Any, at_access: Callable[[], None]) -> Callable[..., int]:
    """`function` of realtime.loop.mailbox as plain Python, with `at_access()` called before every access to shared words."""

    def load(words: np.ndarray, index: int) -> int:
        at_access()
        return int(words[index])

    def store(words: np.ndarray, index: int, value: int) -> None:
        at_access()
        words[index] = value

    replaced = {
        "load_relaxed": load,
        "load_acquire": load,
        "store_relaxed": store,
        "store_release": store,
        "fence_acquire": lambda: None,
        "fence_release": lambda: None,
    }
    code = getattr(function, "py_func", function).__code__
    return FunctionType(code, {**vars(mailbox), **replaced})


def filled(values: int) -> Mailbox:
    box = Mailbox(SHORT)
    for number in range(1, values + 1):
        box.publish(words=number)
    return box


@pytest.mark.parametrize("stop_at", range(9))
def test_wherever_a_writer_stops_readers_get_a_whole_value(stop_at: int) -> None:
    box, left = filled(5), iter(range(stop_at))

    def at_access() -> None:
        if next(left, None) is None:
            raise Stopped

    with suppress(Stopped):
        interpreted(mailbox_write, at_access)(box.words, np.full(4, 6))
    assert box.read()[1] in (5, 6)
    for outdated in range(2, 7):  # a reader that took the newest number some writes ago
        box.words[NEWEST] = outdated
        record, number = box.read()
        assert number in (0, outdated)
        assert number == 0 or (record["words"][0] == number).all()


@pytest.mark.parametrize("writes", range(10))
@pytest.mark.parametrize("interrupted_at", range(7))
def test_whatever_happens_during_a_read_it_gives_a_whole_value(interrupted_at: int, writes: int) -> None:
    box, accesses = filled(3), count()

    def at_access() -> None:
        if next(accesses) == interrupted_at:
            for _ in range(writes):
                box.publish(words=box.count + 1)

    payload = np.full(4, -1)
    number = interpreted(mailbox_read, at_access)(box.words, np.zeros(4, np.int64), payload)
    assert (payload == (number or -1)).all()
    assert number > 0


def test_a_reader_that_is_overtaken_at_every_step_gives_up_and_leaves_the_record_alone() -> None:
    box, payload = filled(3), np.full(4, -1)

    def at_access() -> None:
        for _ in range(4):
            box.publish(words=box.count + 1)

    assert interpreted(mailbox_read, at_access)(box.words, np.zeros(4, np.int64), payload) == 0
    assert (payload == -1).all()


def test_a_slot_that_changed_while_it_was_copied_is_refused_and_leaves_the_record_alone() -> None:
    box = Mailbox(PLAIN)
    write_many(box.words, np.zeros(37, np.int64), 2)
    box.words[NEWEST] = 7  # a reader that holds an outdated number: the slot of 7 holds no value 7
    payload = np.full(37, -1)
    assert mailbox_read(box.words, np.zeros(37, np.int64), payload) == 0
    assert (payload == -1).all()


@given(
    st.lists(
        st.one_of(
            st.just("read"), st.tuples(st.integers(-(2**63), 2**63 - 1), st.floats(), st.binary(min_size=5, max_size=5))
        ),
        max_size=30,
    )
)
@settings(deadline=None, max_examples=60)
def test_a_mailbox_gives_what_was_published_last(steps: list) -> None:
    box, last, published = Mailbox(SAMPLE), None, 0
    for step in steps:
        if step != "read":
            published += 1
            assert box.publish(stamp_ns=step[0], position_m=step[1], flags=np.frombuffer(step[2], "u1")) == published
            last = step
            continue
        record, number = box.read()
        assert number == published == record["count"][0]
        if last is not None:
            assert record["stamp_ns"][0] == last[0]
            assert record["position_m"].tobytes() == np.full(3, last[1]).tobytes()
            assert record["flags"].tobytes() == last[2]


@given(st.integers(1, 5), st.lists(st.one_of(st.just("drain"), st.integers(-(2**62), 2**62)), max_size=40))
@settings(deadline=None, max_examples=60)
def test_a_ring_keeps_order_and_counts_what_it_refuses(capacity: int, steps: list) -> None:
    ring, model, dropped = Ring(SAMPLE, capacity), deque(), 0
    for step in [*steps, "drain"]:
        if step == "drain":
            out = ring.drain()
            assert out.dtype == SAMPLE and list(out["stamp_ns"]) == list(model)
            model.clear()
            continue
        fits = len(model) < capacity
        assert ring.push(stamp_ns=step) is fits
        if fits:
            model.append(step)
        else:
            dropped += 1
        assert (len(ring), ring.dropped) == (len(model), dropped)


def test_a_ring_between_threads_loses_nothing_that_it_took() -> None:
    ring, taken, refused = Ring(PLAIN, 64), [], []
    rounds = min(ROUNDS, 20_000)

    def take() -> None:
        while not taken or taken[-1] != rounds - 1:
            out = ring.drain()
            assert (out["words"] == out["words"][:, :1]).all()
            taken.extend(out["words"][:, 0].tolist())

    run_together(lambda: refused.append(push_many(ring.words, np.zeros(37, np.int64), rounds)), take)
    assert taken == list(range(rounds))
    assert ring.dropped == refused[0]


def test_an_empty_ring_gives_nothing_and_leaves_the_record_alone() -> None:
    payload = np.full(37, -1)
    assert not ring_pop(Ring(PLAIN, 2).words, payload)
    assert (payload == -1).all()


def test_memory_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="words: found"):
        Mailbox(PLAIN, np.zeros(3, np.int64))
    with pytest.raises(ValueError, match="capacity: found 0"):
        Ring(PLAIN, 0)
    with pytest.raises(ValueError, match="record: found shape"):
        words_of(np.zeros(2, PLAIN))


def test_two_mailboxes_on_the_same_words_are_one() -> None:
    writer = Mailbox(PLAIN)
    reader = Mailbox(PLAIN, writer.words)
    writer.publish(words=np.arange(37))
    assert list(reader.read()[0]["words"][0]) == list(range(37))


def test_record_and_words_share_memory() -> None:
    record, words = record_with_words(SAMPLE)
    words[1] = 77
    assert record["stamp_ns"][0] == 77 and n_words(SAMPLE) * 8 >= SAMPLE.itemsize
