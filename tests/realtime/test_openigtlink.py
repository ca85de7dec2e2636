"""OpenIGTLink as a tracker: bytes that pyigtl packs, a server that goes away, times of measurement, and the rig file."""

from __future__ import annotations

import math
import socket
import time

import numpy as np
import pyigtl
import pytest

from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, parse_rig, read_rig_data
from realtime.core.device_sources import SourceThread, tracker_thread
from realtime.core.intake import rotation
from realtime.drivers.check_device import check_poses
from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.openigtlink import IgtlReader, address_of, crc64, open_tracker, quaternion_of
from sim.aurora_emulator import AuroraEmulator, AuroraEmulatorConfig
from sim.plus_server import PlusServer
from tests.waiting import until

QUATERNIONS = [
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 0.6, 0.8),
    (0.5, -0.5, 0.5, -0.5),
    (0.1, 0.7, -0.5, 0.5),
]


def packed(
    name: str = "Tip", position_m: tuple[float, ...] = (0.01, -0.02, 0.15), stamp_s: float = 1e9, version: int = 1
) -> bytes:
    matrix = np.eye(4)
    matrix[:3, 3] = 1e3 * np.array(position_m)
    message = pyigtl.TransformMessage(matrix, timestamp=stamp_s, device_name=name)
    message.header_version = version
    return bytes(message.pack())


def rig_with(port: str, **changes: object) -> Rig:
    data = read_rig_data(SIMULATED_RIG)
    data["tracker"] |= {"kind": "openigtlink", "port": port, "tip_handle": "0A", "shaft_handle": "0B", **changes}
    return parse_rig(data)


@pytest.mark.parametrize("version", [1, 2])
def test_a_transform_of_another_implementation_is_read_in_any_pieces(version: int) -> None:
    data = packed("A", version=version) + bytes(pyigtl.StringMessage("hello", device_name="words").pack()) + packed("B")
    for size in (1, 7, 58, len(data)):
        reader = IgtlReader()
        found = [one for at in range(0, len(data), size) for one in reader.feed(data[at : at + size])]
        assert [one.device for one in found] == ["A", "B"] and reader.damaged == 0
        np.testing.assert_allclose(found[0].translation_m, (0.01, -0.02, 0.15), atol=1e-8)
        assert found[0].sent_s == pytest.approx(1e9, abs=1e-6)


@pytest.mark.parametrize("wxyz", QUATERNIONS)
def test_rotations_come_back_as_quaternions(wxyz: tuple[float, ...]) -> None:
    unit = np.array(wxyz) / np.linalg.norm(wxyz)
    np.testing.assert_allclose(rotation(quaternion_of(rotation(unit))), rotation(unit), atol=1e-12)
    assert quaternion_of(rotation(unit))[0] >= 0


def test_a_damaged_body_is_no_pose_and_another_protocol_ends_the_connection() -> None:
    data, reader = bytearray(packed()), IgtlReader()
    data[70] ^= 1
    assert reader.feed(bytes(data)) == [] and reader.damaged == 1
    assert len(reader.feed(packed())) == 1
    with pytest.raises(ValueError, match="wanted OpenIGTLink"):
        reader.feed(b"GET / HTTP/1.1\r\n" * 10)


def test_a_mirrored_or_scaled_matrix_is_no_pose() -> None:
    for matrix in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0]), np.diag([math.nan, 1.0, 1.0, 1.0])):
        reader = IgtlReader()
        assert reader.feed(bytes(pyigtl.TransformMessage(matrix, device_name="Tip").pack())) == [] and reader.damaged == 1


def test_the_checksum_is_that_of_the_standard() -> None:
    assert crc64(b"123456789") == 0x6C40DF5F0B497347  # check value of CRC-64/ECMA-182


def test_poses_of_a_server_arrive_with_the_time_of_measurement() -> None:
    emulator = AuroraEmulator(AuroraEmulatorConfig(position_noise_m=1e-6, orientation_noise_rad=1e-6), 1)
    server = PlusServer(emulator, ("127.0.0.1", 0))
    source = open_tracker(rig_with(server.path).tracker)
    pose = (np.array([0.01, -0.02, -0.15]), np.array([0.5, 0.5, 0.5, 0.5]))
    samples = []
    for _ in range(30):
        frame_ns = emulator.next_frame_ns
        emulator.sample(frame_ns, [pose, pose])
        server.step(frame_ns + 50_000_000)
        samples += source.read()
    source.close()
    server.close()
    assert {sample.tool for sample in samples} == {"0A", "0B"} and len(samples) > 40
    last = samples[-1]
    np.testing.assert_allclose(last.position_m, pose[0], atol=1e-4)
    np.testing.assert_allclose(last.quaternion_wxyz, pose[1], atol=1e-3)
    # The stamp is before the arrival by the latency at least, never after it.
    assert all(sample.arrival_ns - sample.stamp_ns >= 24_000_000 for sample in samples)


def test_a_server_that_goes_and_comes_back_is_reported() -> None:
    emulator = AuroraEmulator(AuroraEmulatorConfig(), 1)
    server = PlusServer(emulator, ("127.0.0.1", 0))
    port, samples, events = server.path, [], []
    thread = tracker_thread(rig_with(port), None, samples.append, events.append)
    assert isinstance(thread, SourceThread)
    pose = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def flows() -> bool:
        frame_ns = emulator.next_frame_ns
        emulator.sample(frame_ns, [pose, pose])
        server.step(frame_ns + 50_000_000)
        return bool(samples)

    thread.start()
    assert until(flows)
    server.unplug()
    assert until(lambda: any(event.kind is DeviceEventKind.LOST for event in events))
    server = PlusServer(emulator, address_of(port))
    samples.clear()
    assert until(flows)
    thread.stop()
    server.close()
    assert [event.kind for event in events if event.kind is not DeviceEventKind.ERROR] == [
        DeviceEventKind.TRACKING,
        DeviceEventKind.LOST,
        DeviceEventKind.RECONNECTED,
    ]


def test_a_missing_server_is_said_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    rig, began_s = rig_with(f"127.0.0.1:{port}"), time.monotonic()
    report = check_poses(lambda sample, event: tracker_thread(rig, None, sample, event), ("0A",), 40.0, 5.0, "openigtlink")
    assert not report.good and "no server at" in report.problems[0], time.monotonic() - began_s


@pytest.mark.parametrize("port", ["", "nohost:", "host:port", "host:99999", ":18944"])
def test_an_address_that_is_none_is_refused(port: str) -> None:
    with pytest.raises(InputError, match=r"tracker\.port"):
        address_of(port)


def test_a_kind_that_no_package_offers_is_refused_with_those_that_exist() -> None:
    with pytest.raises(InputError, match=r'tracker.kind: found "polaris", wanted one of aurora, openigtlink'):
        tracker_thread(rig_with("x", kind="polaris"), None, print)
