"""A disk that fills up under a recording."""

from __future__ import annotations

import os

import pytest


def fill_up(monkeypatch: pytest.MonkeyPatch, room_bytes: int) -> None:
    """From now on recordings (.mcap) find room for `room_bytes` more, then "No space left on device"; other files any."""
    real, room = os.write, [room_bytes]

    def small_disk(fd: int, data: bytes) -> int:
        if not os.readlink(f"/proc/self/fd/{fd}").endswith(".mcap"):
            return real(fd, data)
        taken = min(len(data), room[0])
        room[0] -= taken
        if taken == 0:
            raise OSError(28, "No space left on device")
        return real(fd, data[:taken])

    monkeypatch.setattr(os, "write", small_disk)
