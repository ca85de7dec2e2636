"""Bad subscribers beside a rig in virtual time: every step edge where it was without them; a stop gets through a flood."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from host.run.wall_clock import with_folder
from host.security import keys
from host.studies.bad_subscriber import KINDS, BadSubscriber, bad_subscriber
from host.studies.benchmarks.body_contact import THREE, with_sensors
from protocol.commander import CommandSender
from protocol.local_paths import SERVICE_FOLDER, LocalPaths
from protocol.rig_file import load_rig, parse_rig
from protocol.topics import TOPICS, Command, Message, Reply, RigState
from protocol.zenoh_access import Network
from protocol.zenoh_session import Session
from realtime.core.command_gate import CommandGate
from sim.forked_board import LibraryBoard
from sim.scenario import Scenario
from sim.world import World, simulated_plant
from tests.realtime.conftest import RIG_FILE
from tests.waiting import PATIENCE_S, free_port, until

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "subscriber.py"


def test_two_fleets_do_not_meet() -> None:
    text = RIG_FILE.read_text(encoding="utf-8")
    data, own = tomllib.loads(text), tomllib.loads(with_folder(text, Path("/run/other")))
    assert own["zenoh"] == {"folder": "/run/other"}
    assert own | {"zenoh": data["zenoh"]} == data
    assert parse_rig(own).connect_endpoints == ["unixsock-stream//run/other/zenoh.sock"]


def misbehaved(kind: str, bad: BadSubscriber | None, run: Scenario) -> bool:
    """Whether what `kind` does to a rig has been done to this one."""
    if bad is not None:
        bad.tend()
    if kind == "leaving":
        return bad is not None and bad.lives > 1
    return kind != "flooding" or run.loop.core.gate.counts["malformed"] > 20


def digest_beside(kind: str, move_s: float = 0.5) -> tuple[str, int]:
    """Hash and number of the step edges of a move whose messages all go out by a real session, beside `kind`."""
    rig, endpoint = load_rig(RIG_FILE), f"tcp/127.0.0.1:{free_port()}"
    with Session(rig.name, [endpoint], []) as session, LibraryBoard() as board:
        publishers = {name: session.publisher(name) for name, topic in TOPICS.items() if topic.kind != "query"}

        def publish(topic: str, message: Message) -> None:
            publishers[topic].put(message)

        run = Scenario(rig, World(rig, simulated_plant(rig, 1), board, 1), publish, pace=1.0)
        server = session.serve_requests(run.loop.request)
        with bad_subscriber(kind, rig.name, endpoint) as bad:
            assert run.arm() and run.command("target", "position", target_m=(0.0, -0.0107, 0.021)).accepted
            for _ in range(2):
                run.run(0.5 * move_s, lambda: bad is not None and bad.tend() is None and False)
                until(lambda: misbehaved(kind, bad, run), f"a {kind} one to misbehave in mid move")
        assert server is not None
        return run.world.digest, int(run.world.edges.sum())


def test_the_rates_are_those_of_the_table() -> None:
    rig, count = with_sensors(load_rig(RIG_FILE), THREE), Counter[str]()  # the table has the topic of a third sensor
    with LibraryBoard() as board:
        run = Scenario(rig, World(rig, simulated_plant(rig, 1), board, 1), lambda topic, message: count.update([topic]))
        assert run.arm()
        count.clear()
        run.run(2.0)
    for name, topic in TOPICS.items():
        if topic.rate_hz and topic.direction.startswith(("realtime", "sim")):
            assert count[name] == pytest.approx(2 * topic.rate_hz, abs=1), name


@pytest.fixture(scope="module")
def alone() -> tuple[str, int]:
    digest, edges = digest_beside("nobody")
    assert edges > 200
    return digest, edges


@pytest.mark.parametrize("kind", KINDS)
def test_the_step_edges_are_the_same_beside(kind: str, alone: tuple[str, int]) -> None:
    assert digest_beside(kind) == alone


def test_requests_of_several_threads_are_each_answered_between_periods() -> None:
    rig, replies, ended = load_rig(RIG_FILE), list[Reply | None](), threading.Event()
    with LibraryBoard() as board:
        run = Scenario(rig, World(rig, simulated_plant(rig, 1), board, 1), lambda topic, message: None)

        def flood() -> None:
            while not ended.is_set():
                replies.append(run.loop.request("flood", b"junk"))

        threads, interval_s = [threading.Thread(target=flood) for _ in range(3)], sys.getswitchinterval()
        sys.setswitchinterval(1e-5)
        try:
            for thread in threads:
                thread.start()
            assert run.arm()
            until(lambda: len(replies) > 1000, "requests next to the periods")
        finally:
            ended.set()
            for thread in threads:
                thread.join()
            sys.setswitchinterval(interval_s)
        counts = run.loop.core.gate.counts
        assert len(replies) == counts["malformed"] + counts["flooded"]


def test_a_stop_gets_through_a_flood() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    done: list[str] = []

    def obey(command: Command, now_ns: int) -> Reply:
        done.append(command.action)
        return Reply(stamp_ns=now_ns, id=command.id, result="accepted")

    gate = CommandGate(time.monotonic_ns, obey)
    with Session("simulated", [endpoint], []) as rig, Session("simulated", [], [endpoint]) as console:
        server = rig.serve_requests(lambda name, payload: gate.answer(name, payload)[1])
        with bad_subscriber("flooding", "simulated", endpoint):
            until(lambda: gate.counts["flooded"] >= 500, "a flood")
            assert CommandSender(console, "console", timeout_s=PATIENCE_S).stop().accepted and done == ["stop"]
        assert server is not None


def lines_of_the_example(arguments: list[str], session: Session, program: str) -> list[str]:
    """The first two lines that the example prints while `session` publishes states."""
    child = subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True)
    publisher, lines = session.publisher("state"), list[str]()
    reader = threading.Thread(target=lambda: lines.extend(child.stdout.readline() for _ in range(2)))  # type: ignore[union-attr]
    reader.start()
    deadline = time.monotonic() + PATIENCE_S
    while reader.is_alive() and time.monotonic() < deadline:
        publisher.put(
            RigState(stamp_ns=2_500_000_000, mode="contact", safety_action="hold", cause="no fresh pose", force_N=0.1234)
        )
        time.sleep(0.01)
    child.kill()
    child.wait()
    reader.join()
    assert child.stdout is not None
    child.stdout.close()
    return lines


SHOWN = ["2.500 s  contact  0.123 N  no fresh pose\n"] * 2


def test_the_example_reads_on_this_machine() -> None:
    program, endpoint = EXAMPLE.read_text(encoding="utf-8"), f"tcp/127.0.0.1:{free_port()}"
    assert len(program.splitlines()) <= 15 and "import host" not in program and "protocol" not in program
    assert LocalPaths(SERVICE_FOLDER).endpoint in program and load_rig(RIG_FILE).zenoh.listen == []
    with Session("simulated", [endpoint], []) as session:
        assert lines_of_the_example([endpoint], session, program) == SHOWN


def test_the_example_reads_from_another_machine_with_its_certificate(tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    keys.make_authority(tmp_path / "keys")
    rig = keys.issue(tmp_path / "keys", "rig1", "rig", addresses=["127.0.0.1"])
    reader = keys.issue(tmp_path / "keys", "analysis", "reader", connect=endpoint)
    network = Network("simulated", (endpoint,), rig.folder, ("analysis",))
    with Session("simulated", [], [], network) as session:
        assert lines_of_the_example([str(reader.folder / keys.CLIENT_FILE)], session, EXAMPLE.read_text("utf-8")) == SHOWN
