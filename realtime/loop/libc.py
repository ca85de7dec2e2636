"""The C library calls that the compiled loop makes: clock, absolute-time sleep, write. No interpreter, no lock.

Resolved by name, so that code calling them can be cached on disk. With NUMBA_DISABLE_JIT=1 the standard library's
functions of the same meaning stand in.
"""

from __future__ import annotations

import errno
import os
import time
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
NS_PER_S = 1_000_000_000

_I32, _I64, _POINTER = ir.IntType(32), ir.IntType(64), ir.IntType(8).as_pointer()
_TIMESPEC = ir.LiteralStructType([_I64, _I64])


def _call(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    signature = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), arguments)


@intrinsic
def _monotonic_ns(typingctx: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        timespec = cgutils.alloca_once(builder, _TIMESPEC)
        _call(builder, "clock_gettime", _I32, [_I32(CLOCK_MONOTONIC), builder.bitcast(timespec, _POINTER)])
        seconds, nanoseconds = cgutils.unpack_tuple(builder, builder.load(timespec))
        return builder.add(builder.mul(seconds, _I64(NS_PER_S)), nanoseconds)

    return types.int64(), build


@intrinsic
def _sleep_until_ns(typingctx: Any, deadline_ns: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        timespec = cgutils.alloca_once(builder, _TIMESPEC)
        parts = [builder.sdiv(args[0], _I64(NS_PER_S)), builder.srem(args[0], _I64(NS_PER_S))]
        builder.store(cgutils.pack_struct(builder, parts), timespec)
        pointer = builder.bitcast(timespec, _POINTER)
        arguments = [_I32(CLOCK_MONOTONIC), _I32(TIMER_ABSTIME), pointer, ir.Constant(_POINTER, None)]
        return _call(builder, "clock_nanosleep", _I32, arguments)

    return types.int32(types.int64), build


@intrinsic
def _write_bytes(typingctx: Any, fd: Any, buffer: Any, first: Any, count: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.args[1])(context, builder, args[1])
        start = builder.gep(builder.bitcast(view.data, _POINTER), [args[2]], source_etype=ir.IntType(8))
        written = _call(builder, "write", _I64, [args[0], start, args[3]])
        location = _call(builder, "__errno_location", _I32.as_pointer(), [])
        failed = builder.icmp_signed("<", written, _I64(0))
        number = builder.sext(builder.load(location, typ=_I32), _I64)
        return builder.select(failed, builder.neg(number), written)

    return types.int64(types.int32, buffer, types.int64, types.int64), build


def _plain_sleep_until_ns(deadline_ns: int) -> int:
    time.sleep(max(0, deadline_ns - time.monotonic_ns()) / NS_PER_S)
    return 0


def _plain_write_bytes(fd: int, buffer: np.ndarray, first: int, count: int) -> int:
    try:
        return os.write(fd, buffer[first : first + count].tobytes())
    except OSError as error:
        return -(error.errno or errno.EIO)


_COMPILED = not getattr(config, "DISABLE_JIT", False)
monotonic_ns: Any = _monotonic_ns if _COMPILED else time.monotonic_ns
sleep_until_ns: Any = _sleep_until_ns if _COMPILED else _plain_sleep_until_ns
write_bytes: Any = _write_bytes if _COMPILED else _plain_write_bytes
