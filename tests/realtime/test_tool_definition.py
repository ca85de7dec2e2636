"""Tools without a memory of their own: their definition files, checked before anything is opened, written at every plug."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, parse_rig, read_rig_data
from realtime.core.device_sources import check_kinds
from realtime.core.lines import tracker_config
from realtime.drivers.aurora_session import AuroraConfig
from realtime.drivers.check_device import check_aurora
from realtime.drivers.device_events import DeviceEventKind
from realtime.drivers.tool_definition import read_definition
from realtime.drivers.transport import TracedTransport, open_serial
from sim.aurora_commands import AuroraAnswer, AuroraFrame
from sim.aurora_emulator import AuroraEmulator, AuroraEmulatorConfig
from sim.net_ft_emulator import NetFtEmulator, NetFtEmulatorConfig
from sim.sensor_servers import AuroraPty, NetFtUdp, SensorServers
from tests.realtime.test_aurora import Bench

CONTENT = b"NDI" + bytes(range(1, 251)) * 3


def rig_of(tracker: dict[str, str]) -> Rig:
    data = read_rig_data(SIMULATED_RIG)
    data["tracker"] |= tracker
    return parse_rig(data)


def bench_of(definition: bytes) -> Bench:
    bench = Bench(AuroraConfig(definitions={"0B": definition} if definition else {}))
    bench.emulator.ports["0B"].blank = True
    return bench


def test_a_definition_reaches_the_tool_byte_for_byte_and_again_after_a_plug(tmp_path: Path) -> None:
    path = tmp_path / "shaft.rom"
    path.write_bytes(CONTENT)
    definitions = tracker_config(rig_of({"shaft_definition": str(path)})).definitions
    bench = bench_of(definitions["0B"])
    assert {sample.tool for sample in bench.run(3.0)} == {"0A", "0B"}
    assert bench.emulator.ports["0B"].memory == CONTENT + bytes(2048 - len(CONTENT))
    assert not any(bench.emulator.ports["0A"].memory)
    bench.emulator.unplug("0B")
    assert {sample.tool for sample in bench.run(2.0)[10:]} == {"0A"}
    bench.emulator.plug("0B")
    assert {sample.tool for sample in bench.run(2.0)[10:]} == {"0A", "0B"}
    errors = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.ERROR]
    assert errors == ["wanted tools not plugged in: 0B"]


def test_without_its_definition_the_tool_is_named_with_the_remedy() -> None:
    bench = bench_of(b"")
    assert {sample.tool for sample in bench.run(3.0)} == {"0A"}
    errors = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.ERROR]
    assert errors[0].startswith("PINIT 0B: error 1D") and "tracker.tip_definition" in errors[0]


def test_a_page_that_the_device_refuses_leaves_the_other_tool() -> None:
    bench = bench_of(bytes(4096))
    assert {sample.tool for sample in bench.run(4.0)} == {"0A"}
    errors = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.ERROR]
    assert errors[0] == "PVWR 0B0800...: error 23: parameter out of range"


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (None, "No such file"),
        (b"", "an empty file"),
        (bytes(1025), "more than 1024 bytes"),
        (b"\x89PNG", "89 50 4e.*begin with NDI"),
    ],
)
def test_a_file_that_is_no_definition_is_refused_before_anything_is_opened(
    tmp_path: Path, content: bytes | None, found: str
) -> None:
    path = tmp_path / "tip.rom"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"tracker\.tip_definition: found .*{found}"):
        check_kinds(rig_of({"tip_definition": str(path)}))


def test_what_is_not_a_file_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(InputError, match=r"tracker\.tip_definition: found .*(not a file|Is a directory)"):
            read_definition("tracker.tip_definition", str(path))


def test_an_error_in_the_middle_ends_the_writing_before_the_tool_is_initialised() -> None:
    bench = bench_of(CONTENT.ljust(768, b"\x00"))
    execute, sent = bench.emulator._console.execute, list[str]()

    def refused(line: bytes, frame: AuroraFrame | None) -> AuroraAnswer:
        sent.append(line.decode("ascii")[:11])
        return AuroraAnswer("ERROR1F") if line.startswith(b"PVWR:0B0080") else execute(line, frame)

    bench.emulator._console.execute = refused  # type: ignore[method-assign]
    assert {sample.tool for sample in bench.run(4.0)} == {"0A"}
    assert [line for line in sent if line.startswith("PVWR")] == ["PVWR:0B0000", "PVWR:0B0040", "PVWR:0B0080"]
    assert not [line for line in sent if line.startswith("PINIT:0B")] and bench.client.written == {}
    errors = [event.text for event in bench.client.take_events() if event.kind is DeviceEventKind.ERROR]
    assert errors[0] == "PVWR 0B0080...: error 1F: SROM of the tool could not be written"


def test_check_device_reports_the_definition_and_the_trace_has_it(tmp_path: Path) -> None:
    emulator = AuroraEmulator(AuroraEmulatorConfig(start_ns=time.monotonic_ns(), init_s=0.05, reset_s=0.1), 1)
    emulator.ports["0B"].blank = True
    pty = AuroraPty(emulator, tmp_path / "aurora")
    pose = (np.array([0.01, -0.02, -0.15]), np.array([1.0, 0.0, 0.0, 0.0]))
    box = NetFtUdp(NetFtEmulator(NetFtEmulatorConfig(start_ns=time.monotonic_ns()), 2))
    servers = SensorServers(pty, lambda time_ns: [pose, pose], box, lambda time_ns: (np.zeros(3), np.zeros(3)))
    servers.start()
    try:
        with (tmp_path / "trace.txt").open("w", encoding="ascii") as out:
            config = AuroraConfig(definitions={"0B": CONTENT.ljust(768, b"\x00")}, poll_timeout_s=2.0)
            report = check_aurora(lambda: TracedTransport(open_serial(pty.path, 9600), out), config, 0.5)
    finally:
        servers.stop()
        pty.close()
        box.close()
    figures = report.figures
    assert figures["0B.definition_bytes"] == 768 and "0A.definition_bytes" not in figures
    assert (figures["0A.serial"], figures["0B.serial"]) == ("34801000", "34801001")
    pages = [line for line in (tmp_path / "trace.txt").read_text(encoding="ascii").splitlines() if "PVWR:0B" in line]
    assert len(pages) >= 12 and all(" > " in line for line in pages)


def test_a_definition_is_for_an_aurora() -> None:
    with pytest.raises(InputError, match="tip_definition"):
        rig_of({"kind": "openigtlink", "port": "127.0.0.1:18944", "tip_definition": "tip.rom"})
