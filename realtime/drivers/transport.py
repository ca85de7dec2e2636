"""Where a driver's bytes go: a serial port, or a pair of queues in one process for lock step."""

import os
import time
from collections import deque
from typing import Protocol, TextIO

import serial


class Transport(Protocol):
    """A byte stream that never blocks."""

    def read(self) -> bytes:
        """Return the bytes since the last call, possibly none. Raises OSError if the device is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises OSError if the device is gone or does not accept it."""

    def fileno(self) -> int:
        """Return a descriptor to wait on, or -1 if there is none."""

    def close(self) -> None:
        """Release the device; a second call does nothing."""


class SerialTransport:
    """A serial port (or pty) in raw mode, 8N1, held by this process alone.

    path: device, as /dev/ttyACM0. baud: bits per second. Raises OSError with the path when it cannot be opened.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=0.5, exclusive=True)
        except serial.SerialException as error:
            raise OSError(_not_opened(path, error)) from error

    def read(self) -> bytes:
        """Return the bytes that have arrived, at most 4096."""
        try:
            return os.read(self._port.fileno(), 4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send all of `data`; wait at most 0.5 s for a full output buffer."""
        try:
            self._port.write(data)
        except serial.SerialException as error:
            raise OSError(f"{self.path}: did not take {len(data)} bytes ({error})") from error

    def fileno(self) -> int:
        """Return the file descriptor of the port."""
        return int(self._port.fileno())

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()


def _not_opened(path: str, error: serial.SerialException) -> str:
    """Say why the port at `path` does not open, and what to do."""
    if path.startswith("pty:"):
        return (
            f"serial port: found {path} that does not open, wanted a device such as /dev/serial/by-id/...; pty: stands for "
            "a port of the simulated rig, which its own process opens"
        )
    # pyserial's sentence repeats the path and the number of the error.
    said = os.strerror(error.errno) if error.errno else str(error)
    if "Inappropriate ioctl" in said:
        said = "it is not a serial port"
    return f"serial port: found {path} that does not open ({said}), wanted a free device"


class PipeTransport:
    """One end of a pair in memory, for lock step in one process: what one end writes the other reads."""

    def __init__(self, incoming: deque[bytes], outgoing: deque[bytes]) -> None:
        self._incoming = incoming
        self._outgoing = outgoing

    @classmethod
    def pair(cls) -> "tuple[PipeTransport, PipeTransport]":
        """Return two connected ends."""
        a: deque[bytes] = deque()
        b: deque[bytes] = deque()
        return cls(a, b), cls(b, a)

    def read(self) -> bytes:
        """Return all bytes that the other end has written since the last call."""
        data = b"".join(self._incoming)
        self._incoming.clear()
        return data

    def write(self, data: bytes) -> None:
        """Send `data` to the other end."""
        if data:
            self._outgoing.append(bytes(data))

    def fileno(self) -> int:
        """Return -1: there is nothing to wait on."""
        return -1

    def close(self) -> None:
        """Drop the bytes that were not read."""
        self._incoming.clear()


class TracedTransport:
    """A byte stream whose dialogue is written to a text file, for a manual to be compared with.

    A line has the seconds since the opening, `>` for what was sent and `<` for what came, the bytes in hexadecimal, and the
    text that they are in ASCII (a dot for each other byte). The trace is not made in the control loop.
    """

    def __init__(self, line: Transport, out: TextIO) -> None:
        self._line, self._out, self._begin_s = line, out, time.monotonic()

    def read(self) -> bytes:
        """Return the bytes since the last call, possibly none. Raises OSError if the device is gone."""
        data = self._line.read()
        self._note("<", data)
        return data

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises OSError if the device is gone or does not accept it."""
        self._note(">", data)
        self._line.write(data)

    def fileno(self) -> int:
        """Return a descriptor to wait on, or -1 if there is none."""
        return self._line.fileno()

    def close(self) -> None:
        """Release the device; a second call does nothing. The file stays open."""
        self._line.close()

    def _note(self, direction: str, data: bytes) -> None:
        if data:
            text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in data)
            self._out.write(f"{time.monotonic() - self._begin_s:10.4f} {direction} {data.hex(' ')}  {text}\n")
            self._out.flush()


def open_serial(path: str, baud: int) -> SerialTransport:
    """Open the serial port at `path`. Raises OSError with the path if it cannot be opened."""
    return SerialTransport(path, baud)
