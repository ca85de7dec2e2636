"""The view's picture, player and server: what a page is told, and who is told nothing."""

from __future__ import annotations

import asyncio
import inspect
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn
import websockets.asyncio.client
import websockets.sync.client
from hypothesis import given
from hypothesis import strategies as st

from host.recordings.drawn_shape import through, twin
from host.recordings.recording import RecordingFile
from host.recordings.rig_picture import Picture, causes_of
from host.view import connections
from host.view.replay import Replay, read_findings
from host.view.server import ADDRESS, MAX_PAGES, PRESENT, WAITING_FRAMES, Guard, Page, ViewServer
from protocol.catheter import load_catheter
from protocol.errors import InputError
from realtime.control import safety
from tests.host.test_foxglove import header, recording  # noqa: F401 - a fixture
from tests.waiting import PATIENCE_S, free_port

MS = 1_000_000
PORT = 8447


# The shape and the picture.


def test_the_twin_starts_at_the_exit_and_bends_as_positive_curvature_does() -> None:
    catheter = load_catheter("blazer_prime_xp")
    points = twin(catheter, -0.08, 0.0, 18.0, None)
    assert points is not None
    np.testing.assert_allclose(points[0], 0.0, atol=1e-12)
    assert points[-1][1] < -0.003 and abs(points[-1][0]) < 1e-9
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert lengths == pytest.approx(catheter.distal_length_m - 0.08, rel=1e-2)
    turned = twin(catheter, -0.08, np.pi / 2, 18.0, None)
    assert turned is not None and turned[-1][0] > 0.003
    assert twin(catheter, -0.2, 0.0, 18.0, None) is None


def test_a_force_pushes_the_twin_back_and_the_tracked_tip_ends_it() -> None:
    catheter = load_catheter("blazer_prime_xp")
    free, pressed = (twin(catheter, -0.08, 0.0, 18.0, force) for force in (None, (0.0, 0.0, 0.2)))
    assert free is not None and pressed is not None and pressed[-1][2] < free[-1][2]
    near = free[-1] + [0.0, 0.0, 0.002]
    shape = through(free, near)
    np.testing.assert_allclose(shape.points_m[-1], near)
    np.testing.assert_allclose(shape.points_m[0], 0.0, atol=1e-12)
    assert shape.gap_m == pytest.approx(0.002)
    far = through(free, free[-1] + 0.05)
    assert far.gap_m is not None and far.gap_m > 0.08
    np.testing.assert_array_equal(far.points_m, free)


def test_a_picture_of_nothing_and_of_old_poses_shows_neither_tip_nor_force() -> None:
    picture = Picture({}, {})
    frame = picture.frame()
    assert frame["mode"] == "" and frame["scene"]["shape"] is None and frame["loop"] is None
    picture.take("pose/tip", {"stamp_ns": 0, "position_m": [0.0, 0.0, 0.02], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]})
    picture.take("force/sensor", {"stamp_ns": 0, "force_N": [0.0, 0.0, 0.1]})
    state = {"mode": "hold", "safety_action": "hold", "cause": "no fresh pose", "tip_m": [0.0, 0.0, 0.02]}
    picture.take("state", {**state, "stamp_ns": 100 * MS})
    fresh = picture.frame()
    assert fresh["scene"]["tip"] == [0.0, 0.0, 0.02] and fresh["scene"]["force"] == [0.0, 0.0, 0.1]
    picture.take("state", {**state, "stamp_ns": 900 * MS})
    old = picture.frame()
    assert old["scene"]["tip"] == [] and old["scene"]["force"] == [] and old["causes"] == ["no fresh pose"]
    assert len(old["rows"]) == 1, "each sample is handed out once"
    json.dumps(old, allow_nan=False)


def test_several_causes_are_told_apart_though_their_sentences_hold_semicolons() -> None:
    flags = safety.BOARD_SILENT | safety.OVER_FORCE | safety.POSE_STALE
    assert causes_of("; ".join(safety.messages(flags))) == safety.messages(flags)
    cut = "; ".join(safety.messages(flags))[:-10]
    assert causes_of(cut) == [cut] and causes_of("") == []


# The player.


def player(path: Path, **options: Any) -> tuple[Replay, list[float]]:
    now = [100.0]
    replay = Replay(RecordingFile(path), clock_s=lambda: now[0], **options)
    replay.hello()
    return replay, now


