"""`check-device` against the simulated rig's own ports, and `flash` up to the moment it would write."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from host.cli.check_device import check_device
from host.cli.flash import flash
from host.commissioning import device_check
from host.commissioning import firmware_flash as flash_module
from host.commissioning.board_inputs import input_lines, input_problems
from host.commissioning.firmware_flash import avrdude_command, built
from host.commissioning.wiring_drawing import drawings
from protocol.board_pins import definitions
from protocol.errors import InputError
from protocol.rig_file import Pins, load_rig, parse_rig, problems_of, read_rig_data
from protocol.serial_frames import InputBit
from realtime.drivers.check_device import DeviceReport
from sim.board import BUILD_DIR
from tests.realtime.conftest import RIG_FILE
from tests.waiting import PATIENCE_S, until

# What a busy machine makes of a stream is not what is tested here.
MACHINE = ("a second", "damaged", "lost", "status frames", "records", "missing in")


@pytest.fixture(scope="module")
def ports() -> Iterator[dict[str, Any]]:
    """Ports of a simulated rig in a process of its own."""
    server = subprocess.Popen(
        [sys.executable, "-m", "sim.rig_server", "--rig", str(RIG_FILE), "--board", "native"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    yield json.loads(server.stdout.readline())
    server.terminate()
    server.communicate(timeout=PATIENCE_S)


def told(*arguments: str) -> tuple[int, Any]:
    app = typer.Typer()
    app.command()(check_device)
    result = CliRunner().invoke(app, [*arguments, "--json", "--seconds", "1"])
    return result.exit_code, json.loads(result.stdout)


def told_of_a_good_one(*arguments: str) -> Any:
    """The report on a device that is there; asked again while the machine is too busy to read it at all."""
    reports: list[Any] = [{}]
    until(lambda: reports.append(told(*arguments)[1]) or real_problems(reports[-1]) == [], f"a good report: {reports[-1]}")
    return reports[-1]


def real_problems(report: Any) -> list[str]:
    return [problem for problem in report["problems"] if not any(words in problem for words in MACHINE)]


def test_the_simulated_board_is_brought_up_and_read(ports: dict[str, Any]) -> None:
    report = told_of_a_good_one("board", "--port", ports["board"])
    assert report["figures"]["timer_hz"] == 20000 and report["figures"]["status_hz"] > 0


def test_every_input_of_the_board_is_named_with_what_it_means(ports: dict[str, Any]) -> None:
    figures = told_of_a_good_one("board", "--port", ports["board"])["figures"]
    assert figures["limit insertion min"] == "D49: not hit (contact closed); at rest: not hit (contact closed)"
    assert figures["estop"].startswith("D43: ") and len([name for name in figures if name.startswith("limit ")]) == 6


def test_inputs_are_read_by_the_polarity_in_the_rig_file() -> None:
    usual = Pins.model_validate({})
    assert input_problems(usual, 0) == [] and input_problems(usual, 1 << InputBit.LIMIT_1_MIN) == []
    (problem,) = input_problems(usual, 1 << InputBit.ESTOP)
    assert problem == "the emergency stop (D43) is open: pressed, or its wire is broken"
    (problem,) = input_problems(usual, 0b1100)
    assert problem.startswith("both ends of roll (D47 and D46) are hit") and "connect D47 and D46 to GND" in problem
    mixed = Pins.model_validate({"normally_open": ["estop", "knob_max"]})
    (estop,) = (line for line in input_lines(mixed, 1 << InputBit.ESTOP) if line.name == "estop")
    assert str(estop) == "D43: HIT (contact closed); at rest: not hit (contact open)"
    uno = Pins.model_validate({"mcu": "atmega328p"})
    assert [line.name for line in input_lines(uno, 0)] == ["limits insertion", "limits roll", "limits knob", "estop"]
    assert [line.hit for line in input_lines(uno, 0b100)] == [False, True, False, False]


@pytest.mark.parametrize("name", drawings())
def test_the_drawings_in_the_documents_are_those_of_the_pin_table(name: str) -> None:
    drawn = Path(__file__).parents[2] / "docs" / "pictures" / name
    wanted = "the output of `python -m host.commissioning.wiring_drawing`"
    assert drawn.read_text(encoding="utf-8") == drawings()[name], f"{name}: wanted {wanted}"


def test_the_simulated_tracker_is_brought_up_and_read(ports: dict[str, Any]) -> None:
    report = told_of_a_good_one("tracker", "--port", ports["tracker"])
    assert "0A.noise_m" in report["figures"]


def test_the_simulated_force_box_is_read(ports: dict[str, Any]) -> None:
    where = ["--udp-port", str(ports["force_port"]), "--web-port", str(ports["page_port"])]
    report = told_of_a_good_one("force", "--port", "127.0.0.1", *where)
    assert 0.001 < report["figures"]["noise_z_N"] < 0.01


def test_a_device_that_is_not_there_is_said_so() -> None:
    status, report = told("board", "--port", "/dev/nothing-here")
    assert status == 1 and not report["good"] and "/dev/nothing-here" in report["problems"][0]


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="tracker or force or board"):
        check_device("toaster")


def test_flash_refuses_what_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="atmega2560 or atmega328p"):
        flash(port="/dev/ttyACM0", mcu="z80")
    monkeypatch.setattr(flash_module.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="apt install avrdude"):
        flash(port="/dev/ttyACM0")
    monkeypatch.setattr(flash_module.shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(InputError, match="a serial port that exists"):
        flash(port="/dev/nothing-here")
    with pytest.raises(InputError, match="an ELF file"):
        flash(port="/dev/null", image=Path("/no/such.elf"))


def pins(**changed: object) -> dict[str, Any]:
    """The simulated rig's file with other pins."""
    data = read_rig_data(RIG_FILE)
    data["board"]["pins"] = data["board"]["pins"] | changed
    return data


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"encoders": "A"}, "board.pins.encoders: found port 'A', which has the outputs, wanted a port of its own"),
        ({"switches": "Z"}, "board.pins.switches: found port 'Z', wanted one of A, B, C, F, K, L of the atmega2560"),
        ({"output_shift": 2}, "board.pins.outputs: found pin PA8, which the atmega2560 has not free"),
        ({"mcu": "atmega328p", "outputs": "D", "switches": "B", "output_shift": 1}, "found pin PD1, which the atmega328p"),
        ({"normally_open": ["knob"]}, "board.pins.normally_open: found 'knob', wanted names of insertion_min"),
        (
            {"mcu": "atmega328p", "outputs": "D", "output_shift": 2, "switches": "B", "normally_open": ["roll_max"]},
            "found roll_max without roll_min, wanted both or neither: on the Arduino Uno or Nano they share one input",
        ),
        ({"enable_active": "up"}, "board.pins.enable_active: found 'up', wanted"),
        ({"output_shift": 8}, "board.pins.output_shift: found 8, wanted at most 7"),
    ],
)
def test_pins_that_conflict_or_are_not_there_are_refused_in_one_line(changed: dict[str, object], says: str) -> None:
    (problem,) = problems_of(pins(**changed))
    assert says in problem


