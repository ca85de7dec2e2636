"""`connect`: a rig is read, commanded under the lease, and refuses with its own words."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import seldinger as sd
from protocol.reply_seal import ReplySeal
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import RigState
from tests.host.test_commander import Gate
from tests.waiting import until


@pytest.fixture
def rig_file(tmp_path: Path) -> Rig:
    rig, endpoint = load_rig(SIMULATED_RIG), f"unixsock-stream/{tmp_path}/rig.sock"
    return rig.model_copy(update={"zenoh": type(rig.zenoh)(folder=f"{tmp_path}/run", listen=[], connect=[endpoint])})


@pytest.fixture
def gate(rig_file: Rig, tmp_path: Path) -> Iterator[Gate]:
    seal = ReplySeal(rig_file.local.prepare().reply_key)
    made = Gate(f"unixsock-stream/{tmp_path}/rig.sock", seal.prove)
    yield made
    made.session.close()


def _answers(rig: sd.RigConnection) -> bool:
    try:
        rig.take()
    except sd.CommandRefused:
        return False
    return True


def test_commands_go_under_the_lease(gate: Gate, rig_file: Rig) -> None:
    with sd.connect(rig_file, name="notebook") as rig:
        assert until(lambda: _answers(rig))
        rig.goto([0.0, -0.02, 0.06])
        rig.touch([0.0, -0.02, 0.07], [0.0, 0.0, 1.0], 0.1)
        rig.force(0.05)
        rig.retract()
        rig.hold()
        rig.disarm()
        rig.clear_fault()
        with pytest.raises(sd.CommandRefused, match="not confirmed"):  # nothing publishes the rig's state here
            rig.stop()
        with pytest.raises(sd.CommandRefused, match="arm: refused: found no board, wanted one"):
            rig.arm()
        with pytest.raises(sd.CommandRefused, match=r"touch: .*normal"):
            rig.touch([0.0, -0.02, 0.07], [0.0, 0.0, 2.0], 0.1)
        assert gate.gate.state().holder == "notebook"
    assert gate.gate.state().holder == ""
    given = [command.target if command.action == "target" else command.action for command in gate.done]
    assert given == ["position", "contact", "force", "retract", "hold", "disarm", "clear_fault", "stop", "arm"]


def test_without_the_lease_a_command_is_refused_and_stop_is_not(gate: Gate, rig_file: Rig) -> None:
    with sd.connect(rig_file, name="notebook") as rig, sd.connect(rig_file, name="other") as other:
        assert until(lambda: _answers(other))
        with pytest.raises(sd.CommandRefused):
            rig.goto([0.0, -0.02, 0.06])
        with pytest.raises(sd.CommandRefused, match="held by other"):
            rig.take()
        with pytest.raises(sd.CommandRefused, match="not confirmed"):  # nothing publishes the rig's state here
            rig.stop()
    assert gate.done[-1].action == "stop"


def test_the_state_of_the_rig_is_read(gate: Gate, rig_file: Rig) -> None:
    publisher, ended = gate.session.publisher("state"), threading.Event()
    message = RigState(stamp_ns=1, mode="hold", safety_action="warn", cause="a cause", force_N=0.2)

    def publish() -> None:
        while not ended.wait(0.01):
            publisher.put(message)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with sd.connect(rig_file) as rig:
            status = rig.status(timeout_s=30.0)
            assert status["connected"] and (status["phase"], status["cause"], status["force_N"]) == ("hold", "a cause", 0.2)
            assert next(iter(rig.subscribe("state", seconds=30.0))).mode == "hold"
            with pytest.raises(sd.InputError, match="pose/tip"):
                rig.latest("pose")
    finally:
        ended.set()
        thread.join()


def test_no_rig_is_not_connected(rig_file: Rig) -> None:
    with sd.connect(rig_file) as rig:
        assert rig.status(timeout_s=0.05) == dict.fromkeys(rig.status(0.0)) | {"connected": False}


@pytest.mark.parametrize("change", [{"endpoint": "tls/rig:7447"}, {"keys": "folder"}, {"name": "Not A Name"}])
def test_bad_input_is_named(change: dict, rig_file: Rig) -> None:
    with pytest.raises(sd.InputError):
        sd.connect(rig_file, **change)
