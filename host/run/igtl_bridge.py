"""The running rig for image guidance: an OpenIGTLink server with its poses, forces and state, for 3D Slicer and PLUS.

| device | message | content |
|---|---|---|
| `TipToBase`, `ShaftToBase`, `RearToBase` | TRANSFORM | measured pose of the sensor, sensor to base, translation in mm |
| `ForceSensor`, `ForceEstimate` | NDARRAY | force of the tip on the tissue, base frame, 3 numbers in N |
| `ForceSensorText`, `ForceEstimateText` | STRING | the same as JSON, with the sampling time |
| `Status` | STRING | phase, safety action, cause, target force: JSON |

The header's time is the time of measurement, as UTC. Nothing is commanded.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pyigtl
from pyigtl.messages import MessageBase

from protocol.broadcast_server import BroadcastServer
from protocol.topics import ForceEstimate, ForceSensor, Message, Pose, RigState
from protocol.zenoh_session import Session
from realtime.core.intake import rotation

POLL_S = 0.002
# Guidance displays redraw at 30 Hz; faster topics are thinned to this.
FORCE_EVERY_NS, STATUS_EVERY_NS = 20_000_000, 100_000_000
POSES = {"pose/tip": "TipToBase", "pose/shaft": "ShaftToBase", "pose/rear": "RearToBase"}
FORCES = {"force/sensor": "ForceSensor", "force/estimate": "ForceEstimate"}
_FLOAT64 = 11  # of OpenIGTLink's scalar types


class NDArrayMessage(MessageBase):  # type: ignore[misc]
    """NDARRAY of 64-bit floats, which pyigtl has no class for: type, number of axes, their lengths, numbers big-endian."""

    def __init__(self, values: Any, timestamp: float | None = None, device_name: str | None = None) -> None:
        super().__init__(timestamp=timestamp, device_name=device_name)
        self._message_type, self._valid_message = "NDARRAY", True
        self.values = np.asarray(values, float)

    def _pack_content(self) -> bytes:
        shape = self.values.shape
        return struct.pack(f">BB{len(shape)}H", _FLOAT64, len(shape), *shape) + self.values.astype(">f8").tobytes()

    def _unpack_content(self, content: bytes) -> None:
        _, axes = struct.unpack_from(">BB", content)
        shape = struct.unpack_from(f">{axes}H", content, 2)
        self.values = np.frombuffer(content, ">f8", offset=2 + 2 * axes).reshape(shape)


def messages_of(topic: str, message: Message, time_s: float) -> list[Any]:
    """Return the OpenIGTLink messages for a message of the rig; none if it has no content for them.

    Args:
        topic: as in docs/topics.md. message: of that topic. time_s: its time of measurement, s since 1970.
    """
    if isinstance(message, Pose) and topic in POSES:
        if message.position_m is None or message.quaternion_wxyz is None:
            return []
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation(message.quaternion_wxyz), 1e3 * np.array(message.position_m)
        return [pyigtl.TransformMessage(matrix, timestamp=time_s, device_name=POSES[topic])]
    if isinstance(message, ForceSensor | ForceEstimate):
        if message.force_N is None or getattr(message, "frame", "base") != "base":
            return []
        name, force_N = FORCES[topic], list(message.force_N)
        text = json.dumps({"time_s": time_s, "force_N": force_N, "frame": "base", "whose": "tip on tissue"})
        return [
            NDArrayMessage(force_N, timestamp=time_s, device_name=name),
            pyigtl.StringMessage(text, timestamp=time_s, device_name=f"{name}Text"),
        ]
    if isinstance(message, RigState):
        words = {"time_s": time_s, "phase": message.mode, "safety_action": message.safety_action, "cause": message.cause}
        text = json.dumps({**words, "target_force_N": message.target_force_N})
        return [pyigtl.StringMessage(text, timestamp=time_s, device_name="Status")]
    return []


class IgtlBridge:
    """Sends a rig's topics to the clients of a server. `step` sends what has come; `serve` does so until it is stopped."""

    def __init__(self, session: Session, address: tuple[str, int]) -> None:
        """Listen at `address` (host, port). Raises OSError where that is not possible."""
        self.server = BroadcastServer(address)
        self._latest = {topic: session.latest(topic) for topic in (*POSES, *FORCES, "state")}
        self._sent_ns = dict.fromkeys(self._latest, 0)
        # The rig's clock is CLOCK_MONOTONIC of its machine: this one, as the bridge runs there.
        self._epoch_s = time.time() - time.monotonic()
        self.sent = 0

    def step(self) -> None:
        """Send all messages that have arrived since the last call."""
        self.server.accept()
        for topic, reader in self._latest.items():
            message = reader.take()
            if message is None or not self._due(topic, message.stamp_ns):
                continue
            for packed in messages_of(topic, message, self._epoch_s + message.stamp_ns * 1e-9):
                self.server.send(packed.pack())
                self.sent += 1

    def _due(self, topic: str, stamp_ns: int) -> bool:
        every_ns = 0 if topic in POSES else STATUS_EVERY_NS if topic == "state" else FORCE_EVERY_NS
        if 0 <= stamp_ns - self._sent_ns[topic] < every_ns:
            return False
        self._sent_ns[topic] = stamp_ns
        return True

    def serve(self, stop: threading.Event, report: Callable[[str], None]) -> None:
        """Send until `stop`; `report` gets a line when the number of clients changes."""
        clients = 0
        while not stop.wait(POLL_S):
            self.step()
            if self.server.clients != clients:
                clients = self.server.clients
                report(f"{clients} client{'' if clients == 1 else 's'}")

    def close(self) -> None:
        """Close the server and disconnect all clients."""
        self.server.close()
