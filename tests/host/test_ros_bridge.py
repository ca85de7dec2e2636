"""The ROS 2 bridge: CDR decoded by another library, keys and hashes as rmw_zenoh has them, commands through the lease."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from pycdr2 import IdlStruct
from pycdr2.types import float64, int32, uint32
from rosbags.typesys import Stores, get_typestore

from host.run.connection import CommandRefused
from host.run.ros_bridge import PUBLISHED, SERVO_FORCE, WRENCH, RosBridge, RosMessages, attachment, key_of, operating_state
from protocol.commander import Acknowledgement
from protocol.errors import InputError
from protocol.topics import ForceSensor, Message, Pose, RigState
from tests.waiting import free_port, until

TURN = (0.5, 0.5, -0.5, 0.5)
TIME_NS = 1_700_000_000_250_000_000


# The same messages declared for pycdr2, written from ROS 2's definitions.
@dataclass
class Time(IdlStruct, typename="Time"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="Header"):
    stamp: Time
    frame_id: str


@dataclass
class Vector(IdlStruct, typename="Vector"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="Quaternion"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class PoseStamped(IdlStruct, typename="PoseStamped"):
    header: Header
    position: Vector
    orientation: Quaternion


@dataclass
class WrenchStamped(IdlStruct, typename="WrenchStamped"):
    header: Header
    force: Vector
    torque: Vector


@dataclass
class OperatingState(IdlStruct, typename="OperatingState"):
    header: Header
    state: str
    is_homed: bool
    is_busy: bool


POSE = Pose(stamp_ns=1, arrival_ns=1, frame=1, missing=False, position_m=(0.001, -0.0107, 0.025), quaternion_wxyz=TURN)
FORCE = ForceSensor(stamp_ns=1, arrival_ns=1, force_N=(0.01, -0.02, 0.2))


def state(mode: str, action: str = "none", **more: Any) -> RigState:
    return RigState(stamp_ns=1, mode=mode, safety_action=action, **more)


def test_a_pose_decodes_with_another_library() -> None:
    data = RosMessages().pack(POSE, TIME_NS)
    assert data is not None
    read = PoseStamped.deserialize(data)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert read.header.frame_id == "sheath_exit"
    assert (read.position.x, read.position.y, read.position.z) == POSE.position_m
    assert (read.orientation.w, read.orientation.x, read.orientation.y, read.orientation.z) == TURN


def test_a_force_decodes_with_another_library() -> None:
    data = RosMessages().pack(FORCE, TIME_NS)
    assert data is not None
    read = WrenchStamped.deserialize(data)
    assert (read.force.x, read.force.y, read.force.z) == FORCE.force_N and read.torque.z == 0.0


@pytest.mark.parametrize(
    ("message", "word", "busy"),
    [
        (state("disarmed"), "DISABLED", False),
        (state("hold"), "PAUSED", False),
        (state("contact"), "ENABLED", True),
        (state("position"), "ENABLED", True),
        (state("stopped", "stop"), "FAULT", False),
        (state("retract", "retract"), "FAULT", True),
    ],
)
def test_states_are_those_of_crtk(message: RigState, word: str, busy: bool) -> None:
    data = RosMessages().pack(message, TIME_NS)
    assert data is not None
    read = OperatingState.deserialize(data)
    assert (read.state, read.is_busy) == (word, busy) == (operating_state(message), busy)


def test_a_type_hash_is_the_one_that_ros_2_prints() -> None:
    # `ros2 topic info --verbose` of std_msgs/msg/String in ROS 2 Iron and later.
    known = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert RosMessages().type_hash("std_msgs/msg/String") == known
    key = key_of(PUBLISHED["pose/tip"], "seldinger", 0, "RIHS01_x")
    assert key == "0/seldinger/measured_cp/geometry_msgs::msg::dds_::PoseStamped_/RIHS01_x"


def test_an_attachment_reads_back_as_rmw_zenoh_reads_it() -> None:
    kinds = tuple[str, zenoh.ext.Int64, str, zenoh.ext.Int64, str, bytes]
    read = zenoh.ext.z_deserialize(kinds, attachment(7, TIME_NS, bytes(range(16))))
    assert read == ("sequence_number", 7, "source_timestamp", TIME_NS, "source_gid", bytes(range(16)))


class FakeRig:
    """A connection whose newest messages a test decides, and that notes what is commanded."""

    def __init__(self) -> None:
        self.newest: dict[str, Message] = {}
        self.said: list[Any] = []
        self.refuse = False

    def latest(self, topic: str) -> Message | None:
        return self.newest.get(topic)

    def take(self) -> None:
        if self.refuse:
            raise CommandRefused("take", Acknowledgement(False, "held by console", "refused"))
        self.said.append("take")

    def force(self, force_N: float) -> None:
        self.said.append(force_N)


@pytest.fixture
def router() -> Iterator[tuple[zenoh.Session, str]]:
    """A zenoh session that listens on loopback, as a ROS 2 router does."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    settings = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": quiet}
    config = zenoh.Config.from_json5(json.dumps(settings))
    with zenoh.open(config) as session:
        yield session, endpoint


