"""Words of shared memory read and written with acquire and release order, from compiled code and from Python threads.

Compiled, each function is one LLVM atomic instruction on an int64 word. With NUMBA_DISABLE_JIT=1 it is a plain
element access, which the interpreter's lock already orders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import config, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

WORD_BYTES = 8


def _word_pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    view = context.make_array(array_type)(context, builder, array)
    return cgutils.get_item_pointer(context, builder, array_type, view, [index], wraparound=False)


def _check_words(array_type: Any) -> None:
    if not (isinstance(array_type, types.Array) and array_type.dtype == types.int64 and array_type.ndim == 1):
        raise TypeError(f"words: found {array_type}, wanted a one-dimensional int64 array")


def _make_load(order: str) -> Any:
    @intrinsic
    def load(typingctx: Any, words: Any, index: Any) -> Any:
        _check_words(words)

        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = _word_pointer(context, builder, signature.args[0], args[0], args[1])
            return builder.load_atomic(pointer, order, WORD_BYTES)

        return types.int64(words, types.intp), build

    return load


def _make_store(order: str) -> Any:
    @intrinsic
    def store(typingctx: Any, words: Any, index: Any, value: Any) -> Any:
        _check_words(words)

        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = _word_pointer(context, builder, signature.args[0], args[0], args[1])
            builder.store_atomic(args[2], pointer, order, WORD_BYTES)
            return context.get_dummy_value()

        return types.void(words, types.intp, types.int64), build

    return store


def _make_fence(order: str) -> Any:
    @intrinsic
    def fence(typingctx: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.fence(order)
            return context.get_dummy_value()

        return types.void(), build

    return fence


def _plain_load(words: np.ndarray, index: int) -> int:
    return int(words[index])


def _plain_store(words: np.ndarray, index: int, value: int) -> None:
    words[index] = value


def _plain_fence() -> None:
    return None


if getattr(config, "DISABLE_JIT", False):
    load_relaxed = load_acquire = _plain_load
    store_relaxed = store_release = _plain_store
    fence_acquire = fence_release = _plain_fence
else:
    load_relaxed, load_acquire = _make_load("monotonic"), _make_load("acquire")
    store_relaxed, store_release = _make_store("monotonic"), _make_store("release")
    fence_acquire, fence_release = _make_fence("acquire"), _make_fence("release")


@njit(cache=True)
def get_word(words: np.ndarray, index: int) -> int:
    """words[index], int64, with everything written before it was put there; for Python threads."""
    return load_acquire(words, index)


@njit(cache=True)
def put_word(words: np.ndarray, index: int, value: int) -> None:
    """words[index] = value, after everything written before; for Python threads."""
    store_release(words, index, value)
