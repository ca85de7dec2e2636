"""A tracker that an OpenIGTLink server sends as TRANSFORM messages, as PLUS and 3D Slicer do.

Format: "OpenIGTLink protocol", version 2, header and TRANSFORM (openigtlink.org/developers/spec). Big-endian; the header
has 58 bytes; a TRANSFORM is a 3 x 4 matrix of 32-bit floats, column by column, translation in mm.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import time
from typing import NamedTuple

import numpy as np

from protocol.errors import InputError
from protocol.rig_file import Tracker
from realtime.drivers.frame_clock import FrameClock
from realtime.drivers.pose_sample import PoseSample

DEFAULT_PORT = 18944
HEADER = struct.Struct(">H12s20sIIQQ")
MATRIX = struct.Struct(">12f")
EXTENDED_HEADER = struct.Struct(">HHII")
# Images and meshes may pass on the same connection: longer than a 4K image is not a message.
LONGEST_BODY = 64 * 2**20
CONNECT_S, WAIT_S = 2.0, 0.05
# The server's stamps are mapped to this computer's clock in these units.
TICK_S = 1e-4
# |R^T R - 1|: single precision and rounding of a sender that works in mm.
ROTATION_TOLERANCE = 1e-3
_POLYNOMIAL, _MASK = 0x42F0E1EBA9EA3693, (1 << 64) - 1


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) ^ _POLYNOMIAL if value >> 63 else value << 1) & _MASK
        table.append(value)
    return table


_TABLE = _crc_table()


def crc64(data: bytes) -> int:
    """Return the CRC-64 of ECMA-182, as OpenIGTLink uses it."""
    value = 0
    for byte in data:
        value = ((value << 8) ^ _TABLE[(value >> 56) ^ byte]) & _MASK
    return value


class Received(NamedTuple):
    """One TRANSFORM: name of its device, the sender's time (s since 1970, 0: none), rotation (3, 3), translation (3,) m."""

    device: str
    sent_s: float
    rotation: np.ndarray
    translation_m: np.ndarray


class IgtlReader:
    """Decodes bytes into TRANSFORM messages. Other messages are skipped; damaged ones are counted and skipped.

    Raises ValueError in `feed` where the bytes are not OpenIGTLink: the connection cannot be used further.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._data = bytearray()

    def feed(self, data: bytes) -> list[Received]:
        """Return the transforms that `data` completes."""
        self._data += data
        found: list[Received] = []
        while len(self._data) >= HEADER.size:
            version, kind, device, seconds, fraction, size, crc = HEADER.unpack_from(self._data)
            if version not in (1, 2, 3) or size > LONGEST_BODY:
                raise ValueError(
                    f"openigtlink: found header version {version} and a body of {size} bytes, wanted OpenIGTLink"
                )
            if len(self._data) < HEADER.size + size:
                break
            body = bytes(self._data[HEADER.size : HEADER.size + size])
            del self._data[: HEADER.size + size]
            if kind.rstrip(b"\0 ") != b"TRANSFORM":
                continue
            if crc64(body) != crc:
                self.damaged += 1
                continue
            transform = _transform(body, version)
            if transform is None:
                self.damaged += 1
                continue
            name = device.rstrip(b"\0 ").decode("ascii", "replace")
            found.append(Received(name, seconds + fraction / 2**32, *transform))
        return found


def _transform(body: bytes, version: int) -> tuple[np.ndarray, np.ndarray] | None:
    start = 0
    if version > 1:  # an extended header stands before the content
        if len(body) < EXTENDED_HEADER.size:
            return None
        start = EXTENDED_HEADER.unpack_from(body)[0]
    if len(body) < start + MATRIX.size:
        return None
    columns = np.array(MATRIX.unpack_from(body, start)).reshape(4, 3)
    rotation, translation_m = columns[:3].T, 1e-3 * columns[3]
    if not np.all(np.isfinite(columns)) or np.abs(rotation.T @ rotation - np.eye(3)).max() > ROTATION_TOLERANCE:
        return None
    return (rotation, translation_m) if np.linalg.det(rotation) > 0 else None


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,), scalar first and not negative, of a rotation matrix (3, 3).

    Source: Shepperd, "Quaternion from rotation matrix", 1978: divide by the largest of the four components.
    """
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    w, x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 0.0
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = ((squares[0], w, x, y), (w, squares[1], xy, xz), (x, xy, squares[2], yz), (y, xz, yz, squares[3]))
    q = np.array(rows[int(np.argmax(squares))]) + z
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


class OpenIgtLinkTracker:
    """Poses of the wanted devices (TRANSFORM names) of one server.

    A sample's time is the sender's stamp, mapped to this computer's clock by the messages that came with the least delay
    (`FrameClock`), less `latency_s`. A sender without stamps gives the time of arrival less `latency_s`.
    """

    def __init__(self, address: tuple[str, int], devices: tuple[str, ...], latency_s: float) -> None:
        self._devices, self._latency_ns = devices, round(latency_s * 1e9)
        self._reader, self._clock = IgtlReader(), FrameClock(TICK_S)
        self._first_s: float | None = None
        self._frames = dict.fromkeys(devices, 0)
        self._link = socket.create_connection(address, CONNECT_S)
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._link.setblocking(False)

    def read(self) -> list[PoseSample]:
        """Return the poses since the last call; wait for them at most 50 ms. Raises OSError if the server is gone."""
        if not select.select([self._link], [], [], WAIT_S)[0]:
            return []
        data = self._link.recv(1 << 16)
        arrival_ns = time.monotonic_ns()
        if not data:
            raise OSError("openigtlink: the server has closed the connection")
        try:
            received = self._reader.feed(data)
        except ValueError as error:
            raise OSError(str(error)) from None
        return [self._sample(one, arrival_ns) for one in received if one.device in self._frames]

    def _sample(self, one: Received, arrival_ns: int) -> PoseSample:
        self._frames[one.device] += 1
        sampled_ns = arrival_ns
        if one.sent_s > 0:
            if self._first_s is None:
                self._first_s = one.sent_s
            sampled_ns = self._clock.observe(round((one.sent_s - self._first_s) / TICK_S), arrival_ns)
        return PoseSample(
            tool=one.device,
            frame=self._frames[one.device],
            stamp_ns=sampled_ns - self._latency_ns,
            arrival_ns=arrival_ns,
            position_m=one.translation_m,
            quaternion_wxyz=quaternion_of(one.rotation),
            quality_m=math.nan,
            missing=False,
        )

    def close(self) -> None:
        """Close the connection to the server."""
        with contextlib.suppress(OSError):
            self._link.close()


def address_of(text: str) -> tuple[str, int]:
    """Return HOST, HOST:PORT or [IPv6]:PORT as host and port. Raises InputError named tracker.port."""
    host, _, port = text.rpartition(":") if text.count(":") == 1 or "]:" in text else (text, "", str(DEFAULT_PORT))
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError("tracker.port", text, f"HOST:PORT of the OpenIGTLink server, such as 127.0.0.1:{DEFAULT_PORT}")
    return host.strip("[]"), int(port)


def open_tracker(tracker: Tracker) -> OpenIgtLinkTracker:
    """Connect to the server that `tracker.port` names; the handles are names of transforms.

    Raises:
        OSError: no server answers there. InputError: the address is none.
    """
    address = address_of(tracker.port)
    try:
        return OpenIgtLinkTracker(address, tuple(tool.handle for tool in tracker.tools), tracker.latency_s)
    except OSError as error:
        raise OSError(f"openigtlink: no server at {tracker.port} ({error.strerror or error})") from None
