"""Every way to a stop: over the socket and over zenoh, with one of them dead, against an impostor, and what is reported."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zenoh

from host.run.commander import Commander
from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet, Operator
from protocol.commander import CommandSender
from protocol.errors import InputError
from protocol.local_paths import LocalPaths
from protocol.rig_file import SIMULATED_RIG, Rig, parse_rig, read_rig_data
from protocol.stop_client import PathAnswer, ask_socket, shows_stop, stop_by_socket, stop_over
from protocol.topics import Command, Reply, RigState, decode, encode, request_key
from protocol.zenoh_session import Session
from realtime.core.process import RealtimeProcess
from sim.scenario import TARGET_M, ContactJob
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.usefixtures("rig_alone")

ATTEMPTS = 20


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return parse_rig(read_rig_data(SIMULATED_RIG) | {"zenoh": {"folder": str(tmp_path)}})


@pytest.fixture
def process(rig: Rig) -> Iterator[RealtimeProcess]:
    """The realtime process with its loop, on a line on which no board answers, and no model process."""
    own, far = os.openpty()
    made = RealtimeProcess(rig, board_port=os.ttyname(far), tracker_port="/nowhere")
    made.start()
    yield made
    made.stop()
    os.close(own)
    os.close(far)


def test_the_socket_stops_without_model_process_and_zenoh(process: RealtimeProcess, rig: Rig) -> None:
    before = process.core.gate.counts["accepted"]
    answer = stop_by_socket(rig.local, PATIENCE_S)
    assert answer.answered and answer.confirmed and "disarmed" in answer.text
    assert process.core.gate.counts["accepted"] == before + 1
    assert ask_socket(rig.local, "status", PATIENCE_S)["phase"] == "disarmed"
    assert "wanted stop or status" in ask_socket(rig.local, "arm", PATIENCE_S)["error"]


def test_socket_and_key_are_for_the_group_alone(process: RealtimeProcess, rig: Rig) -> None:
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (rig.local.stop_socket, rig.local.reply_key)]
    assert modes == [0o660, 0o640]
    with Session.hub(rig):
        assert stat.S_IMODE(rig.local.zenoh_socket.stat().st_mode) == 0o660


def test_a_stop_gets_through_idle_clients(process: RealtimeProcess, rig: Rig) -> None:
    idle = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(50)]
    for client in idle:
        client.connect(str(rig.local.stop_socket))
    assert stop_by_socket(rig.local, PATIENCE_S).confirmed
    for client in idle:
        client.close()


def test_a_core_that_hangs_ends_the_loop_so_that_the_board_stops(process: RealtimeProcess, rig: Rig) -> None:
    with process.shared._lock:
        answer = stop_by_socket(rig.local, PATIENCE_S)
        assert answer.answered and not answer.confirmed and "the loop was ended" in answer.text
        assert until(lambda: not process.alive)


def test_a_second_realtime_process_of_the_rig_is_refused(process: RealtimeProcess, rig: Rig) -> None:
    own, far = os.openpty()
    with pytest.raises(OSError, match="another realtime process"):
        RealtimeProcess(rig, board_port=os.ttyname(far), tracker_port="/nowhere")
    assert stop_by_socket(rig.local, PATIENCE_S).confirmed
    os.close(own)
    os.close(far)


def test_the_socket_of_a_dead_process_is_replaced(rig: Rig) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(rig.local.stop_socket))
    assert "is dead" in stop_by_socket(rig.local).text
    own, far = os.openpty()
    made = RealtimeProcess(rig, board_port=os.ttyname(far), tracker_port="/nowhere")
    made.start()
    assert stop_by_socket(rig.local, PATIENCE_S).confirmed
    made.stop()
    assert "does not run" in stop_by_socket(rig.local).text
    os.close(own)
    os.close(far)


class Impostor:
    """A local program that declares that it answers every request of the rig, and accepts them all."""

    def __init__(self, rig: Rig) -> None:
        self.lies = 0
        self.session = Session.of_rig(rig)
        self._queryable = self.session.zenoh.declare_queryable(request_key(rig.name, "*"), self._lie, complete=True)

    def _lie(self, query: zenoh.Query) -> None:
        self.lies += 1
        with query:
            command = decode(Command, bytes(query.payload or b""))
            reply = Reply(stamp_ns=command.stamp_ns, id=command.id, result="accepted", text="by the impostor")
            query.reply(query.key_expr, encode(reply), attachment=b"\0" * 32)


def test_an_impostor_does_not_answer_for_the_rig(rig: Rig) -> None:
    with Session.hub(rig):
        own, far = os.openpty()
        process = RealtimeProcess(rig, board_port=os.ttyname(far), tracker_port="/nowhere")
        process.start()
        impostor = Impostor(rig)
        with (
            Session.of_rig(rig) as session,
            Commander(session, "console", timeout_s=PATIENCE_S, confirm_s=10.0) as commander,
        ):
            assert until(lambda: impostor.lies > 0 or commander.hold().result == "none")
            for _ in range(ATTEMPTS):
                before = process.core.gate.counts["accepted"]
                answer = commander.stop_by_zenoh()
                assert answer.confirmed and process.core.gate.counts["accepted"] == before + 1
            lied = impostor.lies
            process.stop()
            quick = Commander(session, "quick", timeout_s=0.5)
            for _ in range(ATTEMPTS):
                answer = quick.stop_by_zenoh()
                assert not answer.answered and not answer.confirmed
            assert impostor.lies > lied
        impostor.session.close()
        os.close(own)
        os.close(far)


def test_a_stop_that_the_rigs_state_does_not_show_is_not_confirmed(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/rig.sock"
    with Session("simulated", [endpoint], []) as there, Session("simulated", [], [endpoint]) as here:
        server = there.serve_requests(lambda name, payload: _accepted(payload))
        states, mode, ending = there.publisher("state"), ["contact"], threading.Event()

        def publish() -> None:
            while not ending.wait(0.01):
                states.put(RigState(stamp_ns=time.monotonic_ns(), mode=mode[0], safety_action="none"))

        publishing = threading.Thread(target=publish)
        publishing.start()
        assert until(lambda: CommandSender(here, "probe").give("clock").accepted)
        with Commander(here, "console", timeout_s=PATIENCE_S) as commander:
            said = commander.stop()
            assert not said.accepted and said.result == "not confirmed" and "state is contact" in said.reason
            mode[0] = "stopped"
        with Commander(here, "patient", timeout_s=PATIENCE_S, confirm_s=PATIENCE_S) as commander:
            assert commander.stop().accepted
        ending.set()
        publishing.join()
        del server


@pytest.mark.parametrize(
    ("mode", "action", "shown"),
    [
        ("stopped", "stop", True),
        ("disarmed", "none", True),
        ("retract", "stop", True),
        ("retract", "retract", False),
        ("contact", "stop", False),
        ("no state", "", False),
    ],
)
def test_what_shows_a_stop(mode: str, action: str, shown: bool) -> None:
    assert shows_stop(mode, action) == shown


def _accepted(payload: bytes) -> Reply:
    command = decode(Command, payload)
    return Reply(stamp_ns=command.stamp_ns, id=command.id, result="accepted")


def test_the_paths_are_used_at_the_same_time() -> None:
    def late() -> PathAnswer:
        time.sleep(5.0)
        return PathAnswer("late", True, True, "")

    begin_s = time.monotonic()
    answers = stop_over({"late": late, "prompt": lambda: PathAnswer("prompt", True, True, "done")})
    assert [(a.path, a.confirmed) for a in answers] == [("late", False), ("prompt", True)]
    assert time.monotonic() - begin_s < 4.5


@pytest.mark.parametrize("status", [0, 1])
def test_a_program_ends_with_its_status_while_a_path_still_waits(status: int) -> None:
    program = f"""