def test_it_plays_at_its_speed_pauses_and_ends(recording: Path) -> None:  # noqa: F811
    replay, now = player(recording, speed=2.0)
    now[0] += 0.2
    frame = replay.frame()
    assert frame["play"]["at"] == pytest.approx(0.4) and frame["play"]["playing"]
    assert [row[0] for row in frame["rows"]] == pytest.approx(np.arange(0.0, 0.401, 0.01))
    replay.act('{"play": false}')
    now[0] += 5.0
    assert replay.frame()["play"] == {"at": pytest.approx(0.4), "playing": False, "speed": 2.0}
    replay.act('{"play": true, "speed": 1.0}')
    now[0] += 0.1
    assert replay.frame()["play"]["at"] == pytest.approx(0.5)
    now[0] += 50.0
    assert replay.frame()["play"] == {"at": pytest.approx(0.99), "playing": False, "speed": 1.0}


def test_a_jump_back_shows_that_time_with_its_past(recording: Path) -> None:  # noqa: F811
    replay, now = player(recording)
    now[0] += 50.0
    replay.frame()
    replay.act('{"seek_s": 0.3}')
    frame = replay.frame()
    assert frame["jumps"] == 1 and frame["t"] == pytest.approx(0.3)
    assert frame["rows"][0][0] == 0.0 and frame["rows"][-1][0] == pytest.approx(0.3)
    assert frame["scene"]["tip"] == [0.0, -0.008, 0.027]
    assert replay.hello()["past"]["rows"]


@given(
    text=st.one_of(
        st.text(max_size=60),
        st.builds(
            json.dumps,
            st.recursive(
                st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=8),
                lambda inner: (
                    st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["play", "seek_s", "speed", "x"]), inner)
                ),
            ),
        ),
    )
)
def test_nothing_that_a_page_sends_breaks_the_player(text: str, recording: Path) -> None:  # noqa: F811
    replay, _ = player(recording)
    assert replay.act(text)["result"] in ("accepted", "malformed")
    at = replay.frame()["play"]["at"]
    assert 0.0 <= at <= 0.99


def test_windows_of_a_diagnosis_are_placed_on_the_recordings_time(recording: Path, tmp_path: Path) -> None:  # noqa: F811
    report = tmp_path / "report.json"
    report.write_text(
        json.dumps(
            {
                "verdict": "missing_physics",
                "fit": {},
                "seconds": 1.0,
                "effects": [{"id": "backlash", "says": "Play of 3 mm."}],
                "located": [
                    {"subsystem": "insertion", "windows_s": [[0.1, 0.2], [0.4, 0.5]], "condition": "after reversals"}
                ],
            }
        )
    )
    replay, _ = player(recording, findings=read_findings(str(report)))
    hello = replay.hello()
    assert [(window["from"], window["to"]) for window in hello["windows"]] == [(0.1, 0.2), (0.4, 0.5)]
    assert hello["says"] == ["Play of 3 mm."] and hello["verdict"] == "missing_physics"
    report.write_text('{"verdict": "nothing_missing"}')
    with pytest.raises(InputError, match="found no key 'located', wanted the JSON that `seldinger diagnose` writes"):
        read_findings(str(report))
    with pytest.raises(InputError, match="--speed"):
        player(recording, speed=0.0)


# The server: who may read, who may ask.


@pytest.fixture(scope="module")
def port(recording: Path) -> Iterator[int]:  # noqa: F811
    with running(ViewServer(Replay(RecordingFile(recording)), free_port())) as server:
        yield server.port


def shake_hands(port: int, host: str, *origins: str) -> str:
    """The first line of the answer to the opening of a web socket."""
    with open_socket(port, host, *origins) as page:
        page.settimeout(5.0)
        return page.recv(4096).split(b"\r\n")[0].decode()


def open_socket(port: int, host: str, *origins: str) -> socket.socket:
    page = socket.socket()
    page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    page.connect((ADDRESS, port))
    lines = [
        "GET /rig HTTP/1.1",
        f"Host: {host}",
        *(f"Origin: {origin}" for origin in origins),
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
        "",
        "",
    ]
    page.sendall("\r\n".join(lines).encode())
    return page


