"""Lock-free passing of records between one writer and its reader: the latest value (`Mailbox`) or all of them (`Ring`).

Neither side ever waits. A mailbox keeps four slots, each with its own sequence number (a seqlock per slot), and the
number of the newest complete one: a writer that is stopped in the middle of a write blocks no reader, and a reader
fails only if it is overtaken by three whole writes while it copies. Payload words are copied with atomic loads and
stores, so nothing about this relies on how the compiler orders plain accesses (Boehm, MSPC 2012, "Can seqlocks get
along with programming language memory models?"). A ring that is full refuses the new record and counts it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from realtime.loop.atomics import (
    WORD_BYTES,
    fence_acquire,
    fence_release,
    load_acquire,
    load_relaxed,
    store_relaxed,
    store_release,
)

SLOTS = 4
READ_ATTEMPTS = 8
LINE_WORDS = 8  # one cache line: writer's and reader's words never share one
NEWEST, PAYLOAD_WORDS, FIRST_SLOT = 0, 1, LINE_WORDS
HEAD, DROPPED, CAPACITY, RECORD_WORDS, TAIL, FIRST_RECORD = 0, 1, 2, 3, LINE_WORDS, 2 * LINE_WORDS


def n_words(dtype: np.dtype) -> int:
    """Number of 8-byte words that hold one record of `dtype` (a structured or plain numpy dtype)."""
    return -(-np.dtype(dtype).itemsize // WORD_BYTES)


def record_with_words(dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """One zeroed record of `dtype`, shape (1,), and the int64 words of the same memory, shape (n_words,)."""
    words = np.zeros(n_words(dtype), np.int64)
    return _record_view(words, np.dtype(dtype)), words


def words_of(record: np.ndarray) -> np.ndarray:
    """The int64 words, shape (n,), that share memory with `record`, shape (1,). Raises ValueError."""
    if record.shape != (1,) or record.dtype.itemsize % WORD_BYTES or record.ctypes.data % WORD_BYTES:
        found = f"shape {record.shape}, {record.dtype.itemsize} bytes at address {record.ctypes.data:#x}"
        raise ValueError(f"record: found {found}, wanted shape (1,), size and address multiples of {WORD_BYTES} bytes")
    return record.view(np.ndarray).view(np.int64)


def _record_view(words: np.ndarray, dtype: np.dtype) -> np.ndarray:
    record = words.view(np.uint8)[: dtype.itemsize].view(dtype)
    return record if issubclass(dtype.type, np.record) else record.view(np.recarray)


@njit(cache=True, error_model="numpy")
def _slot(words: np.ndarray, number: int) -> int:
    lines: int = words[PAYLOAD_WORDS] // LINE_WORDS + 1
    return FIRST_SLOT + (number % SLOTS) * lines * LINE_WORDS


@njit(cache=True, error_model="numpy")
def mailbox_write(words: np.ndarray, payload: np.ndarray) -> int:
    """Publish `payload` as the newest value. Only the mailbox's one writer may call it.

    Args: words (n,) int64, a `Mailbox.words`; payload (PAYLOAD_WORDS,) int64, the record's words.
    Returns: the number of values published so far, this one included.
    """
    number, count = load_relaxed(words, NEWEST) + 1, words[PAYLOAD_WORDS]
    slot = _slot(words, number)
    store_relaxed(words, slot, 0)
    fence_release()
    for i in range(count):
        store_relaxed(words, slot + 1 + i, payload[i])
    store_release(words, slot, number)
    store_release(words, NEWEST, number)
    return number


@njit(cache=True, error_model="numpy")
def mailbox_read(words: np.ndarray, scratch: np.ndarray, payload: np.ndarray) -> int:
    """Copy the newest value to `payload`; any number of readers, each with its own `scratch`.

    Args: words (n,) int64, a `Mailbox.words`; scratch and payload (>= PAYLOAD_WORDS,) int64.
    Returns: the value's number from 1 up; 0 and `payload` untouched where nothing was published, or where the writer
    overtook every one of READ_ATTEMPTS attempts.
    """
    count = words[PAYLOAD_WORDS]
    for _ in range(READ_ATTEMPTS):
        number = load_acquire(words, NEWEST)
        if number == 0:
            return 0
        slot = _slot(words, number)
        for i in range(count):
            scratch[i] = load_relaxed(words, slot + 1 + i)
        fence_acquire()
        if load_relaxed(words, slot) == number:
            for i in range(count):
                payload[i] = scratch[i]
            return number
    return 0


@njit(cache=True, error_model="numpy")
def ring_push(words: np.ndarray, payload: np.ndarray) -> bool:
    """Append one record; only the ring's one writer may call it. A full ring counts it as dropped and returns False.

    Args: words (n,) int64, a `Ring.words`; payload (>= RECORD_WORDS,) int64, the record's words.
    """
    head, count = load_relaxed(words, HEAD), words[RECORD_WORDS]
    if head - load_acquire(words, TAIL) >= words[CAPACITY]:
        store_relaxed(words, DROPPED, load_relaxed(words, DROPPED) + 1)
        return False
    first = FIRST_RECORD + (head % words[CAPACITY]) * count
    for i in range(count):
        words[first + i] = payload[i]
    store_release(words, HEAD, head + 1)
    return True


@njit(cache=True, error_model="numpy")
def ring_pop(words: np.ndarray, payload: np.ndarray) -> bool:
    """Take the oldest record; only the ring's one reader may call it. Returns False where the ring is empty.

    Args: words (n,) int64, a `Ring.words`; payload (>= RECORD_WORDS,) int64, filled with the record's words.
    """
    tail, count = load_relaxed(words, TAIL), words[RECORD_WORDS]
    if tail == load_acquire(words, HEAD):
        return False
    first = FIRST_RECORD + (tail % words[CAPACITY]) * count
    for i in range(count):
        payload[i] = words[first + i]
    store_release(words, TAIL, tail + 1)
    return True


@njit(cache=True, error_model="numpy")
def _drain(words: np.ndarray, out: np.ndarray) -> int:
    for n in range(out.shape[0]):
        if not ring_pop(words, out[n]):
            return n
    return int(out.shape[0])


class Mailbox:
    """The latest value of one structured record, from one writer to any number of readers, in any threads.

    Args: dtype, the record; words, int64 memory of `Mailbox.size(dtype)` words to use instead of its own (zeroed by
    who made it; shared between processes if it is shared memory); numbered, whether publish numbers the values.

    The writer fills `record[0]` and calls `publish()`. Where the record has a field `count` and the mailbox is numbered,
    publish sets it to the number of values published, so that a reader that copies the record sees whether it is new.
    Otherwise the writer counts: a value that is published again is not taken for a new one.
    """

    def __init__(self, dtype: np.dtype, words: np.ndarray | None = None, numbered: bool = True) -> None:
        self.dtype = np.dtype(dtype)
        self.words = np.zeros(self.size(dtype), np.int64) if words is None else words
        if self.words.shape != (self.size(dtype),) or self.words.dtype != np.int64:
            raise ValueError(f"words: found {self.words.dtype} {self.words.shape}, wanted int64 ({self.size(dtype)},)")
        self.words[PAYLOAD_WORDS] = n_words(self.dtype)
        self.record, self._staged = record_with_words(self.dtype)
        self._counted = numbered and "count" in (self.dtype.names or ())

    @staticmethod
    def size(dtype: np.dtype) -> int:
        """Words that a mailbox of `dtype` takes."""
        return FIRST_SLOT + SLOTS * (n_words(dtype) // LINE_WORDS + 1) * LINE_WORDS

    @property
    def count(self) -> int:
        """Number of values published so far."""
        return int(self.words[NEWEST])

    def publish(self, **fields: Any) -> int:
        """Publish `record[0]` after setting the `fields` given by name; only the one writer. Returns its number."""
        for name, value in fields.items():
            self.record[name][0] = value
        if self._counted:
            self.record["count"][0] = self.count + 1
        return int(mailbox_write(self.words, self._staged))

    def read(self, out: np.ndarray | None = None) -> tuple[np.ndarray, int]:
        """The newest value in `out`, shape (1,) of this dtype (or a new record), and its number; 0: nothing read."""
        record, words = record_with_words(self.dtype)
        number = int(mailbox_read(self.words, np.empty_like(words), words))
        if out is None:
            return record, number
        if number:
            out[0] = record[0]
        return out, number


class Ring:
    """Every record in order, from one writer to one reader; a full ring refuses the new one and counts it.

    Args: dtype, the record; capacity, how many it holds.
    """

    def __init__(self, dtype: np.dtype, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: found {capacity}, wanted 1 or more")
        self.dtype = np.dtype(dtype)
        self.words = np.zeros(FIRST_RECORD + capacity * n_words(self.dtype), np.int64)
        self.words[CAPACITY], self.words[RECORD_WORDS] = capacity, n_words(self.dtype)
        self.record, self._staged = record_with_words(self.dtype)

    def __len__(self) -> int:
        return int(self.words[HEAD] - self.words[TAIL])

    @property
    def dropped(self) -> int:
        """Records refused because the ring was full."""
        return int(self.words[DROPPED])

    def push(self, **fields: Any) -> bool:
        """Append `record[0]` after setting `fields`; only the one writer. False where the ring was full."""
        for name, value in fields.items():
            self.record[name][0] = value
        return bool(ring_push(self.words, self._staged))

    def drain(self) -> np.ndarray:
        """All records that wait, oldest first, shape (n,); only the one reader."""
        out = np.zeros((len(self), n_words(self.dtype)), np.int64)
        count = int(_drain(self.words, out)) if len(out) else 0
        records = out[:count].view(np.uint8)[:, : self.dtype.itemsize]
        return np.ascontiguousarray(records).view(self.dtype).reshape(-1)
