"""Frames survive the line whole or not at all."""

import re
from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocol.serial_codec import AnyFrame, StreamDecoder, cobs_decode, cobs_encode, crc16, encode
from protocol.serial_frames import FRAME_BY_NAME, FRAMES, Field, Frame

_RANGES = {"u8": (0, 2**8 - 1), "u16": (0, 2**16 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31), 2**31 - 1)}


def values_of(field: Field) -> st.SearchStrategy:
    one = st.integers(*_RANGES[field.wire])
    return one if field.count == 1 else st.tuples(*[one] * field.count)


def messages_of(frame: Frame) -> st.SearchStrategy[AnyFrame]:
    fields = st.fixed_dictionaries({f.name: values_of(f) for f in frame.fields})
    return st.builds(AnyFrame, st.just(frame.name), st.integers(0, 255), fields)


any_message = st.sampled_from(FRAMES).flatmap(messages_of)


def wire(message: AnyFrame) -> bytes:
    return encode(message.name, message.sequence, **message.fields)


def numbered(messages: list[AnyFrame]) -> list[AnyFrame]:
    return [m._replace(sequence=i & 0xFF) for i, m in enumerate(messages)]


def test_crc_check_value() -> None:
    assert crc16(b"123456789") == 0x29B1


def test_a_known_frame() -> None:
    body = bytes.fromhex("03 07 2c 01")
    crc = crc16(body)
    assert encode("ARM", 7, boot_count=300) == bytes((7,)) + body + bytes((crc >> 8, crc & 255)) + b"\0"


@given(st.binary(max_size=600))
def test_cobs_round_trip(data: bytes) -> None:
    coded = cobs_encode(data)
    assert 0 not in coded
    assert cobs_decode(coded) == data


@given(any_message)
def test_round_trip(message: AnyFrame) -> None:
    assert StreamDecoder().feed(wire(message)) == [message]


@given(st.lists(any_message, max_size=8), st.lists(st.integers(1, 40), min_size=1))
def test_any_portions(messages: list[AnyFrame], sizes: list[int]) -> None:
    messages = numbered(messages)
    stream = b"".join(map(wire, messages))
    decoder, out, at, turn = StreamDecoder(), [], 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        out += decoder.feed(stream[at : at + size])
        at, turn = at + size, turn + 1
    assert out == messages
    assert decoder.counters.crc_errors == decoder.counters.lost == decoder.counters.repeated == 0


@st.composite
def damaged_stream(draw: st.DrawFn) -> tuple[list[AnyFrame], bytes]:
    """Frames of which some are flipped, cut, doubled, swapped or dropped, and what was sent."""
    messages = numbered(draw(st.lists(any_message, min_size=1, max_size=6)))
    pieces = [bytearray(wire(m)) for m in messages]
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(pieces) - 1))
        kind = draw(st.sampled_from(["flip", "cut", "double", "swap", "drop", "insert"]))
        if kind == "flip" and pieces[at]:
            pieces[at][draw(st.integers(0, len(pieces[at]) - 1))] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del pieces[at][draw(st.integers(0, len(pieces[at]))) :]
        elif kind == "double":
            pieces.insert(at, bytearray(pieces[at]))
        elif kind == "swap":
            other = draw(st.integers(0, len(pieces) - 1))
            pieces[at], pieces[other] = pieces[other], pieces[at]
        elif kind == "drop" and len(pieces) > 1:
            del pieces[at]
        elif kind == "insert":
            pieces[at] += draw(st.binary(max_size=20))
    return messages, b"".join(pieces)


@given(damaged_stream())
def test_nothing_arrives_that_was_not_sent(case: tuple[list[AnyFrame], bytes]) -> None:
    sent, stream = case
    out = StreamDecoder().feed(stream)
    assert all(message in sent for message in out)
    assert all(a != b for a, b in pairwise(out)), "a doubled frame came through twice"


@given(any_message, any_message, st.data())
def test_damage_is_counted_and_the_next_frame_arrives(first: AnyFrame, second: AnyFrame, data: st.DataObject) -> None:
    decoder = StreamDecoder()
    decoder.feed(encode("PING", 255))
    raw = bytearray(wire(first._replace(sequence=0)))
    raw[data.draw(st.integers(0, len(raw) - 2))] ^= 1 << data.draw(st.integers(0, 7))
    assume(0 not in raw[:-1])
    out = decoder.feed(bytes(raw) + wire(second._replace(sequence=1)))
    assert out == [second._replace(sequence=1)]
    assert decoder.counters.crc_errors == 1 and decoder.counters.lost == 1


def test_a_port_opened_in_mid_frame_is_no_error() -> None:
    decoder = StreamDecoder()
    whole = encode("PING", 4)
    assert [m.name for m in decoder.feed(encode("ARM", 3, boot_count=1)[3:] + whole)] == ["PING"]
    assert decoder.counters.crc_errors == 0


def test_endless_noise_takes_no_memory() -> None:
    decoder = StreamDecoder()
    for _ in range(100):
        assert decoder.feed(b"\x01" * 10_000) == []
    assert len(decoder._pending) < 100
    assert [m.name for m in decoder.feed(b"\0" + encode("PING", 0))] == ["PING"]


def test_a_restarted_sender_is_heard() -> None:
    decoder = StreamDecoder()
    decoder.feed(b"".join(encode("PING", n) for n in range(100, 200)))
    assert len(decoder.feed(encode("PING", 150))) == 1
    assert decoder.counters.restarts == 1


@pytest.mark.parametrize(
    ("name", "fields", "says"),
    [
        ("NOTHING", {}, "wanted one of"),
        ("ARM", {}, "wanted ['boot_count']"),
        ("ARM", {"boot_count": 1, "speed": 2}, "wanted ['boot_count']"),
        ("ARM", {"boot_count": 65536}, "wire types"),
        ("ARM", {"boot_count": 1.5}, "wire types"),
        ("SETPOINT", {"number": 1, "execute_us": 2, "expiry_us": 3, "position_steps": (1, 2)}, "wire types"),
    ],
)
def test_bad_fields_are_refused(name: str, fields: dict, says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        encode(name, 0, **fields)


def test_every_frame_is_in_the_index() -> None:
    assert list(FRAME_BY_NAME.values()) == list(FRAMES)