def test_the_page_and_all_it_needs_come_from_the_installed_packages(port: int) -> None:
    base = f"http://{ADDRESS}:{port}"
    page = httpx.get(base)
    assert page.status_code == 200 and "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert "http://" not in page.text and "https://" not in page.text
    three = "/static/vendor/three.js"
    for path in ("/static/view.js", "/static/scene.js", "/static/view.css", three):
        assert httpx.get(base + path).status_code == 200, path
    assert b"OrbitControls" in httpx.get(base + three).content
    assert httpx.get(base + "/static/%2e%2e/server.py").status_code == 404


def test_other_names_and_other_sites_read_nothing_and_ask_nothing(port: int) -> None:
    here, own = f"{ADDRESS}:{port}", f"http://{ADDRESS}:{port}"
    assert "101" in shake_hands(port, here, own)
    for host in ("evil.example", f"evil.example:{port}", f"{ADDRESS}:9", ADDRESS, ""):
        assert httpx.get(own, headers={"host": host}).status_code in (400, 403)
        assert "101" not in shake_hands(port, host, f"http://{host}")
    for origin in ("http://evil.example", "null", f"https://{here}", f"http://evil.example:{port}", ""):
        assert httpx.get(own, headers={"origin": origin}).status_code == 403
        assert "403" in shake_hands(port, here, origin)
    assert "403" in shake_hands(port, here), "a web socket without an origin"
    assert "101" not in shake_hands(port, here, own, "http://evil.example"), "two origins"
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert httpx.request(method, own).status_code == 403


def test_pages_get_frames_and_answers(port: int) -> None:
    results = []
    with websockets.sync.client.connect(
        f"ws://{ADDRESS}:{port}/rig",
        origin=f"http://{ADDRESS}:{port}",  # type: ignore[arg-type]
        proxy=None,
    ) as page:
        assert json.loads(page.recv())["hello"]["kind"] == "play"
        for message in ('{"play": false}', "nonsense", b"\x00\x01", '{"x": 1}', '{"play": 1}', " " * 2000):
            page.send(message)
            while "answer" not in (received := json.loads(page.recv())):
                assert "frame" in received
            results.append(received["answer"]["result"])
    assert results == ["accepted"] + 5 * ["malformed"]


def test_it_listens_on_loopback_only(port: int) -> None:
    assert ViewServer(Slow(), port).configuration().host == "127.0.0.1"
    for address in addresses_of_this_machine():
        with socket.socket() as probe, pytest.raises(OSError):
            probe.settimeout(1.0)
            probe.connect((address, port))


def addresses_of_this_machine() -> list[str]:
    found = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return sorted(str(address) for address in found if not str(address).startswith("127."))


class running:
    """A server in a thread of this process, until the context is left."""

    def __init__(self, server: ViewServer) -> None:
        self.server = server
        self._uvicorn = uvicorn.Server(server.configuration())
        self._thread = threading.Thread(target=self._uvicorn.run, daemon=True)

    def __enter__(self) -> ViewServer:
        self._thread.start()
        while not self._uvicorn.started:
            assert self._thread.is_alive()
            time.sleep(0.01)
        return self.server

    def __exit__(self, *_: object) -> None:
        self._uvicorn.should_exit = True
        self._thread.join(10.0)
        assert not self._thread.is_alive()


class Slow:
    """A source whose frames are large, so that a page that does not read fills every buffer on the way."""

    def __init__(self) -> None:
        self.frames = 0

    def hello(self) -> dict[str, Any]:
        return {}

    def frame(self) -> dict[str, Any]:
        self.frames += 1
        return {"number": self.frames, "ballast": "x" * 200_000}

    def act(self, text: str) -> dict[str, Any]:
        return {}


def test_a_page_that_stops_reading_loses_frames_and_holds_up_nobody() -> None:
    source = Slow()

    async def read_beside_a_stuck_page(port: int) -> list[int]:
        numbers: list[int] = []
        with open_socket(port, f"{ADDRESS}:{port}", f"http://{ADDRESS}:{port}"):
            async with websockets.asyncio.client.connect(
                f"ws://{ADDRESS}:{port}/rig", proxy=None, max_size=None, origin=f"http://{ADDRESS}:{port}"
            ) as reader:  # type: ignore[arg-type]
                while len(numbers) < 60:
                    message = json.loads(await reader.recv())
                    if "frame" in message:
                        numbers.append(message["frame"]["number"])
        return numbers

    with running(ViewServer(source, port := free_port())) as server:
        pages: list[Page] = []
        watch = threading.Thread(target=lambda: [pages.extend(server.pages) or time.sleep(0.02) for _ in range(100)])
        watch.start()
        numbers = asyncio.run(read_beside_a_stuck_page(port))
        watch.join()
    assert numbers == sorted(set(numbers)) and numbers[-1] - numbers[0] < 120, "the reader was served all the while"
    dropped = sorted(page.dropped for page in set(pages))
    assert len(dropped) == 2 and dropped[1] > 10 > dropped[0]