def test_without_pins_in_the_file_the_usual_ones_of_its_processor_are_taken() -> None:
    data = read_rig_data(RIG_FILE)
    del data["board"]["pins"]
    assert parse_rig(data) == load_rig(RIG_FILE)
    data["board"]["pins"] = {"mcu": "atmega328p"}
    assert definitions(**parse_rig(data).board.pins.model_dump()) == [
        "-DATMEGA328P_OUTPUTS=D",
        "-DATMEGA328P_OUTPUT_SHIFT=2",
        "-DATMEGA328P_ENCODERS=C",
        "-DATMEGA328P_SWITCHES=B",
        "-DBOARD_ENABLE_ACTIVE_LOW=1",
        "-DBOARD_NORMALLY_OPEN=0",
        "-DBOARD_KEEP_ENABLED=0",
    ]


@pytest.mark.avr
@pytest.mark.usefixtures("avr_tools")
@pytest.mark.parametrize(("outputs", "register"), [("A", "out\t0x02, "), ("K", "sts\t0x0108, ")])
def test_flash_builds_with_the_rigs_pins(outputs: str, register: str) -> None:
    elf = built(parse_rig(pins(outputs=outputs)).board.pins)
    code = subprocess.run(["avr-objdump", "-d", str(elf)], capture_output=True, text=True, check=True).stdout
    assert [line for line in code.splitlines() if register in line], "the port's register is written"
    assert (outputs == "A") == (elf.parent == BUILD_DIR)


