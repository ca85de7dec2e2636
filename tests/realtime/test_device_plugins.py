"""The plug-in of docs/devices.md as printed there, found by its entry point and read by the thread of the loop."""

from __future__ import annotations

import re
import socket
import sys
import time
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from host.commissioning.device_check import check_force_box, check_tracker
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, parse_rig, read_rig_data
from realtime.core.device_sources import FORCE_SENSORS, TRACKERS, SourceThread, force_thread, tracker_thread
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.nano17_daq import Nano17Source, open_force_sensor
from realtime.drivers.net_ft import ForceSample
from realtime.drivers.pose_sample import PoseFlag, PoseSample
from realtime.drivers.sample_checks import checked_force, checked_pose
from tests.waiting import until

PAGE = (Path(__file__).parents[2] / "docs" / "devices.md").read_text(encoding="utf-8")
CODE = re.search(r"```python\n(\"\"\"lab_devices.*?)```", PAGE, re.DOTALL)


def rig_with(section: str, **changes: object) -> Rig:
    data = read_rig_data(SIMULATED_RIG)
    data[section] |= changes
    return parse_rig(data)


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        trial.bind(("127.0.0.1", 0))
        return int(trial.getsockname()[1])


@pytest.fixture
def lab_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's package, as `pip install .` leaves it: a module and its entry points."""
    assert CODE is not None
    (tmp_path / "lab_devices.py").write_text(CODE[1], encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "lab_devices", raising=False)
    points = {
        TRACKERS: [metadata.EntryPoint("udp_text", "lab_devices:open_tracker", TRACKERS)],
        FORCE_SENSORS: [metadata.EntryPoint("udp_text", "lab_devices:open_force_sensor", FORCE_SENSORS)],
    }
    monkeypatch.setattr(metadata, "entry_points", lambda group: points[group])


def test_the_page_keeps_its_promise_of_60_lines() -> None:
    assert CODE is not None and len(CODE[1].splitlines()) <= 62
    assert 'udp_text = "lab_devices:open_tracker"' in PAGE and 'udp_text = "lab_devices:open_force_sensor"' in PAGE


@pytest.mark.usefixtures("lab_devices")
def test_the_tracker_of_the_page_gives_poses() -> None:
    port, samples, events = free_udp_port(), [], []
    thread = tracker_thread(rig_with("tracker", kind="udp_text", port=str(port)), None, samples.append, events.append)
    thread.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def sent() -> bool:
            for line in ("0A 0.01 0.02 0.03 1 0 0 0", "0A nan 0 0 1 0 0 0", "0A 1 2", "0A 0 0 0 1 1 0 0", ""):
                sender.sendto(line.encode(), ("127.0.0.1", port))
            return len(samples) > 2

        assert until(sent)
    thread.stop()
    assert {sample.tool for sample in samples} == {"0A"} and events[0].kind is DeviceEventKind.TRACKING
    np.testing.assert_allclose(samples[0].position_m, (0.01, 0.02, 0.03))
    assert all(sample.arrival_ns - sample.stamp_ns == 25_000_000 for sample in samples)  # tracker.latency_s


@pytest.mark.usefixtures("lab_devices")
def test_the_force_sensor_of_the_page_gives_forces() -> None:
    port, samples = free_udp_port(), []
    rig = rig_with("force_sensor", kind="udp_text", options={"port": port})
    thread = force_thread(rig, callback=samples.append)
    thread.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def sent() -> bool:
            sender.sendto(b"f 0.1 0.2 0.3 0 0 0", ("127.0.0.1", port))
            return bool(samples)

        assert until(sent)
    thread.stop()
    np.testing.assert_allclose(samples[0].force_N, (0.1, 0.2, 0.3))


def test_a_plug_in_that_does_not_load_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [metadata.EntryPoint("broken", "no_such_module:open", TRACKERS)]
    monkeypatch.setattr(metadata, "entry_points", lambda group: broken)
    with pytest.raises(InputError, match=r"tracker\.kind: found broken, which does not load"):
        tracker_thread(rig_with("tracker", kind="broken"), None, print)


def test_the_nano17_on_a_card_is_chosen_in_the_rig_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = read_rig_data(SIMULATED_RIG)
    data["force_sensor"] |= {"kind": "nano17", "address": "Dev1", "options": {"calibration": str(tmp_path / "FT1.cal")}}
    for key in ("counts_per_newton", "counts_per_newton_metre"):  # those of a box
        del data["force_sensor"][key]
    sensor = parse_rig(data).force_sensor
    with pytest.raises(InputError, match=r"options.calibration: found .*FT1.cal: No such file"):
        open_force_sensor(sensor)
    axes = "".join(
        f'<UserAxis Name="{name}" values="{" ".join("1" if i == j else "0" for i in range(6))}" max="10" scale="1"/>'
        for j, name in enumerate(("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"))
    )
    (tmp_path / "FT1.cal").write_text(
        f'<FTSensor><Calibration ForceUnits="N" TorqueUnits="N-m">{axes}</Calibration></FTSensor>'
    )

    class Card:
        def __init__(self, device: str, rate_hz: float) -> None:
            assert (device, rate_hz) == ("Dev1", 1000.0)

        def read(self) -> tuple[np.ndarray, float]:
            return np.array([[0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]]), 1000.0

        def close(self) -> None:
            pass

    monkeypatch.setattr("realtime.drivers.nano17_daq.NidaqmxReader", Card)
    source = open_force_sensor(sensor)
    assert isinstance(source, Nano17Source)
    np.testing.assert_allclose(source.read()[0].force_N, (0.0, 0.0, 0.5))


