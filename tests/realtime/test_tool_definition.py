"""Tools without a memory of their own: their definition files, checked before anything is opened, written at every plug."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, parse_rig, read_rig_data
from realtime.core.device_sources import check_kinds
from realtime.core.lines import tracker_config
from realtime.drivers.aurora_session import AuroraConfig
from realtime.drivers.device_events import DeviceEventKind
from tests.realtime.test_aurora import Bench

CONTENT = bytes(range(1, 251)) * 3


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
    [(None, "No such file"), (b"", "an empty file"), (bytes(1025), "more than 1024 bytes")],
)
def test_a_file_that_is_no_definition_is_refused_before_anything_is_opened(
    tmp_path: Path, content: bytes | None, found: str
) -> None:
    path = tmp_path / "tip.rom"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"tracker\.tip_definition: found .*tip\.rom.*{found}"):
        check_kinds(rig_of({"tip_definition": str(path)}))


def test_a_definition_is_for_an_aurora() -> None:
    with pytest.raises(InputError, match="tip_definition"):
        rig_of({"kind": "openigtlink", "port": "127.0.0.1:18944", "tip_definition": "tip.rom"})
