"""SIGTERM and SIGINT: they interrupt a start at once, and end the work after it in order."""

from __future__ import annotations

import os
import signal

import pytest

from protocol.end_signals import EndSignals

pytestmark = pytest.mark.usefixtures("signal_handlers")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_interrupts_a_start_and_leaves_it_without_an_exception(number: signal.Signals) -> None:
    ends, came_through = EndSignals(), False
    with ends.interrupting():
        os.kill(os.getpid(), number)
        came_through = True
    assert ends.asked.is_set() and not came_through


def test_an_interruption_that_compiling_turns_into_another_error_is_one_still() -> None:
    ends = EndSignals()
    with ends.interrupting():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:
            raise SystemError("returned a result with an exception set") from None
    assert ends.asked.is_set()


def test_an_error_of_the_start_itself_is_passed_on() -> None:
    with pytest.raises(OSError, match="no such port"), EndSignals().interrupting():
        raise OSError("no such port")


def test_a_signal_after_the_start_only_asks() -> None:
    ends = EndSignals()
    with ends.interrupting():
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    assert ends.asked.is_set()


def test_a_second_signal_leaves_what_is_being_closed_alone() -> None:
    ends, closed = EndSignals(), False
    with ends.interrupting():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            closed = True
    assert closed
