"""The running rig as a ROS 2 node, without ROS 2 installed: topics as CRTK names them, over zenoh as rmw_zenoh carries them.

Names and types: "Collaborative Robotics Toolkit" (CRTK) convention. Keys, type hashes, attachment and liveliness tokens:
rmw_zenoh, docs/design.md and liveliness_utils.hpp. Messages are CDR, made by rosbags from ROS 2's own definitions.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from host.run.connection import CommandRefused, RigConnection
from protocol.errors import InputError
from protocol.topics import ForceEstimate, ForceSensor, Message, Pose, RigState

POLL_S = 0.002
FORCE_EVERY_NS, STATE_EVERY_NS = 10_000_000, 50_000_000
POSE, WRENCH = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped"
OPERATING_STATE = "crtk_msgs/msg/OperatingState"
# crtk_msgs is not among ROS 2's own packages; its definition: github.com/collaborative-robotics/crtk_msgs.
_OPERATING_STATE = "std_msgs/Header header\nstring state\nbool is_homed\nbool is_busy\n"
# reliability best effort, durability volatile, keep last 10, as numbers of rmw/types.h; nothing else is requested.
_QOS = "2:2:1,10:,:,:,,"
# A force command across the normal by more than this is not what the rig can do.
ACROSS_N = 0.02
_BUSY = ("position", "approach", "contact", "jog", "retract")


class RosTopic(NamedTuple):
    """One topic of the node: its name below the namespace, ROS type, and "MP" (published) or "MS" (subscribed)."""

    name: str
    type: str
    entity: str


PUBLISHED = {
    "pose/tip": RosTopic("measured_cp", POSE, "MP"),
    "pose/shaft": RosTopic("shaft/measured_cp", POSE, "MP"),
    "pose/rear": RosTopic("rear/measured_cp", POSE, "MP"),
    "force/sensor": RosTopic("measured_cf", WRENCH, "MP"),
    "force/estimate": RosTopic("estimated/measured_cf", WRENCH, "MP"),
    "state": RosTopic("operating_state", OPERATING_STATE, "MP"),
}
SERVO_FORCE = RosTopic("servo_cf", WRENCH, "MS")


class RosMessages:
    """Makes and reads the ROS messages. `frame` is the frame_id of what is measured in the base frame."""

    def __init__(self, frame: str = "sheath_exit") -> None:
        self.frame = frame
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._store.register(get_types_from_msg(_OPERATING_STATE, OPERATING_STATE))

    def type_hash(self, type_name: str) -> str:
        """Return the RIHS01 hash of a type, with which rmw_zenoh distinguishes versions of a type."""
        return self._store.hash_rihs01(type_name)

    def pack(self, message: Message, time_ns: int) -> bytes | None:
        """Return the CDR bytes for a rig's message; None if it has no content for ROS.

        Args:
            message: Pose, ForceSensor, ForceEstimate or RigState. time_ns: of measurement, since 1970.
        """
        if isinstance(message, Pose):
            return self._pose(message, time_ns)
        if isinstance(message, ForceSensor | ForceEstimate):
            return self._force(message, time_ns)
        if isinstance(message, RigState):
            return self._state(message, time_ns)
        return None

    def force_of(self, data: bytes) -> np.ndarray:
        """Return the force (3,) N in the CDR bytes of a WrenchStamped. Raises ValueError where they are none."""
        try:
            wrench: Any = self._store.deserialize_cdr(data, WRENCH)
            force = wrench.wrench.force
            return np.array([force.x, force.y, force.z])
        except Exception as error:  # a reader of foreign bytes raises whatever they lead to
            raise ValueError(f"servo_cf: found {len(data)} bytes that are no {WRENCH} ({error})") from None

    def _make(self, name: str, *fields: Any) -> Any:
        return self._store.types[name](*fields)

    def _header(self, time_ns: int) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(time_ns, 10**9))
        return self._make("std_msgs/msg/Header", stamp, self.frame)

    def _pose(self, pose: Pose, time_ns: int) -> bytes | None:
        if pose.position_m is None or pose.quaternion_wxyz is None:
            return None
        w, x, y, z = pose.quaternion_wxyz
        place = self._make("geometry_msgs/msg/Point", *pose.position_m)
        turn = self._make("geometry_msgs/msg/Quaternion", x, y, z, w)
        body = self._make("geometry_msgs/msg/Pose", place, turn)
        return bytes(self._store.serialize_cdr(self._make(POSE, self._header(time_ns), body), POSE))

    def _force(self, message: ForceSensor | ForceEstimate, time_ns: int) -> bytes | None:
        if message.force_N is None or getattr(message, "frame", "base") != "base":
            return None
        force = self._make("geometry_msgs/msg/Vector3", *message.force_N)
        torque = self._make("geometry_msgs/msg/Vector3", *(getattr(message, "torque_Nm", None) or (0.0, 0.0, 0.0)))
        body = self._make("geometry_msgs/msg/Wrench", force, torque)
        return bytes(self._store.serialize_cdr(self._make(WRENCH, self._header(time_ns), body), WRENCH))

    def _state(self, state: RigState, time_ns: int) -> bytes:
        made = self._make(
            OPERATING_STATE,
            self._header(time_ns),
            operating_state(state),
            state.mode not in ("disarmed", "homing"),
            state.mode in _BUSY,
        )
        return bytes(self._store.serialize_cdr(made, OPERATING_STATE))


def operating_state(state: RigState) -> str:
    """Return CRTK's state: DISABLED (disarmed), FAULT (stopped, or a safety action), PAUSED (hold), ENABLED (moves)."""
    if state.mode == "disarmed":
        return "DISABLED"
    if state.mode == "stopped" or state.safety_action in ("stop", "retract"):
        return "FAULT"
    return "PAUSED" if state.mode == "hold" else "ENABLED"


