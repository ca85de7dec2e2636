"""The rig's lines as bytes: what the devices sent, what the computer sends, and the sensor drivers between both."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from protocol.rig_file import Rig
from realtime.drivers.aurora import AuroraClient, AuroraConfig, PoseSample
from realtime.drivers.aurora_session import LineAction
from realtime.drivers.device_events import DeviceEvent
from realtime.drivers.net_ft import ForceSample, NetFtClient, NetFtConfig
from realtime.drivers.net_ft_calibration import NetFtCalibration
from realtime.drivers.tool_definition import read_definition


@dataclass
class FromRig:
    """Data that has reached the computer: bytes of the board and the tracker, datagrams of the force sensor."""

    board: bytes = b""
    tracker: bytes = b""
    force: list[bytes] = field(default_factory=list)


@dataclass
class ToRig:
    """Data that the computer sends. `tracker_line` is carried out on the tracker's line before its bytes are sent."""

    board: bytes = b""
    tracker: bytes = b""
    tracker_line: list[LineAction] = field(default_factory=list)
    force: list[bytes] = field(default_factory=list)


class Readings(NamedTuple):
    """Poses, forces and events that the sensor drivers decoded from the received bytes."""

    poses: list[PoseSample]
    forces: list[ForceSample]
    events: list[DeviceEvent]


def tracker_config(rig: Rig) -> AuroraConfig:
    """Return the tracker driver's settings for `rig`. Raises InputError for a tool definition that cannot be read."""
    tracker = rig.tracker
    return AuroraConfig(
        tools=tuple(tool.handle for tool in tracker.tools),
        rate_hz=tracker.rate_hz,
        latency_s=tracker.latency_s,
        definitions={
            tool.handle: read_definition(f"tracker.{tool.name}_definition", tool.definition)
            for tool in tracker.tools
            if tool.definition
        },
    )


def force_config(rig: Rig) -> NetFtConfig:
    """Return the force sensor driver's settings for `rig`."""
    sensor = rig.force_sensor
    return NetFtConfig(
        NetFtCalibration(
            counts_per_N=sensor.counts_per_newton, counts_per_Nm=sensor.counts_per_newton_metre, rdt_rate_hz=sensor.rate_hz
        )
    )


class SensorClients:
    """Both sensor drivers without threads, for a caller that moves the bytes itself."""

    def __init__(self, rig: Rig) -> None:
        self.tracker, self.force_sensor = AuroraClient(tracker_config(rig)), NetFtClient(force_config(rig))

    def feed(self, arriving: FromRig, now_ns: int) -> Readings:
        """Return poses, forces and events in the bytes that were read at `now_ns` (ns)."""
        poses = self.tracker.feed(arriving.tracker, now_ns)
        samples = [self.force_sensor.feed(datagram, now_ns) for datagram in arriving.force]
        events = self.tracker.take_events() + self.force_sensor.take_events()
        return Readings(poses, [sample for sample in samples if sample is not None], events)

    def outgoing(self, board: bytes, now_ns: int) -> ToRig:
        """Return what the drivers send at `now_ns` (ns), together with the bytes for the board."""
        request = self.force_sensor.outgoing(now_ns)
        sending = self.tracker.outgoing(now_ns)
        return ToRig(board, sending, self.tracker.line_actions(), [request] if request else [])
