"""The realtime process while its loop is still being compiled: who asks is answered, nothing but a stop is taken."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.commander import Commander
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


def test_commands_are_answered_while_the_loop_compiles(board: str, tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/rig.sock"
    data = read_rig_data(RIG_FILE)
    data["zenoh"] |= {"listen": [endpoint], "connect": [endpoint]}
    rig = parse_rig(data)
    with Session(rig.name, [endpoint], []) as session:
        states, commander = session.latest("state"), Commander(session, "console", timeout_s=PATIENCE_S)
        process = RealtimeProcess(rig, board_port=board, tracker_port="/nowhere")
        compiled, prepare = threading.Event(), process.loop.prepare
        process.loop.prepare = lambda: (compiled.wait(PATIENCE_S), prepare())  # type: ignore[method-assign,assignment]
        starting = threading.Thread(target=process.start)
        starting.start()
        try:
            answer = commander.take()
            while answer.result == "unanswered":  # its key is not known here yet
                answer = commander.take()
            assert answer.accepted
            for refused in (commander.arm(), commander.disarm(), commander.target((0.0, 0.0, 0.04))):
                assert refused.result == "refused" and "is being compiled" in refused.reason
            assert commander.stop().accepted and states.take() is None
            compiled.set()
            starting.join(PATIENCE_S)
            while (state := states.take()) is None:
                pass
            assert isinstance(state, RigState) and state.mode == "disarmed"
            assert "board link in phase" in commander.arm().reason
        finally:
            compiled.set()
            starting.join(PATIENCE_S)
            process.stop()