def key_of(topic: RosTopic, namespace: str, domain: int, type_hash: str) -> str:
    """The zenoh key of a ROS topic: domain, full name without its first slash, type as DDS mangles it, hash of the type."""
    return f"{domain}/{namespace}/{topic.name}/{mangled(topic.type)}/{type_hash}"


def mangled(type_name: str) -> str:
    """A ROS type's name as DDS has it: std_msgs/msg/String is std_msgs::msg::dds_::String_."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def token_of(topic: RosTopic, namespace: str, domain: int, zid: str, number: int, type_hash: str) -> str:
    """The liveliness token that shows the topic in `ros2 topic list`. number: of the entity within the session."""
    full = f"/{namespace}/{topic.name}".replace("/", "%")
    node = f"%/%{namespace.replace('/', '%')}/seldinger"
    return f"@ros2_lv/{domain}/{zid}/0/{number}/{topic.entity}/{node}/{full}/{mangled(topic.type)}/{type_hash}/{_QOS}"


class RosBridge:
    """Publishes a rig's topics to ROS 2 and, where requested, takes force commands from it."""

    def __init__(
        self, rig: RigConnection, router: str, *, namespace: str = "seldinger", domain: int = 0, commands: bool = False
    ) -> None:
        """Join the ROS 2 network.

        Args:
            rig: connection to the rig; with `commands` its lease is taken when a command comes.
            router: zenoh endpoint of the router (`rmw_zenohd`), such as tcp/127.0.0.1:7447.
            namespace: ROS namespace of the topics. domain: ROS_DOMAIN_ID. commands: listen to servo_cf.

        Raises:
            OSError: nothing answers at `router`. InputError: the endpoint is none.
        """
        self._rig, self._messages = rig, RosMessages()
        self.refused: list[str] = []
        self._stamps_ns = dict.fromkeys(PUBLISHED, -1)
        self._counts = dict.fromkeys(PUBLISHED, 0)
        self._gid = os.urandom(16)
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._session = _join(router)
        zid = str(self._session.zid())
        topics = [*PUBLISHED.values(), *([SERVO_FORCE] if commands else [])]
        hashes = {topic.type: self._messages.type_hash(topic.type) for topic in topics}
        self._keys = {topic: key_of(topic, namespace, domain, hashes[topic.type]) for topic in topics}
        liveliness = self._session.liveliness()
        node = f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%{namespace.replace('/', '%')}/seldinger"
        tokens = [node, *(token_of(t, namespace, domain, zid, n, hashes[t.type]) for n, t in enumerate(topics, 1))]
        self._tokens = [liveliness.declare_token(token) for token in tokens]
        self._publishers = {name: self._session.declare_publisher(self._keys[topic]) for name, topic in PUBLISHED.items()}
        self._command: Any = None
        if commands:
            ring: Any = zenoh.handlers.RingChannel(1)  # the newest command counts
            self._command = self._session.declare_subscriber(self._keys[SERVO_FORCE], ring)

    def step(self) -> None:
        """Publish what is new, and carry out the newest force command."""
        for name in PUBLISHED:
            message = self._rig.latest(name)
            if message is None or not self._due(name, message.stamp_ns):
                continue
            time_ns = self._epoch_ns + message.stamp_ns
            data = self._messages.pack(message, time_ns)
            if data is not None:
                self._counts[name] += 1
                self._publishers[name].put(data, attachment=attachment(self._counts[name], time_ns, self._gid))
        if self._command is not None:
            sample = self._command.try_recv()
            if sample is not None:
                self.obey(sample.payload.to_bytes())

    def obey(self, data: bytes) -> None:
        """Set the contact force to that of a servo_cf message; a refusal of the rig is stored in `refused`."""
        try:
            force_N = self._messages.force_of(data)
            state: Any = self._rig.latest("state")
            if state is None or state.force_direction is None:
                raise ValueError("servo_cf: found no contact, wanted one: `seldinger touch` begins it")
            normal = np.array(state.force_direction)
            along_N = float(force_N @ normal)
            if not np.all(np.isfinite(force_N)) or np.linalg.norm(force_N - along_N * normal) > ACROSS_N:
                raise ValueError(f"servo_cf: found {force_N.tolist()} N, wanted a force along the normal {normal.tolist()}")
            self._rig.take()
            self._rig.force(along_N)
        except (ValueError, CommandRefused) as refused:
            self.refused.append(str(refused))

    def _due(self, name: str, stamp_ns: int) -> bool:
        every_ns = 1 if name.startswith("pose") else STATE_EVERY_NS if name == "state" else FORCE_EVERY_NS
        if 0 <= stamp_ns - self._stamps_ns[name] < every_ns:
            return False
        self._stamps_ns[name] = stamp_ns
        return True

    def serve(self, stop: threading.Event, report: Callable[[str], None]) -> None:
        """Publish until `stop`; `report` gets a line for each command that is refused."""
        while not stop.wait(POLL_S):
            self.step()
            while self.refused:
                report(self.refused.pop(0))

    def close(self) -> None:
        """Close the session and so leave the ROS 2 network."""
        self._session.close()


def attachment(number: int, time_ns: int, gid: bytes) -> zenoh.ZBytes:
    """What rmw_zenoh sends with each message: its number, time of its source (ns since 1970), id of the publisher."""
    fields = ("sequence_number", zenoh.ext.Int64(number), "source_timestamp", zenoh.ext.Int64(time_ns), "source_gid", gid)
    return zenoh.ext.z_serialize(fields)


def _join(router: str) -> zenoh.Session:
    settings = {
        "mode": "client",
        "connect": {"endpoints": [router], "timeout_ms": 3000},
        "scouting": {"multicast": {"enabled": False}},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise InputError(
            "--router", router, f"the endpoint of a running rmw_zenohd ({str(error).split(' at /')[0][:120]})"
        ) from None
