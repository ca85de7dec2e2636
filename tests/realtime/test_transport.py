"""Transports move bytes and never block."""

import os

import pytest

from realtime.drivers.board_port import BoardPort
from realtime.drivers.transport import PipeTransport, open_serial


def test_pipe_ends_read_what_the_other_wrote() -> None:
    a, b = PipeTransport.pair()
    a.write(b"one")
    a.write(b"")
    a.write(b"two")
    b.write(b"three")
    assert (b.read(), b.read(), a.read()) == (b"onetwo", b"", b"three")
    assert a.fileno() == -1
    a.write(b"left")
    b.close()
    assert b.read() == b""


def test_a_board_that_is_missing_is_said_before_it_is_waited_for() -> None:
    lines: list[str] = []
    with pytest.raises(OSError, match="/dev/nowhere"):
        BoardPort("/dev/nowhere", 500_000, 0.5, lines.append)
    assert len(lines) == 1 and "/dev/nowhere" in lines[0] and "waits for it, at most 0.5 s" in lines[0]


def test_serial_port_does_not_block() -> None:
    master, slave = os.openpty()
    port = open_serial(os.ttyname(slave), 500_000)
    assert port.read() == b""
    os.write(master, b"\x00\x03\x11\r\n\xff")
    assert port.read() == b"\x00\x03\x11\r\n\xff"
    port.write(b"\x04\x1a\n")
    assert os.read(master, 10) == b"\x04\x1a\n"
    assert port.fileno() >= 0
    port.close()
    port.close()
    os.close(master)
    os.close(slave)


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(OSError, match="serial port: found /dev/no-such-port"):
        open_serial("/dev/no-such-port", 500_000)