import sys, time, typer
from host.cli import main
from protocol.stop_client import PathAnswer, stop_over
def wait():
    while True:
        time.sleep(0.001)
def command():
    stop_over({{"stalled": wait, "prompt": lambda: PathAnswer("prompt", True, True, "done")}}, others_s=0.0)
    print("said")
    raise SystemExit({status})
app = typer.Typer(add_completion=False)
app.command()(command)
main.build = lambda argv: app
main.main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (status, "said\n", "")


@pytest.mark.parametrize("mode", [0o757, 0o777])
def test_a_folder_that_others_can_write_is_refused(tmp_path: Path, mode: int) -> None:
    tmp_path.chmod(mode)
    with pytest.raises(InputError, match="others cannot write"):
        LocalPaths(tmp_path).prepare()


def test_a_folder_whose_path_is_too_long_for_a_socket_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unix sockets"):
        LocalPaths(tmp_path / ("x" * 100)).prepare()


def stop_command(fleet: Fleet, path: Path) -> tuple[int, dict[str, dict[str, object]], str]:
    """Exit status, answers by path, and the words of `seldinger stop`."""
    arguments = [sys.executable, "-m", "host.cli.main", "stop", "--rig", str(fleet.rig_file), "--json"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, env={**os.environ, "HOME": str(path)})
    return done.returncode, {answer["path"]: answer for answer in json.loads(done.stdout)["paths"]}, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["none", "host killed", "host stalled", "realtime stalled", "realtime killed"])
def test_the_command_stops_a_rig_in_contact(trouble: str, tmp_path: Path) -> None:
    """The force is asserted in virtual time (`tests/sim/test_scenario.py`): here the wall beats while the machine stalls."""
    settings = DemoSettings(board="native", directory=tmp_path, estimator="tests.host.no_estimator:make")
    with Fleet(settings, tmp_path / "stop.mcap") as fleet:
        operator = Operator(fleet)
        with closing(operator.session):
            assert operator.touch(ContactJob(TARGET_M, force_N=0.15, approach_s=120.0), 300.0), [
                operator.mode(),
                *(fleet.last_log_line(name) for name in fleet.processes),
            ]
            victim, _, how = trouble.partition(" ")
            if how:
                os.kill(fleet.processes[victim].pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
                time.sleep(0.5)
            status, answers, words = stop_command(fleet, tmp_path)
            if how == "stalled":
                os.kill(fleet.processes[victim].pid, signal.SIGCONT)
        if victim == "realtime":
            assert status == 1 and "NOT CONFIRMED: use the emergency stop" in words, words
            assert not any(answer["answered"] for answer in answers.values())
        else:
            assert answers["socket"]["answered"], words
            # The time to the confirmation is the machine's: where it stalled, the command must say so by its exit status.
            assert status == (0 if any(answer["confirmed"] for answer in answers.values()) else 1)
        if victim == "host":
            assert not answers["zenoh"]["answered"]