def test_a_queue_keeps_the_newest() -> None:
    class Socket:
        def __init__(self) -> None:
            self.sent: list[str] = []

        async def send_text(self, text: str) -> None:
            self.sent.append(text)

    async def run() -> list[str]:
        socket = Socket()
        page = Page(socket)  # type: ignore[arg-type]
        for number in range(10):
            page.offer(str(number).encode())
        page.answer({"text": "first"})
        task = asyncio.create_task(page.send_on())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        await asyncio.sleep(0.01)
        task.cancel()
        assert page.dropped == 10 - WAITING_FRAMES
        return socket.sent

    sent = asyncio.run(run())
    assert sent[1:] == ["6", "7", "8", "9"] and "first" in sent[0]


def test_the_guard_names_what_it_refuses() -> None:
    guard = Guard(None, PORT)  # type: ignore[arg-type]

    def problem(**scope: Any) -> str:
        return guard._problem({"type": "http", "method": "GET", "headers": [(b"host", b"127.0.0.1:8447")], **scope})

    assert problem() == "" and "read-only" in problem(method="POST")
    assert "Host" in problem(headers=[]) and "Host" in problem(headers=[(b"host", b"localhost:8447")] * 2)


def idle_clients(kind: str, port: int, count: int) -> list[socket.socket]:
    """Connections that do nothing: bare, with half a request, or web sockets that never send."""
    if kind == "web sockets":
        return [open_socket(port, f"{ADDRESS}:{port}", f"http://{ADDRESS}:{port}") for _ in range(count)]
    clients = [socket.create_connection((ADDRESS, port)) for _ in range(count)]
    for client in clients if kind == "half requests" else []:
        client.sendall(b"GET / HTTP/1.1\r\nHost: ")
    return clients


class Commanded(Slow):
    def frame(self) -> dict[str, Any]:
        return {}

    def act(self, text: str) -> dict[str, Any]:
        return {"action": json.loads(text)["button"], "result": "accepted", "text": ""}


def pressed(page: websockets.sync.client.ClientConnection) -> str:
    page.send('{"button": "stop"}')
    while "answer" not in (received := json.loads(page.recv(timeout=PATIENCE_S))):
        pass
    return str(received["answer"]["result"])


@pytest.mark.parametrize("kind", ["bare", "half requests", "web sockets"])
def test_fifty_idle_sockets_keep_no_stop_button_out(kind: str) -> None:
    with running(ViewServer(Commanded(), port := free_port())) as server:
        own = {"origin": f"http://{ADDRESS}:{port}", "proxy": None}
        with websockets.sync.client.connect(f"ws://{ADDRESS}:{port}/rig", **own) as first:  # type: ignore[arg-type]
            first.send(PRESENT)
            assert pressed(first) == "accepted"
            idle = idle_clients(kind, port, 50)
            assert httpx.get(f"http://{ADDRESS}:{port}/", timeout=PATIENCE_S).status_code == 200
            with websockets.sync.client.connect(f"ws://{ADDRESS}:{port}/rig", **own) as page:  # type: ignore[arg-type]
                assert pressed(page) == "accepted" and pressed(first) == "accepted", "a page in use stays"
                assert len(server.pages) <= MAX_PAGES
        for client in idle:
            client.close()


def test_a_half_open_request_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    with running(ViewServer(Commanded(), port := free_port())):
        for kind in ("bare", "half requests"):
            (client,) = idle_clients(kind, port, 1)
            client.settimeout(PATIENCE_S)
            try:
                assert client.recv(1) == b""
            except ConnectionResetError:
                pass
            client.close()


def test_a_page_receives_every_topic_that_it_draws() -> None:
    """A topic that the picture reads and no source delivers leaves a part of the page empty without a word."""
    from host.recordings import rig_picture
    from host.view import live, replay

    read = set(re.findall(r'(?:_newest\.get|_fresh)\(\s*f?"([a-z/]+)"', inspect.getsource(rig_picture)))
    assert "cause" in read and read <= set(live.DEPTHS) and read <= {*replay.EVERY, *replay.NEWEST}
