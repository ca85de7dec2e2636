"""The realtime process while its loop is still being compiled: who asks is answered, nothing but a stop is taken."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from protocol.commander import Acknowledgement, CommandSender
from protocol.rig_file import SIMULATED_RIG, parse_rig, read_rig_data
from protocol.topics import RigState
from protocol.zenoh_session import Session
from realtime.core.process import RealtimeProcess
from tests.waiting import PATIENCE_S

RIG_FILE = SIMULATED_RIG


@pytest.fixture
def board() -> Iterator[str]:
    """The far end of a line on which no board answers."""
    own, far = os.openpty()
    yield os.ttyname(far)
    os.close(own)
    os.close(far)


def answered(ask: Callable[[], Acknowledgement]) -> Acknowledgement:
    """Ask until the key is known here, and the machine no slower than a command's life."""
    answer = ask()
    while answer.result in ("unanswered", "expired"):
        answer = ask()
    return answer


def test_commands_are_answered_while_the_loop_compiles(board: str, tmp_path: Path) -> None:
    rig = parse_rig(read_rig_data(RIG_FILE) | {"zenoh": {"folder": str(tmp_path)}})
    with Session.hub(rig) as session:
        states, commander = session.latest("state"), CommandSender(session, "console", timeout_s=PATIENCE_S)
        process = RealtimeProcess(rig, board_port=board, tracker_port="/nowhere")
        compiled, prepare = threading.Event(), process.loop.prepare
        process.loop.prepare = lambda: (compiled.wait(PATIENCE_S), prepare())  # type: ignore[method-assign,assignment]
        starting = threading.Thread(target=process.start)
        starting.start()
        try:
            assert answered(commander.take).accepted
            for asked in (commander.arm, commander.disarm, lambda: commander.target((0.0, 0.0, 0.04))):
                refused = answered(asked)
                assert refused.result == "refused" and "is being compiled" in refused.reason
            assert answered(commander.stop).accepted and states.take() is None
            compiled.set()
            starting.join(PATIENCE_S)
            while (state := states.take()) is None:
                pass
            assert isinstance(state, RigState) and state.mode == "disarmed"
            assert answered(commander.take).accepted and "board link in phase" in answered(commander.arm).reason
        finally:
            compiled.set()
            starting.join(PATIENCE_S)
            process.stop()
