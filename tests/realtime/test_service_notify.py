"""The service manager's contract: what is sent, and that a heartbeat that stands still feeds nothing."""

import logging
import socket
from pathlib import Path

import pytest

from realtime.loop.service_notify import JournalHandler, ServiceNotifier, log_handler


@pytest.fixture
def manager(tmp_path: Path) -> socket.socket:
    line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    line.bind(str(tmp_path / "notify"))
    return line


def said(line: socket.socket) -> list[str]:
    out = []
    while True:
        try:
            out.append(line.recv(4096).decode())
        except BlockingIOError:
            return out


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_without_a_manager_nothing_is_sent_and_nothing_fails() -> None:
    notifier = ServiceNotifier({})
    assert not (notifier.ready("x") or notifier.beat(1) or notifier.stopping())


def test_ready_status_and_stopping_are_told(manager: socket.socket) -> None:
    notifier = ServiceNotifier({"NOTIFY_SOCKET": manager.getsockname()})
    assert notifier.ready("disarmed") and notifier.status("on") and notifier.stopping()
    assert said(manager) == ["READY=1\nSTATUS=disarmed", "STATUS=on", "STOPPING=1"]


def test_the_watchdog_is_fed_only_while_the_heart_beats_and_not_more_than_needed(manager: socket.socket) -> None:
    clock = Clock()
    notifier = ServiceNotifier({"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "2000000"}, clock)
    fed = []
    for turn in range(100):  # a turn each 100 ms; the loop dies after 5 s
        clock.now_s += 0.1
        fed.append(notifier.beat(min(turn, 50)))
    assert 8 <= sum(fed[:51]) <= 12 and sum(fed[51:]) <= 1
    assert said(manager) == ["WATCHDOG=1"] * sum(fed)


def test_a_watchdog_of_another_process_is_not_fed(manager: socket.socket) -> None:
    notifier = ServiceNotifier({"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"})
    assert not notifier.beat(1)


def test_a_manager_that_went_away_stops_nothing(tmp_path: Path) -> None:
    assert not ServiceNotifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).ready("x")


def test_the_journal_gets_fields_also_for_texts_of_two_lines(manager: socket.socket) -> None:
    handler = JournalHandler(manager.getsockname())
    handler.emit(logging.LogRecord("seldinger", logging.WARNING, "f.py", 1, "board: lost\nagain", None, None, "serve"))
    data = manager.recv(4096)
    assert b"PRIORITY=4\n" in data and b"SELDINGER_SOURCE=board\n" in data and b"CODE_FUNC=serve\n" in data
    assert b"MESSAGE\n" + (17).to_bytes(8, "little") + b"board: lost\nagain\n" in data


def test_without_a_journal_logs_go_to_standard_error() -> None:
    assert isinstance(log_handler({}), logging.StreamHandler)
