"""The OpenIGTLink bridge, read by pyigtl's own client."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator

import numpy as np
import pyigtl
import pytest

from host.run.igtl_bridge import IgtlBridge, NDArrayMessage, messages_of
from protocol.broadcast_server import BroadcastServer
from protocol.topics import ForceSensor, Message, Pose, RigState
from realtime.drivers.openigtlink import IgtlReader
from tests.waiting import until

TURN = (0.5, 0.5, -0.5, 0.5)


class Topics:
    """A session whose newest messages a test decides."""

    def __init__(self) -> None:
        self.newest: dict[str, Message] = {}

    def latest(self, topic: str) -> Topics.Reader:
        return Topics.Reader(self, topic)

    class Reader:
        def __init__(self, topics: Topics, topic: str) -> None:
            self._topics, self._topic = topics, topic

        def take(self) -> Message | None:
            return self._topics.newest.pop(self._topic, None)


def pose(stamp_ns: int) -> Pose:
    return Pose(
        stamp_ns=stamp_ns,
        arrival_ns=stamp_ns,
        frame=1,
        missing=False,
        position_m=(0.001, -0.0107, 0.025),
        quaternion_wxyz=TURN,
    )


def force(stamp_ns: int) -> ForceSensor:
    return ForceSensor(stamp_ns=stamp_ns, arrival_ns=stamp_ns, force_N=(0.01, -0.02, 0.2))


@pytest.fixture
def served() -> Iterator[tuple[IgtlBridge, Topics, pyigtl.OpenIGTLinkClient]]:
    topics = Topics()
    bridge = IgtlBridge(topics, ("127.0.0.1", 0))  # type: ignore[arg-type]
    client = pyigtl.OpenIGTLinkClient(*bridge.server.address)
    yield bridge, topics, client
    client.stop()
    bridge.close()


def test_pyigtls_client_gets_poses_forces_and_state(served: tuple[IgtlBridge, Topics, pyigtl.OpenIGTLinkClient]) -> None:
    bridge, topics, client = served
    got: dict[str, object] = {}
    stamp_ns = 10**9

    def arrived() -> bool:
        nonlocal stamp_ns
        stamp_ns += 200_000_000
        topics.newest = {
            "pose/tip": pose(stamp_ns),
            "force/sensor": force(stamp_ns),
            "state": RigState(stamp_ns=stamp_ns, mode="contact", safety_action="none", cause="", target_force_N=0.2),
        }
        bridge.step()
        got.update({message.device_name: message for message in client.get_latest_messages()})
        return {"TipToBase", "ForceSensorText", "Status"} <= set(got)

    assert until(arrived)
    matrix = got["TipToBase"].matrix
    np.testing.assert_allclose(matrix[:3, 3], (1.0, -10.7, 25.0), atol=1e-5)  # mm
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
    words = json.loads(got["ForceSensorText"].string)
    assert words["force_N"] == [0.01, -0.02, 0.2] and words["whose"] == "tip on tissue"
    assert json.loads(got["Status"].string)["phase"] == "contact"


def test_a_force_as_numbers_comes_back_bit_for_bit() -> None:
    (numbers, _) = messages_of("force/sensor", force(5), 1e9)
    data = numbers.pack()
    header = NDArrayMessage.parse_header(data[:58])
    assert header["message_type"] == "NDARRAY" and header["device_name"] == "ForceSensor"
    again = NDArrayMessage(())
    again.unpack(header, data[58:])
    assert again.values.tolist() == [0.01, -0.02, 0.2]


def test_the_driver_reads_what_the_bridge_sends() -> None:
    (message,) = messages_of("pose/tip", pose(5), 1e9)
    (read,) = IgtlReader().feed(bytes(message.pack()))
    assert read.device == "TipToBase" and read.sent_s == pytest.approx(1e9)
    np.testing.assert_allclose(read.translation_m, (0.001, -0.0107, 0.025), atol=1e-8)


def test_a_missing_pose_sends_nothing() -> None:
    assert messages_of("pose/tip", Pose(stamp_ns=1, arrival_ns=1, frame=1, missing=True), 0.0) == []


def test_a_client_that_does_not_read_is_disconnected_and_the_others_stay() -> None:
    server = BroadcastServer(("127.0.0.1", 0))
    with contextlib.closing(server), socket.create_connection(server.address) as asleep:
        asleep.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with socket.create_connection(server.address) as awake:
            awake.setblocking(False)

            def both() -> bool:
                server.accept()
                return server.clients == 2

            assert until(both)

            def one_left() -> bool:
                server.send(bytes(8192))
                with contextlib.suppress(BlockingIOError):
                    while awake.recv(1 << 20):
                        pass
                return server.clients == 1

            assert until(one_left)
