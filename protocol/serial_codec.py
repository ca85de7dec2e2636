"""Bytes of the serial link: COBS framing, CRC-16, sequence numbers; frames in and out."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from protocol.serial_frames import FRAME_BY_ID, FRAME_BY_NAME, FRAMES, MAX_BODY_BYTES, Frame

DELIMITER = b"\x00"
_WIRE_FORMAT = {"u8": "B", "u16": "H", "u32": "I", "i32": "i"}


def _layout(frame: Frame) -> struct.Struct:
    return struct.Struct("<" + "".join(f"{f.count}{_WIRE_FORMAT[f.wire]}" for f in frame.fields))


_LAYOUTS = {frame.name: _layout(frame) for frame in FRAMES}


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF, not reflected); check value of b"123456789" is 0x29B1."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire & Baker 1999): the same data without a zero byte, no delimiter."""
    out = bytearray()
    for run in data.split(DELIMITER):
        while len(run) >= 254:
            out += b"\xff" + run[:254]
            run = run[254:]
        out += bytes((len(run) + 1,)) + run
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """Inverse of cobs_encode. Raises ValueError where a code byte is zero or points past the end."""
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        end = at + code
        if code == 0 or end > len(data):
            raise ValueError(f"COBS code at byte {at}: found {code}, wanted 1 to {len(data) - at}")
        out += data[at + 1 : end]
        if code < 255 and end < len(data):
            out.append(0)
        at = end
    return bytes(out)


class AnyFrame(NamedTuple):
    """A frame that arrived whole: its name, sequence number and fields as on the wire (arrays as tuples)."""

    name: str
    sequence: int
    fields: dict[str, Any]


def encode(frame_name: str, sequence: int, **fields: Any) -> bytes:
    """One frame with its delimiter, ready for the line.

    Arguments: name in FRAME_BY_NAME; sequence (taken modulo 256); every field of the frame, integers in wire units.
    Raises ValueError when a field is missing, unknown or does not fit its wire type.
    """
    frame = FRAME_BY_NAME.get(frame_name)
    if frame is None:
        raise ValueError(f"frame_name: found {frame_name!r}, wanted one of {', '.join(FRAME_BY_NAME)}")
    names = [f.name for f in frame.fields]
    if set(names) != set(fields):
        raise ValueError(f"{frame_name}: found fields {sorted(fields)}, wanted {sorted(names)}")
    values: list[int] = []
    for field in frame.fields:
        value = fields[field.name]
        values.extend(value if field.count > 1 else (value,))
    try:
        payload = _LAYOUTS[frame_name].pack(*values)
    except struct.error as error:
        raise ValueError(f"{frame_name}: found {fields}, wanted values that fit the wire types ({error})") from None
    body = bytes((frame.id, sequence & 0xFF)) + payload
    return cobs_encode(body + struct.pack(">H", crc16(body))) + DELIMITER


def decode_body(body: bytes) -> AnyFrame:
    """Message of one frame without its COBS coding. Raises ValueError when anything about it is wrong."""
    if len(body) < 4 or crc16(body) != 0:  # with its check sum, high byte first, a body leaves no remainder
        raise ValueError(f"frame: found {len(body)} bytes with a wrong check sum")
    frame = FRAME_BY_ID.get(body[0])
    if frame is None or frame.payload_bytes != len(body) - 4:
        raise ValueError(f"frame: found id {body[0]:#04x} with {len(body) - 4} bytes of payload")
    flat: Iterator[int] = iter(_LAYOUTS[frame.name].unpack_from(body, 2))
    fields: dict[str, Any] = {
        f.name: next(flat) if f.count == 1 else tuple(next(flat) for _ in range(f.count)) for f in frame.fields
    }
    return AnyFrame(frame.name, body[1], fields)


@dataclass
class StreamCounters:
    """What a StreamDecoder has seen: frames that arrived whole, damaged ones, and gaps in the sequence numbers."""

    frames: int = 0
    crc_errors: int = 0  # check sum, framing, length or id wrong
    lost: int = 0  # sequence numbers skipped
    repeated: int = 0  # the same sequence number twice in a row
    restarts: int = 0  # sequence number before the last: the sender started again


class StreamDecoder:
    """Bytes in any portions to messages; damaged frames are counted and dropped.

    What comes before the first whole frame is not counted as damage, because a port may be opened in mid-frame.
    A repeated frame is dropped too.
    """

    def __init__(self) -> None:
        self.counters = StreamCounters()
        self._pending = bytearray()
        self._overlong = False
        self._sequence: int | None = None

    def feed(self, data: bytes) -> list[AnyFrame]:
        """Messages completed by `data`, oldest first."""
        out = []
        parts = data.split(DELIMITER)
        for index, part in enumerate(parts):
            self._append(part)
            if index < len(parts) - 1:
                message = self._finish()
                if message is not None and self._is_new(message.sequence):
                    self.counters.frames += 1
                    out.append(message)
        return out

    def _append(self, part: bytes) -> None:
        if self._overlong or len(self._pending) + len(part) > MAX_BODY_BYTES + 1:
            self._overlong = True
            return
        self._pending += part

    def _finish(self) -> AnyFrame | None:
        raw, overlong = bytes(self._pending), self._overlong
        self._pending.clear()
        self._overlong = False
        if not raw and not overlong:
            return None
        try:
            if overlong:
                raise ValueError(f"frame: found more than {MAX_BODY_BYTES + 1} bytes without a delimiter")
            return decode_body(cobs_decode(raw))
        except ValueError:
            if self.counters.frames:
                self.counters.crc_errors += 1
            return None

    def _is_new(self, sequence: int) -> bool:
        step = 1 if self._sequence is None else (sequence - self._sequence) & 0xFF
        self._sequence = sequence
        if step == 0:
            self.counters.repeated += 1
        elif step > 127:
            self.counters.restarts += 1
        else:
            self.counters.lost += step - 1
        return step != 0
