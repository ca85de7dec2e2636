"""The NDI combined API on the wire: commands, text and binary replies, their CRC-16, and descriptions of the codes."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from enum import Enum, IntFlag

BINARY_START = b"\xc4\xa5"  # 0xA5C4, low byte first
MAX_BINARY_BYTES = 4096
MAX_TEXT_BYTES = 4096
# COMM codes of the serial speeds that a POSIX line can have too (the device also has 14400 and 1228739).
BAUD_CODES = {9600: "0", 19200: "2", 38400: "3", 57600: "4", 115200: "5", 921600: "6", 230400: "A"}

TRANSFORMS = 0x0001  # reply option of BX and TX: transforms and port status
# PHINF options and the characters that each adds to the reply, in this order.
PHINF_BASIC, PHINF_PART_NUMBER, PHINF_LOCATION = 0x0001, 0x0004, 0x0020

ERROR_TEXTS = {
    0x01: "command not known",
    0x02: "command too long",
    0x03: "command too short",
    0x04: "command damaged on the way (CRC)",
    0x05: "command not carried out in time",
    0x06: "serial settings refused",
    0x07: "wrong number of parameters",
    0x08: "no such port handle",
    0x09: "tracking priority is not S, D or B",
    0x0A: "no such LED",
    0x0B: "no such LED state",
    0x0C: "command not allowed in the present mode",
    0x0D: "no tool behind this port handle",
    0x0E: "port handle not initialised",
    0x0F: "port handle not enabled",
    0x10: "system not initialised",
    0x11: "tracking could not be stopped",
    0x12: "tracking could not be started",
    0x13: "tool could not be initialised: a tool without a memory of its own needs its file (tracker.tip_definition, "
    "shaft_definition, rear_definition)",
    0x14: "field generator's characterisation not valid",
    0x15: "measurement system could not be initialised",
    0x16: "diagnostic mode could not be started",
    0x17: "diagnostic mode could not be stopped",
    0x19: "firmware version could not be read",
    0x1A: "internal error of the measurement system",
    0x1D: "the tool has no memory of its own: give its file in the rig file (tracker.tip_definition, "
    "shaft_definition, rear_definition)",
    0x1E: "SROM of the tool could not be read",
    0x1F: "SROM of the tool could not be written",
    0x20: "SROM could not be selected",
    0x21: "tool current test failed",
    0x23: "parameter out of range",
    0x24: "no parameters for this volume",
    0x25: "list of features could not be read",
    0x28: "too many tools enabled, or type of tool not supported",
    0x29: "main firmware corrupt",
    0x2A: "out of memory",
    0x2B: "port handle not allocated",
    0x2C: "port handle has become unoccupied",
    0x2D: "no port handle left",
    0x2E: "firmware versions do not fit each other",
    0x2F: "port description not valid",
    0x30: "port already has a handle",
    0x32: "not possible for the device behind this handle",
    0x33: "feature not available",
    0x40: "tool definition damaged",
    0x41: "tool's characteristics not supported",
    0x42: "device not present",
    0xF4: "flash could not be erased",
    0xF5: "flash could not be written",
    0xF6: "flash could not be read",
}
WARNING_TEXTS = {0x01: "possible hardware fault"}
SYSTEM_STATUS_TEXTS = {
    0x0001: "communication between units out of step",
    0x0004: "communication between units damaged (CRC)",
    0x0008: "recoverable processing exception",
    0x0010: "hardware failure",
    0x0020: "hardware changed",
    0x0040: "a port has become occupied",
    0x0080: "a port has become unoccupied",
    0x0100: "diagnostic data waiting",
}
PORT_OCCUPIED, PORT_UNOCCUPIED = 0x0040, 0x0080


class PortStatus(IntFlag):
    """Bits of a port's status (32 bit in BX and TX, the low 8 in PHINF, 12 in PHSR)."""

    OCCUPIED = 0x0001
    GPIO_1 = 0x0002
    GPIO_2 = 0x0004
    GPIO_3 = 0x0008
    INITIALISED = 0x0010
    ENABLED = 0x0020
    OUT_OF_VOLUME = 0x0040
    PARTLY_OUT_OF_VOLUME = 0x0080
    SENSOR_BROKEN = 0x0100
    PROCESSING_EXCEPTION = 0x1000


NO_STATUS = PortStatus(0)


class HandleState(Enum):
    """What a tracking reply says of a port handle; the numbers are BX's."""

    VALID = 1
    MISSING = 2
    DISABLED = 4
    UNOCCUPIED = 0


class ProtocolError(ValueError):
    """A reply whose CRC is right and whose content is not what the command returns."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC-16 of the NDI interface: x^16 + x^15 + x^2 + 1 reflected, start 0."""
    crc = 0
    for byte in data:
        crc = (crc >> 8) ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def command(name: str, parameters: str = "") -> bytes:
    r"""Return the bytes of a command with its CRC, e.g. b"INIT:E3A5\r" for INIT."""
    body = f"{name}:{parameters}".encode("ascii")
    return body + b"%04X\r" % crc16(body)


