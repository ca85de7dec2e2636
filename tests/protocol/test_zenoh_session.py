"""Two real processes over zenoh: late start, restart, a frozen reader, commands; and what a session refuses."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import msgpack
import pytest
import zenoh

from protocol import zenoh_session
from protocol.topics import TOPICS, Command, ForceSensor, Reply, decode, encode, key
from protocol.zenoh_session import Session, check_endpoint, configuration
from tests.waiting import PATIENCE_S, free_port, until

READER = """
import sys, time
from protocol.zenoh_session import Session
with Session("simulated", [], [sys.argv[1]]) as session:
    latest = session.latest("force/sensor")
    print("up", flush=True)
    while True:
        message = latest.take()
        if message is not None:
            print(message.sequence, flush=True)
        time.sleep(0.01)
"""

LISTENER = """
import sys, time
from protocol.topics import ForceSensor
from protocol.zenoh_session import Session
with Session("simulated", [sys.argv[1]], []) as session:
    publisher = session.publisher("force/sensor")
    print("up", flush=True)
    while True:
        publisher.put(ForceSensor(stamp_ns=int(sys.argv[2]), arrival_ns=0, force_N=(0.0, 0.0, 0.2)))
        time.sleep(0.01)
"""


@contextmanager
def running(program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    child = subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    try:
        assert child.stdout is not None and child.stdout.readline() == "up\n"
        yield child
    finally:
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()


@pytest.fixture(params=["tcp", "unix"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "unix":
        return f"unixsock-stream/{tmp_path}/rig.sock"
    return f"tcp/127.0.0.1:{free_port()}"


def reading(force_N: float = 0.2) -> ForceSensor:
    return ForceSensor(stamp_ns=0, arrival_ns=0, force_N=(0.0, 0.0, force_N))


def test_a_reader_that_starts_first_gets_what_comes_later_and_after_a_restart(endpoint: str) -> None:
    with Session("simulated", [], [endpoint]) as session:
        latest = session.latest("force/sensor")
        assert latest.take() is None
        for life in (1, 2):
            with running(LISTENER, endpoint, str(life)):
                assert until(lambda life=life: (m := latest.take()) is not None and m.stamp_ns == life)


def test_a_frozen_reader_never_blocks_the_writer_and_wakes_to_the_newest(endpoint: str) -> None:
    with Session("simulated", [endpoint], []) as session, running(READER, endpoint) as reader:
        publisher = session.publisher("force/sensor")
        seen: list[int] = []
        assert reader.stdout is not None
        threading.Thread(target=lambda: seen.extend(int(line) for line in reader.stdout), daemon=True).start()
        assert until(lambda: publisher.put(reading()) is None and bool(seen))
        os.kill(reader.pid, signal.SIGSTOP)
        flood = threading.Thread(target=lambda: [publisher.put(reading()) for _ in range(40_000)], daemon=True)
        flood.start()
        flood.join(PATIENCE_S)
        assert not flood.is_alive()
        os.kill(reader.pid, signal.SIGCONT)
        after = publisher.sequence
        assert until(lambda: publisher.put(reading()) is None and bool(seen) and seen[-1] >= after)
        assert seen == sorted(seen) and len(seen) < 40_000


def test_the_newest_value_is_the_one_taken(endpoint: str) -> None:
    with Session("simulated", [endpoint], []) as one, Session("simulated", [], [endpoint]) as other:
        latest, publisher = other.latest("force/sensor"), one.publisher("force/sensor")
        assert until(lambda: publisher.put(reading()) is None and latest.take() is not None)
        last = [publisher.put(reading()) or publisher.sequence - 1 for _ in range(50)][-1]
        assert until(lambda: (m := latest.take()) is not None and m.sequence == last)
        assert latest.take() is None


def test_what_is_malformed_is_counted_and_never_taken(endpoint: str) -> None:
    with Session("simulated", [endpoint], []) as session:
        latest = session.latest("force/sensor")
        recorder = session.everything()
        good = encode(reading())
        bad = [b"", b"junk", good[:-1], good + b"\x00", b"\x00" * 100_000, msgpack.packb({"schema_version": 1})]
        for count, payload in enumerate(bad, start=1):
            session.zenoh.put(key("simulated", "force/sensor"), payload)
            assert until(lambda count=count: latest.take() is None and latest.malformed == count)
        assert latest.complaint and recorder.take() == [] and recorder.malformed == len(bad)


def test_those_that_connect_to_one_listener_reach_each_other(endpoint: str) -> None:
    with (
        Session("simulated", [endpoint], []),
        Session("simulated", [], [endpoint]) as one,
        Session("simulated", [], [endpoint]) as other,
    ):
        publisher, latest = one.publisher("force/sensor"), other.latest("force/sensor")
        assert until(lambda: publisher.put(reading()) is None and latest.take() is not None)


def command(name: str = "console", number: int = 1) -> Command:
    return Command(stamp_ns=5, id=f"c{number}", commander=name, expires_ns=6, action="arm", target="none")


def test_a_request_is_answered_and_comes_with_the_name_in_its_key(endpoint: str) -> None:
    asked: list[tuple[str, str]] = []

    def answer(name: str, payload: bytes) -> Reply:
        asked.append((name, decode(Command, payload).id))
        return Reply(stamp_ns=5, id=asked[-1][1], result="refused", text="because")

    with Session("simulated", [endpoint], []) as rig, Session("simulated", [], [endpoint]) as console:
        server = rig.serve_requests(answer)
        replies: list[Reply] = []
        assert until(lambda: (reply := console.ask(command())) is not None and (replies.append(reply) is None))
        assert (replies[0].id, replies[0].result, replies[0].text) == ("c1", "refused", "because")
        assert console.ask(command("other", 2), PATIENCE_S) is not None
        assert set(asked) == {("console", "c1"), ("other", "c2")} and server is not None


def test_what_gets_no_reply_leaves_the_asker_without_one_at_once(endpoint: str) -> None:
    with Session("simulated", [endpoint], []) as rig, Session("simulated", [], [endpoint]) as console:
        heard: list[bytes] = []
        server = rig.serve_requests(lambda name, payload: heard.append(payload))
        assert until(lambda: console.ask(command(), timeout_s=60.0) is None and bool(heard)) and server is not None


def test_a_failure_while_answering_leaves_the_others_answered(endpoint: str) -> None:
    def answer(name: str, payload: bytes) -> Reply:
        if name == "bad":
            raise RuntimeError("broken")
        return Reply(stamp_ns=5, id=decode(Command, payload).id, result="accepted")

    with Session("simulated", [endpoint], []) as rig, Session("simulated", [], [endpoint]) as console:
        server = rig.serve_requests(answer)
        assert until(lambda: console.ask(command()) is not None)
        assert console.ask(command("bad", 2), PATIENCE_S) is None and server.failures == 1
        assert console.ask(command("console", 3), PATIENCE_S) is not None


def test_a_request_to_all_names_at_once_is_no_command(endpoint: str) -> None:
    heard: list[str] = []

    def answer(name: str, payload: bytes) -> Reply:
        heard.append(name)
        return Reply(stamp_ns=0, id="", result="refused")

    with Session("simulated", [endpoint], []) as rig:
        server = rig.serve_requests(answer)
        for pattern in ("request/*", "request/**", "**"):
            assert list(rig.zenoh.get(f"seldinger/v1/simulated/{pattern}", payload=encode(command()), timeout=2.0)) == []
        assert all("*" in name for name in heard) and server is not None


def test_nobody_to_answer_is_no_answer(endpoint: str) -> None:
    with Session("simulated", [], [endpoint]) as console:
        assert console.ask(command(), timeout_s=0.2) is None


@pytest.mark.parametrize(
    "bad",
    [
        "tcp/0.0.0.0:7447",
        "tcp/192.168.1.5:7447",
        "tcp/localhost:7447",
        "tcp/127.0.0.1:0",
        "tcp/127.0.0.1:99999",
        "tcp/127.0.0.1",
        "udp/127.0.0.1:7447",
        "tls/127.0.0.1:7447",
        "quic/127.0.0.1:7447",
        "tcp/127.0.0.1:7447#iface=eth0",
        "tcp/[::]:7447",
        "unixsock-stream/",
        "unixsock-stream//tmp/a b",
        "",
        "tcp/127.0.0.1:7447\n",
    ],
)
def test_endpoints_that_leave_this_machine_are_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="endpoint: found"):
        Session("simulated", [bad], [])
    with pytest.raises(ValueError, match="endpoint: found"):
        Session("simulated", [], [bad])


@pytest.mark.parametrize("good", ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "unixsock-stream//run/seldinger/rig.sock"])
def test_endpoints_on_this_machine_are_taken(good: str) -> None:
    assert check_endpoint(good) == good


def test_scouting_is_off_and_reconnecting_never_ends() -> None:
    config = configuration(["tcp/127.0.0.1:7447"], [])
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("scouting/gossip/enabled") == "false"
    assert config.get_json("connect/timeout_ms") == "-1"


def test_a_port_that_is_taken_is_said(endpoint: str) -> None:
    if endpoint.startswith("unix"):
        return
    with Session("simulated", [endpoint], []), pytest.raises(OSError, match="wanted to listen on tcp"):
        Session("simulated", [endpoint], [])


def listening_sockets() -> set[str]:
    """Local addresses (hexadecimal, as in /proc/net) of this process' listening TCP sockets and of all its UDP ones."""
    mine = {os.readlink(link) for link in Path("/proc/self/fd").iterdir() if os.path.lexists(link)}
    found = set()
    for table, states in (("tcp", {"0A"}), ("tcp6", {"0A"}), ("udp", {"07", "01"}), ("udp6", {"07", "01"})):
        for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] in states and f"socket:[{words[9]}]" in mine:
                found.add(f"{table} {words[1]}")
    return found


