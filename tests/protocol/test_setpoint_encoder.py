"""The compiled encoder writes the bytes of the codec."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from protocol.serial_codec import encode
from protocol.setpoint_encoder import BUFFER_BYTES, SETPOINT_WIRE_BYTES, encode_setpoint

steps = st.integers(-(2**31), 2**31 - 1) | st.integers(-300, 300)


@given(
    st.integers(0, 255),
    st.integers(0, 2**20),
    st.integers(-(2**40), 2**40),
    st.integers(-5, 70_000),
    st.tuples(steps, steps, steps),
)
def test_same_bytes_as_the_codec(
    sequence: int, number: int, execute_us: int, expiry_us: int, position: tuple[int, int, int]
) -> None:
    buffer = np.full(BUFFER_BYTES, 0xAA, np.uint8)
    n = encode_setpoint(buffer, sequence, number, execute_us, expiry_us, np.array(position, np.int64))
    assert bytes(buffer[:n]) == encode(
        "SETPOINT",
        sequence,
        number=number % 2**16,
        execute_us=execute_us % 2**32,
        expiry_us=min(max(expiry_us, 0), 65535),
        position_steps=position,
    )
    assert n == SETPOINT_WIRE_BYTES
    assert (buffer[n:] == 0xAA).all()


def test_a_position_that_does_not_fit_is_not_sent() -> None:
    buffer = np.zeros(BUFFER_BYTES, np.uint8)
    assert encode_setpoint(buffer, 0, 0, 0, 0, np.array([0, 2**31, 0])) == 0
    assert encode_setpoint(buffer, 0, 0, 0, 0, np.array([0, 0, -(2**31) - 1])) == 0


def test_runs_without_the_compiler() -> None:
    buffer, reference = np.zeros((2, BUFFER_BYTES), np.uint8)
    position = np.array([1, -2, 70_000])
    n = encode_setpoint(reference, 250, 65535, 2**32 - 1, 5, position)
    plain = getattr(encode_setpoint, "py_func", encode_setpoint)
    assert plain(buffer, 250, 65535, 2**32 - 1, 5, position) == n
    assert (buffer == reference).all()
