"""`seldinger home` on the native board in virtual time: it finds the switch; without one or a yes nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

import host.commissioning.home_stage as homing
from host.cli.drive import Driver
from host.cli.home import _home_running, home
from host.run.commander import Commander
from host.run.connection import CommandRefused, RigConnection
from protocol.errors import InputError
from protocol.rig_file import load_rig
from tests.host.test_view_live import loopback
from tests.host.virtual_rig import VirtualRig
from tests.realtime.conftest import RIG_FILE
from tests.sim.board_rig import BoardRig
from tests.sim.test_home_run import rig_with_a_switch
from tests.waiting import PATIENCE_S, until

SWITCH_STEPS = -120


class Port:
    """The board's port and this computer's clock: to sleep a millisecond is to let the board run for one."""

    def __init__(self) -> None:
        self.rig = BoardRig("native")
        self._in, self._out = bytearray(), b""

    def read(self) -> bytes:
        data, self._in = bytes(self._in), bytearray()
        return data

    def write(self, data: bytes) -> None:
        self._out += data

    def close(self) -> None:
        """Nothing to close."""

    def monotonic_ns(self) -> int:
        return self.rig.now_ns

    def sleep(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.rig.inputs = {"limit_bits": int(self.rig.position[0] <= SWITCH_STEPS)}
            self._in += self.rig.slice(self._out).uart_out
            self._out = b""


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[Port]:
    made = Port()
    monkeypatch.setattr(homing, "time", made)
    monkeypatch.setattr(homing, "open_serial", lambda path, baud: made)
    yield made
    made.rig.close()


def homed(*arguments: str, answer: str = "") -> Result:
    app = typer.Typer()
    app.command()(home)
    return CliRunner().invoke(app, ["insertion", *arguments], input=answer)


def file_with_a_switch(folder: Path) -> Path:
    text = RIG_FILE.read_text(encoding="utf-8")
    for key, value in (("home_end", '"min"'), ("home_unit", "-0.05"), ("home_speed_unit_per_s", "0.002")):
        old = next(line for line in text.splitlines() if line.startswith(f"{key} "))
        text = text.replace(old, f"{key} = {value}", 1)
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_it_finds_the_switch_and_says_so(port: Port, tmp_path: Path) -> None:
    file = file_with_a_switch(tmp_path)
    told = homed("--rig", str(file), "--yes", "--json")
    assert told.exit_code == 0, told.output
    assert "switch found, its position is -0.05 m" in told.stderr and '"axis": "insertion"' in told.stdout
    at_steps = round(load_rig(file).stages.insertion.home_unit * 320_000)
    assert abs(int(port.rig.position[0]) - int(port.rig.status.position_steps[0]) - (SWITCH_STEPS - at_steps)) <= 2
    assert port.rig.position[0] > SWITCH_STEPS and port.rig.position[1:].tolist() == [0, 0]


def test_without_a_switch_or_without_a_yes_nothing_moves(port: Port, tmp_path: Path) -> None:
    none = homed("--rig", str(RIG_FILE), "--yes")
    assert none.exit_code != 0 and "stages.insertion.home_end" in str(none.exception)
    no = homed("--rig", str(file_with_a_switch(tmp_path)), answer="n\n")
    assert no.exit_code == 1 and not port.rig.position.any()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("elbow",), "axis"),
        (("insertion", "--name", "BAD!"), "commander"),
        (("insertion", "--port", "x", "--endpoint", "tls/1.2.3.4:5"), "--port"),
        (("insertion", "--endpoint", "tls/1.2.3.4:5"), "keys"),
    ],
)
def test_bad_input_is_named_and_nothing_moves(port: Port, words: tuple[str, ...], key: str, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(home)
    told = CliRunner().invoke(app, [*words, "--yes", "--rig", str(file_with_a_switch(tmp_path))])
    assert isinstance(told.exception, InputError) and key in str(told.exception) and not port.rig.position.any()


@pytest.mark.slow
def test_a_rig_that_runs_homes_itself_and_its_log_says_how_it_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = rig_with_a_switch(tmp_path)
    there, here = loopback(rig)
    with there, VirtualRig(rig, there) as virtual, RigConnection(rig, here, "console") as connection:
        connection._commander = Commander(here, "console", clock_ns=lambda: virtual.now_ns)
        driver = Driver(connection, "home", json=False)
        assert driver.wait(PATIENCE_S, lambda state: state.mode == "disarmed")
        until(lambda: connection._commander.take().accepted, "the lease")

        def homed() -> bool:
            """A late answer of a busy machine is asked for again; a homing that goes on is left to end first."""
            driver.wait(PATIENCE_S, lambda state: state.mode == "disarmed")
            try:
                _home_running(driver, "insertion")
            except CommandRefused as refused:
                assert refused.acknowledgement.result != "refused", refused
                return False
            return True

        until(homed, "the axis to be homed")
    assert driver.result["done"] and "two touches differ by" in driver.result["text"]
    assert "insertion: switch found, its position is -0.002 m" in capsys.readouterr().err