def test_a_session_opens_no_other_socket_than_it_was_told(endpoint: str) -> None:
    before = listening_sockets()
    with Session("simulated", [], [endpoint]):
        assert listening_sockets() == before
    with Session("simulated", [endpoint], []):
        opened = listening_sockets() - before
        assert len(opened) == (1 if endpoint.startswith("tcp") else 0)
        assert all(address.startswith("tcp 0100007F:") for address in opened)


LEFT_OPEN = """
import sys
from protocol.zenoh_session import Session
session = Session("rig", [sys.argv[1]], [])
session.serve_requests(lambda name, payload: None)
reader = session.latest("log")
"""


def test_a_session_that_nobody_closes_does_not_abort_the_interpreter(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", LEFT_OPEN, f"unixsock-stream/{tmp_path}/a.sock"], capture_output=True, text=True
    )
    assert ended.returncode == 0 and ended.stderr == ""


def test_a_session_undeclares_what_it_has_declared_before_it_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh 1.10 panics in about one of a hundred sessions that leave this to their close."""
    order: list[str] = []

    class Entity:
        def undeclare(self) -> None:
            order.append("undeclare")

    class Opened:
        def declare_subscriber(self, *arguments: object) -> Entity:
            return Entity()

        def declare_publisher(self, *arguments: object, **settings: object) -> Entity:
            return Entity()

        def close(self) -> None:
            order.append("close")

    monkeypatch.setattr(zenoh_session, "_open", lambda config, listen: Opened())
    session = Session("r", [], [])
    kept = [session.publisher("plan"), session.latest("state"), session.ring("log", 4), session.everything()]
    dropped = session.latest("board")
    del dropped  # zenoh undeclares what is no longer referenced
    session.close()
    topics = sum(topic.kind != "query" for topic in TOPICS.values())
    assert order == ["undeclare"] * (3 + topics) + ["close"] and kept


def test_a_session_is_closed_while_other_threads_publish_and_read() -> None:
    message, ended = ForceSensor(stamp_ns=1, arrival_ns=0, force_N=(0.0, 0.0, 0.0)), list[str]()

    def use(name: str, call: Callable[[], object]) -> None:
        with suppress(zenoh.ZError):
            while True:
                call()
        ended.append(name)

    for _ in range(5):  # zenoh alone raised RuntimeError in 277 of 300 such closes
        session = Session("simulated", [], [])
        publisher, latest = session.publisher("force/sensor"), session.latest("force/sensor")
        threads = [
            threading.Thread(target=use, args=("publisher", partial(publisher.put, message))),
            threading.Thread(target=use, args=("reader", latest.take)),
        ]
        for thread in threads:
            thread.start()
        time.sleep(0.01)
        session.close()
        for thread in threads:
            thread.join()
    assert sorted(ended) == ["publisher"] * 5 + ["reader"] * 5