def test_a_box_without_its_counts_is_refused() -> None:
    data = read_rig_data(SIMULATED_RIG)
    del data["force_sensor"]["counts_per_newton"]
    with pytest.raises(InputError, match=r"force_sensor\.counts_per_newton"):
        parse_rig(data)


@pytest.mark.usefixtures("lab_devices")
@pytest.mark.parametrize(
    ("section", "changes", "says"),
    [
        ("tracker", {"port": "abc"}, "udp_text: open failed with ValueError: invalid literal for int()"),
        ("force_sensor", {"options": {}}, "udp_text: open failed with KeyError: 'port'"),
    ],
)
def test_a_fault_of_a_plug_in_is_one_line_of_the_device_check(
    section: str, changes: dict[str, object], says: str, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = rig_with(section, kind="udp_text", **changes)
    report = check_tracker(rig, "", 1.0) if section == "tracker" else check_force_box(rig, "", 1.0, 1, 1)
    assert len(report.problems) == 1 and report.problems[0].startswith(says), report.problems
    assert "check its section of the rig file" in report.problems[0] and "Traceback" not in capfd.readouterr().err


def test_a_driver_that_fails_while_it_reads_is_opened_again() -> None:
    class Failing:
        """A source whose second reading divides by zero."""

        count = 0

        def read(self) -> list[int]:
            self.count += 1
            return [1 // (self.count % 2)]

        def close(self) -> None:
            closed.append(True)

    samples: list[int] = []
    events: list[DeviceEvent] = []
    closed: list[bool] = []
    thread: SourceThread[int] = SourceThread("mine", Failing, samples.append, events.append)
    thread.start()
    assert until(lambda: len(samples) > 1)
    thread.stop()
    assert thread.error is None and closed
    assert any("mine: read failed with ZeroDivisionError" in event.text for event in events)


def pose(**changes: Any) -> PoseSample:
    good = PoseSample("0A", 1, 1, 2, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 0.0, False)
    return replace(good, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"position_m": np.array([0.0, np.nan, 0.0])},
        {"position_m": np.array([0.0, 0.0, 4.0])},
        {"quaternion_wxyz": np.array([1.0, 1.0, 0.0, 0.0])},
        {"quaternion_wxyz": np.full(4, np.nan)},
    ],
)
def test_what_is_no_pose_counts_as_missing(changes: dict[str, Any]) -> None:
    """A plug-in's NaN was called a good pose by `check-device`."""
    seen = checked_pose(pose(**changes))
    assert seen.missing and PoseFlag.NOT_A_POSE in seen.flags and np.isnan(seen.position_m).all()
    assert checked_pose(pose()) is not None and not checked_pose(pose()).missing


def force(newton: Any) -> ForceSample:
    return ForceSample(1, 1, newton, np.zeros(3), 1, 0, 0)


def test_a_force_that_is_not_finite_is_dropped() -> None:
    assert checked_force(force(np.array([0.0, np.inf, 0.0]))) is None and checked_force(force(np.zeros(3))) is not None


class Giving:
    """A source that returns the same each time."""

    def __init__(self, given: Any) -> None:
        self._given = given

    def read(self) -> Any:
        time.sleep(0.01)
        if isinstance(self._given, BaseException):
            raise self._given
        return self._given

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (None, "mine: read failed with TypeError: read returned NoneType, wanted a list of samples"),
        ([3.0], "mine: read failed with TypeError: found float in what read returned, wanted ForceSample"),
        ([force(np.zeros(2))], "found float64 of shape (2,) as ForceSample.force_N, wanted 3 floating-point numbers"),
        ([force([0, 0, 0])], "found int64 of shape (3,) as ForceSample.force_N"),
        ([force(np.full(3, np.nan))], "mine: only samples that are not finite for 1 s"),
        ([], "mine: no sample for 1 s"),
        (OSError(5, "Input/output error"), "mine: Input/output error"),
        (SystemExit(3), "mine: read failed with SystemExit: 3"),
    ],
)
def test_what_is_no_sample_is_one_line_and_the_driver_is_opened_again(
    given: Any, says: str, capfd: pytest.CaptureFixture[str]
) -> None:
    events: list[DeviceEvent] = []
    thread: SourceThread[ForceSample] = SourceThread(
        "mine", lambda: Giving(given), lambda sample: pytest.fail("was passed on"), events.append, checked=checked_force
    )
    thread.start()
    assert until(lambda: thread.failures > 1)
    thread.stop()
    assert len(events) == 1 and says in events[0].text and "\n" not in events[0].text, events
    assert thread.error is None and "Traceback" not in capfd.readouterr().err