@dataclass(frozen=True, slots=True)
class NdiReply:
    """One whole, undamaged reply without its CRC: `text` or `binary`; n_bytes as it was on the wire."""

    text: str | None
    binary: bytes | None
    n_bytes: int


@dataclass
class ReplyReader:
    """Divides the byte stream into replies. Damaged bytes are dropped and counted in `damaged`."""

    damaged: int = 0
    _buffer: bytearray = field(default_factory=bytearray)

    def clear(self) -> None:
        """Drop a partly received reply."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[NdiReply]:
        """Return the replies completed by `data`, in order."""
        self._buffer += data
        replies: list[NdiReply] = []
        while self._buffer:
            taken, reply = self._next()
            if taken == 0:
                break
            del self._buffer[:taken]
            if reply is None:
                self.damaged += 1
            else:
                replies.append(reply)
        return replies

    def _next(self) -> tuple[int, NdiReply | None]:
        """Return (bytes used, reply or None if these bytes are damaged); (0, None) if more bytes are needed."""
        buffer = self._buffer
        if buffer[0] == BINARY_START[0]:
            return self._next_binary()
        end = 0
        while end < len(buffer) and (0x20 <= buffer[end] < 0x7F or buffer[end] == 0x0A):
            end += 1
        if end == len(buffer):
            return (end, None) if end > MAX_TEXT_BYTES else (0, None)
        if buffer[end] != 0x0D:
            return _until_start(buffer, max(end, 1)), None
        body = bytes(buffer[: max(end - 4, 0)])
        good = end >= 4 and bytes(buffer[end - 4 : end]) == b"%04X" % crc16(body)
        return end + 1, NdiReply(body.decode("ascii"), None, end + 1) if good else None

    def _next_binary(self) -> tuple[int, NdiReply | None]:
        buffer = self._buffer
        if len(buffer) < 6:
            return (0, None) if BINARY_START.startswith(bytes(buffer[:2])) else (_until_start(buffer, 1), None)
        start, length, header_crc = struct.unpack_from("<2sHH", buffer)
        if start != BINARY_START or header_crc != crc16(bytes(buffer[:4])) or length > MAX_BINARY_BYTES:
            return _until_start(buffer, 1), None
        if len(buffer) < 8 + length:
            return 0, None
        body = bytes(buffer[6 : 6 + length])
        if int.from_bytes(buffer[6 + length : 8 + length], "little") != crc16(body):
            return _until_start(buffer, 1), None
        return 8 + length, NdiReply(None, body, 8 + length)


def _until_start(buffer: bytearray, at_least: int) -> int:
    """Return how many bytes to drop, up to the next possible start of a binary reply or a text, or to the end."""
    for index in range(at_least, len(buffer)):
        if buffer[index] == BINARY_START[0] or 0x20 <= buffer[index] < 0x7F:
            return index
    return len(buffer)


def describe_reply(reply: str) -> str:
    """Describe an ERROR or WARNING reply, e.g. "error 0C: command not allowed in the present mode"."""
    kind, code, table = (
        ("error", reply[5:7], ERROR_TEXTS) if reply.startswith("ERROR") else ("warning", reply[7:9], WARNING_TEXTS)
    )
    try:
        return f"{kind} {code}: {table.get(int(code, 16), 'not in the list of codes')}"
    except ValueError:
        return f"{kind} without a code"


def describe_system_status(status: int) -> str:
    """Describe the set bits of a system status, joined by commas; empty when none is set."""
    return ", ".join(text for bit, text in SYSTEM_STATUS_TEXTS.items() if status & bit)


@dataclass(frozen=True, slots=True)
class ToolInfo:
    """Description of a tool: PHINF's reply to option 0x0025."""

    tool_type: str
    manufacturer: str
    revision: str
    serial: str
    status: PortStatus
    part_number: str
    port: str
    channel: str


def parse_phsr(text: str) -> list[tuple[str, PortStatus]]:
    """Return the port handles and their status from PHSR's reply. Raises ProtocolError."""
    count = _hex(text[:2])
    if len(text) != 2 + 5 * count:
        raise ProtocolError(f"PHSR: found {len(text)} characters, wanted {2 + 5 * count} for {count} handles")
    parts = [text[2 + 5 * i : 7 + 5 * i] for i in range(count)]
    return [(f"{_hex(part[:2]):02X}", PortStatus(_hex(part[2:]))) for part in parts]


def parse_phinf(text: str) -> ToolInfo:
    """Return the tool described by PHINF's reply to option 0x0025 (33 + 20 + 14 characters). Raises ProtocolError."""
    if len(text) != 67:
        raise ProtocolError(f"PHINF: found {text[:16]!r} of {len(text)} characters, wanted 67")
    return ToolInfo(
        text[:8].strip(),
        text[8:20].strip(),
        text[20:23].strip(),
        text[23:31].strip(),
        PortStatus(_hex(text[31:33])),
        text[33:53].strip(),
        text[63:65],
        text[65:67],
    )


