"""What tests of live sessions and threads wait for, and where they listen."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import pytest

PATIENCE_S = 120.0  # a busy machine may take long; only one that is stuck fails


def until(happened: Callable[[], bool], what: str = "", patience_s: float = PATIENCE_S) -> bool:
    """True once `happened()`; after `patience_s` False, or with `what` a failed test that says what it waited for."""
    deadline = time.monotonic() + patience_s
    while not happened():
        if time.monotonic() > deadline:
            if what:
                pytest.fail(f"waited {patience_s} s for {what}")
            return False
        time.sleep(0.01)
    return True


def free_port() -> int:
    """A TCP port that nothing on loopback listens at just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