def test_the_call_of_avrdude_names_part_loader_and_file() -> None:
    command = avrdude_command("atmega328p", "/dev/ttyUSB0", Path("f.elf"))
    assert command[:3] == ["avrdude", "-p", "m328p"] and command[-1] == "flash:w:f.elf:e"
    assert "57600" in avrdude_command("atmega328p", "/dev/ttyUSB0", Path("f.elf"), 57600)


def test_counts_of_the_rig_file_that_are_not_those_of_the_box_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    data = read_rig_data(RIG_FILE)
    data["force_sensor"]["counts_per_newton"] = 1000.0  # the box has 1e6: every force would be 1000 times too large
    of_box: dict[str, Any] = {"counts_per_N": 1e6, "counts_per_Nm": 1e9}

    def box(*_: Any) -> DeviceReport:
        return DeviceReport("net_ft", dict(of_box))

    monkeypatch.setattr(device_check, "check_net_ft", box)
    report = device_check.check_force_box(parse_rig(data), "", 1.0, 1, 1)
    assert not report.good and len(report.problems) == 1
    assert "force_sensor.counts_per_newton: found 1000, wanted 1e+06" in report.problems[0]
    assert "forces are read 1000 times as large" in report.problems[0]
    assert device_check.check_force_box(load_rig(RIG_FILE), "", 1.0, 1, 1).good


def test_a_port_of_the_simulated_rig_is_named_as_such() -> None:
    report = device_check.check_board(load_rig(RIG_FILE), "", 0.1)
    assert len(report.problems) == 1 and "pty: stands for a port of the simulated rig" in report.problems[0]
    absent = device_check.check_board(load_rig(RIG_FILE), "/dev/ttyACM99", 0.1)
    assert "found /dev/ttyACM99 that does not open (No such file or directory), wanted a free device" in absent.problems[0]
    file = device_check.check_board(load_rig(RIG_FILE), str(RIG_FILE), 0.1)
    assert file.problems[0].endswith("that does not open (it is not a serial port), wanted a free device")


@pytest.mark.parametrize(("device", "sent"), [("tracker", b"TSTART"), ("board", b"")])
def test_the_dialogue_on_the_line_is_written_byte_by_byte(
    ports: dict[str, Any], device: str, sent: bytes, tmp_path: Path
) -> None:
    trace = tmp_path / "trace.txt"
    told_of_a_good_one(device, "--port", ports[device], "--trace", str(trace))
    lines = [line.split(maxsplit=2) for line in trace.read_text(encoding="ascii").splitlines()]
    assert {direction for _, direction, _ in lines} == {"<", ">"}
    times = [float(seconds) for seconds, _, _ in lines]
    assert times == sorted(times)
    said = [bytes.fromhex(what.partition("  ")[0]) for _, direction, what in lines if direction == ">"]
    assert all(said) and any(sent in data for data in said)


def test_a_trace_needs_a_serial_line_and_a_file_that_can_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--trace"):
        check_device("force", trace=tmp_path / "trace.txt")
    with pytest.raises(InputError, match="can be written"):
        check_device("board", trace=tmp_path / "nowhere" / "trace.txt")
