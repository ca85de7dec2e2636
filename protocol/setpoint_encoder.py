"""SETPOINT frames written by compiled code, for the loop that runs without the interpreter."""

import numpy as np
from numba import njit

from protocol.serial_frames import AXIS_COUNT, FRAME_BY_NAME, wire_bytes

SETPOINT_ID = FRAME_BY_NAME["SETPOINT"].id
SETPOINT_WIRE_BYTES = wire_bytes(FRAME_BY_NAME["SETPOINT"])
BUFFER_BYTES = 64


@njit(cache=True, nogil=True)
def _put(buffer: np.ndarray, at: int, value: int, n_bytes: int) -> int:
    for _ in range(n_bytes):
        buffer[at] = value & 0xFF
        value >>= 8
        at += 1
    return at


@njit(cache=True, nogil=True)
def _crc16(buffer: np.ndarray, start: int, stop: int) -> int:
    crc = 0xFFFF
    for i in range(start, stop):
        x = (crc >> 8) ^ int(buffer[i])
        x ^= x >> 4
        crc = ((crc << 8) ^ (x << 12) ^ (x << 5) ^ x) & 0xFFFF
    return crc


@njit(cache=True, nogil=True)
def _stuff(buffer: np.ndarray, stop: int) -> None:
    """COBS in place: buffer[1:stop] holds the body, buffer[0] is free; bodies stay below 254 bytes."""
    code_at = 0
    for i in range(1, stop):
        if buffer[i] == 0:
            buffer[code_at] = i - code_at
            code_at = i
    buffer[code_at] = stop - code_at
    buffer[stop] = 0


@njit(cache=True, nogil=True)
def encode_setpoint(
    buffer: np.ndarray, sequence: int, number: int, execute_us: int, expiry_us: int, steps: np.ndarray
) -> int:
    """Writes one SETPOINT frame with its delimiter; same bytes as serial_codec.encode.

    buffer: u1[>= SETPOINT_WIRE_BYTES], overwritten from the start. sequence, number, execute_us: taken modulo
    their wire width (execute_us is board time, which wraps). expiry_us: clipped to 0..65535.
    steps: i8[3] positions, int32 range. Returns the number of bytes written, or 0 when a position does not fit
    (nothing is to be sent then).
    """
    for axis in range(AXIS_COUNT):
        if steps[axis] < -2147483648 or steps[axis] > 2147483647:
            return 0
    buffer[1] = SETPOINT_ID
    at = _put(buffer, 2, sequence, 1)
    at = _put(buffer, at, number, 2)
    at = _put(buffer, at, execute_us, 4)
    at = _put(buffer, at, min(max(expiry_us, 0), 65535), 2)
    for axis in range(AXIS_COUNT):
        at = _put(buffer, at, steps[axis], 4)
    crc = _crc16(buffer, 1, at)
    at = _put(buffer, at, crc >> 8, 1)
    at = _put(buffer, at, crc, 1)
    _stuff(buffer, at)
    return at + 1