def test_a_subscriber_on_the_ros_key_gets_the_pose_and_sees_the_node(router: tuple[zenoh.Session, str]) -> None:
    session, endpoint = router
    reader = session.declare_subscriber("0/lab/measured_cp/**", zenoh.handlers.RingChannel(1))
    rig = FakeRig()
    bridge = RosBridge(rig, endpoint, namespace="lab")  # type: ignore[arg-type]
    samples: list[zenoh.Sample] = []
    stamp_ns = 0

    def arrived() -> bool:
        nonlocal stamp_ns
        stamp_ns += 1
        rig.newest["pose/tip"] = Pose(
            stamp_ns=stamp_ns, arrival_ns=1, frame=1, missing=False, position_m=(0.0, 0.0, 0.1), quaternion_wxyz=TURN
        )
        bridge.step()
        sample = reader.try_recv()
        samples.extend([] if sample is None else [sample])
        return bool(samples)

    assert until(arrived)
    assert PoseStamped.deserialize(samples[0].payload.to_bytes()).position.z == 0.1 and samples[0].attachment is not None
    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/0/**")]
    assert any("/NN/%/%lab/seldinger" in token for token in tokens)
    assert sum("/MP/" in token for token in tokens) == len(PUBLISHED)
    bridge.close()


def servo(x: float, y: float, z: float) -> bytes:
    store = get_typestore(Stores.ROS2_JAZZY)
    make = store.types
    vector, header = make["geometry_msgs/msg/Vector3"], make["std_msgs/msg/Header"]
    wrench = make["geometry_msgs/msg/Wrench"](vector(x, y, z), vector(0.0, 0.0, 0.0))
    stamp = make["builtin_interfaces/msg/Time"](0, 0)
    return bytes(store.serialize_cdr(make[WRENCH](header(stamp, ""), wrench), WRENCH))


def test_a_force_command_changes_the_force_of_a_touch_and_nothing_else(router: tuple[zenoh.Session, str]) -> None:
    session, endpoint = router
    rig = FakeRig()
    bridge = RosBridge(rig, endpoint, commands=True)  # type: ignore[arg-type]
    key = key_of(SERVO_FORCE, "seldinger", 0, RosMessages().type_hash(WRENCH))
    rig.newest["state"] = state("contact", force_direction=(0.0, 0.0, 1.0))

    def commanded() -> bool:
        session.put(key, servo(0.0, 0.01, 0.15))
        bridge.step()
        return 0.15 in rig.said

    assert until(commanded) and not bridge.refused
    rig.said.clear()
    bridge.obey(servo(0.1, 0.0, 0.15))  # across the normal
    bridge.obey(servo(float("nan"), 0.0, 0.15))
    bridge.obey(b"\x00\x01\x00\x00 short")
    rig.newest["state"] = state("hold")
    bridge.obey(servo(0.0, 0.0, 0.15))  # no contact
    rig.newest["state"], rig.refuse = state("contact", force_direction=(0.0, 0.0, 1.0)), True
    bridge.obey(servo(0.0, 0.0, 0.15))  # another holds the lease
    assert rig.said == [] and len(bridge.refused) == 5 and "held by console" in bridge.refused[-1]
    bridge.close()


def test_a_router_that_is_not_there_is_one_line() -> None:
    with pytest.raises(InputError, match="--router"):
        RosBridge(FakeRig(), f"tcp/127.0.0.1:{free_port()}")  # type: ignore[arg-type]


def test_forces_are_read_back() -> None:
    np.testing.assert_allclose(RosMessages().force_of(servo(0.1, 0.2, 0.3)), (0.1, 0.2, 0.3))
