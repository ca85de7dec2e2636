"""The emulators behind a pty and UDP, read by the real threads on the wall clock; nothing here asserts a time."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from realtime.drivers.aurora import AuroraConfig
from realtime.drivers.check_device import check_aurora, check_net_ft
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.net_ft import ForceSample, NetFtConfig
from realtime.drivers.net_ft_calibration import fetch_calibration
from realtime.drivers.pose_sample import PoseSample
from realtime.drivers.sensor_threads import AuroraThread, NetFtThread
from realtime.drivers.transport import open_serial
from sim.aurora_emulator import AuroraEmulator, AuroraEmulatorConfig
from sim.net_ft_emulator import NetFtEmulator, NetFtEmulatorConfig
from sim.sensor_faults import SensorFault
from sim.sensor_servers import AuroraPty, NetFtUdp, SensorServers
from tests.waiting import until

PATIENCE_S = 60.0


@dataclass
class Rig:
    aurora: AuroraPty
    net_ft: NetFtUdp
    servers: SensorServers
    events: list[DeviceEvent] = field(default_factory=list)
    poses: list[PoseSample] = field(default_factory=list)
    forces: list[ForceSample] = field(default_factory=list)

    def kinds(self, device: str) -> list[DeviceEventKind]:
        kept = (DeviceEventKind.TRACKING, DeviceEventKind.LOST, DeviceEventKind.RECONNECTED)
        return [event.kind for event in list(self.events) if event.device == device and event.kind in kept]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    start_ns = time.monotonic_ns()
    aurora = AuroraPty(
        AuroraEmulator(AuroraEmulatorConfig(start_ns=start_ns, init_s=0.05, reset_s=0.1), 1), tmp_path / "aurora"
    )
    net_ft = NetFtUdp(NetFtEmulator(NetFtEmulatorConfig(start_ns=start_ns), 2))
    pose = (np.array([0.01, -0.02, -0.15]), np.array([1.0, 0.0, 0.0, 0.0]))
    servers = SensorServers(
        aurora, lambda time_ns: [pose, pose], net_ft, lambda time_ns: (np.array([0.0, 0.0, 0.2]), np.zeros(3))
    )
    servers.start()
    yield Rig(aurora, net_ft, servers)
    servers.stop()
    aurora.close()
    net_ft.close()


def test_an_aurora_on_a_pty_is_read_unplugged_and_found_again(rig: Rig, tmp_path: Path) -> None:
    thread = AuroraThread(
        lambda: open_serial(str(tmp_path / "aurora"), 9600),
        rig.poses.append,
        AuroraConfig(poll_timeout_s=2.0),
        rig.events.append,
    )
    thread.start()
    until(lambda: len(rig.poses) > 20, "poses")
    assert rig.aurora.emulator.baud == 921600
    with rig.servers.lock:
        rig.aurora.unplug()
    until(lambda: DeviceEventKind.LOST in rig.kinds("aurora"), "the loss to be noticed")
    with rig.servers.lock:
        rig.aurora.plug()
    until(lambda: DeviceEventKind.RECONNECTED in rig.kinds("aurora"), "the device to be found again")
    count = len(rig.poses)
    until(lambda: len(rig.poses) > count + 20, "poses after the reconnection")
    thread.stop()
    assert thread.error is None and not thread.is_alive() and thread.failures >= 1
    sample = rig.poses[-1]
    assert sample.position_m == pytest.approx([0.01, -0.02, -0.15], abs=0.003)
    assert sample.stamp_ns < sample.arrival_ns


def test_a_net_ft_box_is_read_biased_unplugged_and_found_again(rig: Rig) -> None:
    calibration = fetch_calibration("127.0.0.1", rig.net_ft.web_port, timeout_s=PATIENCE_S)
    assert calibration.counts_per_N == 1e6
    thread = NetFtThread(
        "127.0.0.1", rig.forces.append, NetFtConfig(calibration, silent_after_s=1.0), rig.events.append, rig.net_ft.rdt_port
    )
    thread.start()
    until(lambda: len(rig.forces) > 100, "forces")
    assert rig.forces[-1].force_N == pytest.approx([0.0, 0.0, 0.2], abs=0.03)
    thread.request_bias()
    until(lambda: abs(rig.forces[-1].force_N[2]) < 0.03, "the bias")
    with rig.servers.lock:
        rig.net_ft.unplug()
    until(lambda: DeviceEventKind.LOST in rig.kinds("net_ft"), "the loss to be noticed")
    with rig.servers.lock:
        rig.net_ft.plug()
    until(lambda: DeviceEventKind.RECONNECTED in rig.kinds("net_ft"), "the box to be found again")
    thread.stop()
    assert thread.error is None and not thread.is_alive()


def test_the_page_is_served_and_nothing_else(rig: Rig) -> None:
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", rig.net_ft.web_port, timeout=PATIENCE_S)
    connection.request("GET", "/other")
    assert connection.getresponse().status == 404
    connection.close()
    closed = rig.net_ft.web_port
    rig.net_ft._web.shutdown()
    rig.net_ft._web.server_close()
    with pytest.raises(OSError):
        fetch_calibration("127.0.0.1", closed, timeout_s=PATIENCE_S)


def test_a_port_that_is_not_there_is_tried_for_ever(tmp_path: Path) -> None:
    events: list[DeviceEvent] = []
    thread = AuroraThread(lambda: open_serial(str(tmp_path / "nothing"), 9600), lambda sample: None, on_event=events.append)
    thread.start()
    until(lambda: thread.failures >= 2, "two attempts")
    thread.stop()
    assert thread.error is None and not thread.is_alive()
    assert all(event.kind is DeviceEventKind.ERROR and "nothing" in event.text for event in events)


def test_what_a_callback_raises_ends_the_thread_and_is_kept(rig: Rig) -> None:
    def fail(sample: ForceSample) -> None:
        raise RuntimeError("the mailbox is broken")

    hook, threading.excepthook = threading.excepthook, lambda args: None
    try:
        thread = NetFtThread(
            "127.0.0.1", fail, NetFtConfig(fetch_calibration("127.0.0.1", rig.net_ft.web_port)), port=rig.net_ft.rdt_port
        )
        thread.start()
        until(lambda: not thread.is_alive(), "the thread to end")
    finally:
        threading.excepthook = hook
    assert isinstance(thread.error, RuntimeError)


def test_check_device_finds_good_devices_good(rig: Rig, tmp_path: Path) -> None:
    aurora = check_aurora(lambda: open_serial(str(tmp_path / "aurora"), 9600), AuroraConfig(poll_timeout_s=2.0), 1.0)
    assert aurora.figures["damaged"] == 0 and str(aurora.figures["firmware"]).startswith("AURORA")
    assert float(aurora.figures["0A.noise_m"]) == pytest.approx(0.00029, rel=0.6)
    box = check_net_ft("127.0.0.1", 1.0, rig.net_ft.rdt_port, rig.net_ft.web_port)
    assert box.figures["counts_per_N"] == 1e6 and box.figures["status_errors"] == 0
    assert float(box.figures["mean_z_N"]) == pytest.approx(0.2, abs=0.01)


def test_check_device_names_what_is_wrong(rig: Rig, tmp_path: Path) -> None:
    rig.aurora.emulator.faults.append(SensorFault("missing", 0, 10**19, handle="0B"))
    rig.net_ft.emulator.faults.append(SensorFault("drop", 0, 10**19, value=0.2))
    config = AuroraConfig(tools=("0A", "0B", "0C"), poll_timeout_s=2.0)
    aurora = check_aurora(lambda: open_serial(str(tmp_path / "aurora"), 9600), config, 1.0)
    assert not aurora.good
    assert any("0B: missing in 100.0 %" in text for text in aurora.problems)
    assert any("not plugged in: 0C" in text for text in aurora.problems)
    box = check_net_ft("127.0.0.1", 1.0, rig.net_ft.rdt_port, rig.net_ft.web_port)
    assert any("records lost" in text for text in box.problems)
    closed = check_net_ft("127.0.0.1", 1.0, rig.net_ft.rdt_port, web_port=1)
    assert not closed.good and closed.figures == {}