@dataclass(frozen=True, slots=True)
class ToolReply:
    """One port handle of a tracking reply. Numbers are those of the wire turned into SI; None where not sent."""

    handle: str
    state: HandleState
    quaternion_wxyz: tuple[float, float, float, float] | None = None
    position_m: tuple[float, float, float] | None = None
    error_m: float = math.nan
    status: PortStatus = NO_STATUS
    frame: int | None = None


@dataclass(frozen=True, slots=True)
class TrackingReply:
    """A whole BX or TX reply."""

    tools: tuple[ToolReply, ...]
    system_status: int


def parse_bx(body: bytes) -> TrackingReply:
    """Parse BX's body (between the header's CRC and the reply's) for options 0x0001 or 0x0801. Raises ProtocolError."""
    tools: list[ToolReply] = []
    try:
        at = 1
        for _ in range(body[0]):
            handle, state = f"{body[at]:02X}", HandleState(body[at + 1])
            at += 2
            numbers: tuple[float, ...] | None = None
            if state is HandleState.UNOCCUPIED:
                raise ProtocolError(f"BX: found state 0 of handle {handle}, wanted 1, 2 or 4")
            if state is HandleState.VALID:
                numbers = struct.unpack_from("<8f", body, at)
                at += 32
            if state is HandleState.DISABLED:
                tools.append(ToolReply(handle, state))
                continue
            status, frame = struct.unpack_from("<II", body, at)
            at += 8
            tools.append(_tool(handle, state, numbers, status, frame))
        (system_status,) = struct.unpack_from("<H", body, at)
    except (struct.error, IndexError, ValueError) as bad:
        raise ProtocolError(f"BX: found {len(body)} bytes that do not add up ({bad})") from bad
    if at + 2 != len(body):
        raise ProtocolError(f"BX: found {len(body)} bytes, wanted {at + 2}")
    return TrackingReply(tuple(tools), system_status)


def parse_tx(text: str) -> TrackingReply:
    """Parse TX's reply for options 0x0001 or 0x0801, without its CRC. Raises ProtocolError."""
    count, rest = _hex(text[:2]), text[2:]
    lines = rest.split("\n")
    if len(lines) != count + 1:
        raise ProtocolError(f"TX: found {len(lines) - 1} lines, wanted {count}")
    if len(lines[-1]) != 4:
        raise ProtocolError(f"TX: found {lines[-1]!r}, wanted 4 characters of system status")
    return TrackingReply(tuple(_tx_line(line) for line in lines[:-1]), _hex(lines[-1]))


_TX_WIDTHS = (6, 6, 6, 6, 7, 7, 7, 6)
_TX_SCALES = (1e-4, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2, 1e-4)


def _tx_line(line: str) -> ToolReply:
    handle, rest = f"{_hex(line[:2]):02X}", line[2:]
    for state in (HandleState.DISABLED, HandleState.UNOCCUPIED):
        if rest == state.name:
            return ToolReply(handle, state)
    missing = rest.startswith("MISSING")
    start = 7 if missing else sum(_TX_WIDTHS)
    if len(rest) != start + 16:
        raise ProtocolError(f"TX: found {line!r}, wanted {start + 18} characters")
    status, frame = _hex(rest[start : start + 8]), _hex(rest[start + 8 :])
    if missing:
        return _tool(handle, HandleState.MISSING, None, status, frame)
    numbers, at = [], 0
    for width, scale in zip(_TX_WIDTHS, _TX_SCALES, strict=True):
        digits = rest[at + 1 : at + width]
        if rest[at] not in "+-" or not (digits.isascii() and digits.isdigit()):
            raise ProtocolError(f"TX: found {rest[at : at + width]!r}, wanted a sign and {width - 1} digits")
        numbers.append(int(rest[at : at + width]) * scale)
        at += width
    return _tool(handle, HandleState.VALID, tuple(numbers), status, frame)


def _tool(handle: str, state: HandleState, numbers: tuple[float, ...] | None, status: int, frame: int) -> ToolReply:
    if numbers is None:
        return ToolReply(handle, state, status=PortStatus(status), frame=frame)
    w, x, y, z, tx, ty, tz, error = numbers
    return ToolReply(handle, state, (w, x, y, z), (tx * 1e-3, ty * 1e-3, tz * 1e-3), error * 1e-3, PortStatus(status), frame)


_HEX_DIGITS = frozenset("0123456789ABCDEF")


def _hex(text: str) -> int:
    if not text or not _HEX_DIGITS.issuperset(text):
        raise ProtocolError(f"found {text!r}, wanted hexadecimal digits")
    return int(text, 16)
