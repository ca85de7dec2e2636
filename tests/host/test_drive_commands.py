"""`seldinger arm`, `jog`, `goto`, `touch` ... as they are called, on a simulated rig in lock step; and what they refuse."""

from __future__ import annotations

import contextlib
import json
import math
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import host.cli.drive as drive
import host.run.connection as connection
import host.run.rig_status as rig_status
from host.cli.main import build
from host.cli.quantities import direction, point, quantity
from host.run.rig_status import RigStatus
from protocol.commander import CommandSender
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import Command, Message, Reply, RigState
from sim.board import SimulatedBoard
from sim.scenario import Scenario
from sim.world import World, simulated_plant


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("2mm", "m", 0.002),
        ("-0.002", "m", -0.002),
        ("+1e-3 m", "m", 0.001),
        ("5deg", "rad", math.radians(5)),
        ("150mN", "N", 0.15),
        ("20g", "N", 0.196133),
        ("2min", "s", 120.0),
    ],
)
def test_a_quantity_is_read_in_its_unit(text: str, unit: str, value: float) -> None:
    assert quantity("key", text, unit) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "mm", "two", "1,5mm", "nan", "inf", "1e999", "0x2", "2 apples", "5deg", "2mm2"])
def test_what_is_no_length_is_refused_and_named(text: str) -> None:
    with pytest.raises(InputError, match=r"^travel: found .*, wanted a number in m"):
        quantity("travel", text, "m")


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "1;2;3", "1 2", "1 2 3 4", "1mm2mm3mm", "a b c"])
def test_what_is_no_point_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^place: "):
        point("place", text.split(" "))


@pytest.mark.parametrize(
    "text", ["0,-10.7mm,0.02", "0 -10.7mm 0.02", "0, -10.7 mm, 20mm", "0 -10.7 mm 20 mm", "-0 -1.07cm +.02"]
)
def test_a_point_may_have_spaces_instead_of_commas(text: str) -> None:
    """As the shell gives it: one word for each space."""
    assert point("place", text.split(" ")) == pytest.approx((0.0, -0.0107, 0.02))


@pytest.mark.parametrize("text", ["", "0,0,0", "1,2", "nan,0,1", "inf,0,0", "x,y,z"])
def test_what_is_no_direction_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^--normal: "):
        direction("--normal", text)
    assert direction("--normal", "0,0,2") == (0.0, 0.0, 1.0)


def called(*words: str) -> Result:
    return CliRunner().invoke(build(list(words)), list(words))


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("goto", "0,0"), "place"),
        (("goto", "-1,b,0"), "place"),
        (("goto", "0", "-10mm", "20mm", "30mm"), "place"),
        (("jog", "e3", "1mm", "2mm"), "travel"),
        (("jog", "e3", "1", "apple"), "travel"),
        (("force", "1", "2"), "newton"),
        (("jog", "elbow", "2mm"), "axis"),
        (("jog", "knob", "2mm"), "travel"),
        (("jog", "insertion", "-5deg"), "travel"),
        (("jog", "0,0,0", "2mm"), "axis"),
        (("jog", "e1", "1mm", "--speed", "fast"), "--speed"),
        (("touch", "0,0,25mm", "--normal", "up"), "--normal"),
        (("touch", "0,0,25mm", "--force", "2mm"), "--force"),
        (("touch", "0,0,25mm", "--for", "long"), "--for"),
        (("force", "-"), "newton"),
        (("mark", "  "), "note"),
        (("arm", "--rig", "nowhere.toml"), "nowhere.toml"),
        (("status", "--endpoint", "tls/1.2.3.4:5"), "keys"),
    ],
)
def test_bad_input_is_named_before_anything_is_sent(
    words: tuple[str, ...], key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*arguments: object) -> None:
        raise AssertionError("a session was opened")

    monkeypatch.setattr(connection, "Session", forbidden)
    error = called(*words).exception
    assert isinstance(error, InputError) and key in str(error) and "\n" not in str(error)


class VirtualRig:
    """A simulated rig in lock step that passes for zenoh session, clock and `time` of the commands."""

    def __init__(self, board: SimulatedBoard) -> None:
        rig = load_rig(SIMULATED_RIG)
        self.newest: dict[str, Message] = {}
        self.scenario = Scenario(rig, World(rig, simulated_plant(rig, 1), board, 1), self._keep)
        assert self.scenario.run(10.0, self.scenario.ready)

    def _keep(self, topic: str, message: Message) -> None:
        self.newest[topic] = message

    # `time`
    def monotonic(self) -> float:
        return self.scenario.now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        self.scenario.run(seconds)

    # the session
    def ask(self, command: Command, timeout_s: float = 1.0) -> Reply | None:
        return self.scenario.ask(command)

    def latest(self, topic: str) -> Any:
        rig = self

        class Latest:
            def take(self) -> Message | None:
                return rig.newest.pop(topic, None)

        return Latest()

    def close(self) -> None:
        """Close nothing: the simulated rig is that of the whole scenario, and later commands use it."""

    def __enter__(self) -> VirtualRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@pytest.fixture(scope="module")
def virtual() -> Iterator[VirtualRig]:
    with SimulatedBoard("native") as board:
        yield VirtualRig(board)


class VirtualCommander(CommandSender):
    """A commander on the rig's clock, which needs no thread."""

    lost = ""

    def __init__(self, session: Any, name: str) -> None:
        super().__init__(session, name, clock_ns=lambda: int(session.scenario.now_ns))

    def close(self) -> None:
        self.release()


@pytest.fixture
def rig(virtual: VirtualRig, monkeypatch: pytest.MonkeyPatch) -> VirtualRig:
    monkeypatch.setattr(connection, "open_session", lambda *arguments: virtual)
    monkeypatch.setattr(connection, "Commander", VirtualCommander)
    monkeypatch.setattr(drive, "time", virtual)
    monkeypatch.setattr(rig_status, "time", virtual)
    return virtual


EVERY_DRIVE_COMMAND = [
    ("status",),
    ("arm",),
    ("disarm",),
    ("jog", "e3", "1mm"),
    ("goto", "0", "-10mm", "20mm"),
    ("touch", "0,-10.7mm,25mm"),
    ("force", "150 mN"),
    ("hold",),
    ("retract",),
    ("zero",),
    ("mark", "a note"),
    ("clear",),
]


@pytest.mark.parametrize("words", EVERY_DRIVE_COMMAND, ids=lambda words: words[0])
def test_a_rig_that_does_not_run_is_not_waited_for(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rig of this computer without a socket: nothing is sent, and the line says what to look at."""
    file = tmp_path / "rig.toml"
    file.write_text(SIMULATED_RIG.read_text().replace('folder = ""', f'folder = "{tmp_path}"'), encoding="utf-8")
    assert not connection.may_run(load_rig(file))
    monkeypatch.setattr(CommandSender, "give", lambda *arguments, **fields: pytest.fail("a command was sent"))
    result = called(*words, "--rig", str(file))
    error = result.exception
    assert isinstance(error, InputError) and "nothing was commanded" in str(error) and str(tmp_path) in str(error)
    assert not result.stderr and "\n" not in str(error)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "zenoh.sock"))
        listening.listen()
        assert connection.may_run(load_rig(file)), "a rig that may run is given its time"
    assert (tmp_path / "zenoh.sock").exists() and not connection.may_run(load_rig(file)), "left by a killed process"


@pytest.mark.parametrize(
    ("sockets", "says"),
    [
        (["stop.sock"], "without its model process, through which commands go, wanted both; nothing"),
        (["zenoh.sock"], "without its realtime process, wanted both; nothing"),
        (["stop.sock", "zenoh.sock"], "though its processes are there, wanted a rig that runs"),
        ([], "no message from rig simulated at"),
    ],
)
def test_the_process_that_is_missing_is_named(sockets: list[str], says: str, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(SIMULATED_RIG.read_text().replace('folder = ""', f'folder = "{tmp_path}"'), encoding="utf-8")
    with contextlib.ExitStack() as stack:
        for name in sockets:
            listening = stack.enter_context(socket.socket(socket.AF_UNIX))
            listening.bind(str(tmp_path / name))
            listening.listen()
        error = connection.not_running(load_rig(file))
    assert says in str(error) and "nothing was commanded" in str(error)


def said(*words: str) -> dict[str, Any]:
    result = called(*words, "--json")
    told: dict[str, Any] = json.loads(result.stdout)
    told["status"] = result.exit_code
    return told


MOVES_OR_CHANGES = [words for words in EVERY_DRIVE_COMMAND if words[0] not in ("status", "hold", "mark")]


@pytest.mark.slow
@pytest.mark.parametrize("words", MOVES_OR_CHANGES, ids=lambda words: words[0])
def test_a_second_commander_is_told_who_holds_the_lease(rig: VirtualRig, words: tuple[str, ...]) -> None:
    alice = VirtualCommander(rig, "alice")
    assert alice.take().accepted
    refused = called(*words)
    alice.close()
    assert refused.exit_code == 1 and refused.stderr.count("\n") == 1
    assert refused.stderr.startswith(f"seldinger: {words[0]}: refused: lease: held by alice, wanted it free; ")
    assert "alice releases it" in refused.stderr and "for another" not in refused.stderr


@pytest.mark.slow
def test_hold_and_mark_need_no_lease_of_another_commander(rig: VirtualRig) -> None:
    alice = VirtualCommander(rig, "alice")
    assert alice.take().accepted and alice.arm().accepted
    assert called("hold").exit_code == 0 and called("mark", "the sheath slipped").exit_code == 0
    assert alice.disarm().accepted
    alice.close()


@pytest.mark.slow
def test_a_refusal_names_its_command_once_and_what_to_do(rig: VirtualRig) -> None:
    for words, says in (
        (("goto", "0,-10.7mm,20mm"), "goto: refused: found the rig disarmed, wanted armed; arm it first"),
        (("jog", "e3", "1mm"), "jog: refused: found the rig disarmed, wanted armed; arm it first"),
        (("hold",), "hold: refused: found the rig disarmed, wanted armed; arm it first"),
        (("force", "0.1"), "force: refused: found no touch in progress, wanted one; touch the tissue first"),
    ):
        assert called(*words).stderr.startswith(f"seldinger: {says}")


@pytest.mark.slow
def test_a_session_from_arm_to_disarm(rig: VirtualRig, tmp_path: Path) -> None:
    refused = said("jog", "e3", "2mm")
    assert refused["status"] == 1 and not refused["accepted"] and "wanted armed" in refused["text"]
    assert said("arm")["phase"] == "hold"
    there = said("goto", "0,-10.7mm,20mm")
    assert there["status"] == 0 and there["error_m"] < 1e-3 and there["phase"] == "position"
    beyond = said("goto", "0,0,500mm")
    assert beyond["status"] == 1 and "safety.workspace" in beyond["text"]
    jogged = said("jog", "0,0,-1", "2mm")
    assert jogged["status"] == 0 and jogged["phase"] == "hold" and abs(jogged["tip_m"][2] - 0.018) < 1e-3
    assert said("zero")["status"] == 0 and said("mark", "before the touch")["status"] == 0
    touched = said("touch", "0,-10.7mm,25mm", "--force", "150mN", "--for", "3s")
    assert touched["status"] == 0 and abs(touched["mean_force_N"] - 0.15) < 0.05 and touched["phase"] == "stopped"
    assert said("disarm")["status"] == 0 and said("arm")["phase"] == "hold"
    assert said("hold")["accepted"] and said("clear")["accepted"]


def stopped_state() -> RigState:
    """The state of a rig that a silent board has stopped."""
    return RigState(
        stamp_ns=1,
        mode="stopped",
        safety_action="stop",
        cause="no status from the stepper board; no pose for longer than the limit: stopped",
        tip_m=(0.0, -0.01, 0.02),
        force_N=0.01,
        pose_age_ns=20_000_000,
        poses_rejected=0,
        forces_rejected=0,
    )


class StoppedRig:
    """A connection to a rig that has stopped, with its first cause."""

    def __init__(self, cause: str) -> None:
        self._cause = cause

    def latest(self, topic: str) -> RigState:
        return stopped_state()

    def first_cause(self) -> str:
        return self._cause


def test_a_motion_that_fails_states_the_first_cause_alone(capsys: pytest.CaptureFixture[str]) -> None:
    driver = drive.Driver(StoppedRig("The computer stood still for 812 ms. End other programs."), "goto", json=False)  # type: ignore[arg-type]
    driver.failed("not reached: 10.7 mm off, phase stopped")
    said = capsys.readouterr().err
    assert said.endswith("phase stopped; first cause: The computer stood still for 812 ms. End other programs.\n")
    assert "no pose" not in said and driver.result["text"] in said
    unknown = drive.Driver(StoppedRig(""), "goto", json=False)  # type: ignore[arg-type]
    assert unknown.why().startswith("; safety: no status from the stepper board")


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("jog", "knob", "5"), "either way; did you mean 5deg?"),
        (("jog", "e3", "--", "-2"), "either way; did you mean -2mm?"),
        (("jog", "e3", "50mm"), "either way"),
        (("touch", "0,-10.7mm,25mm", "--force", "200"), "did you mean 200mN?"),
    ],
)
def test_a_number_in_a_smaller_unit_is_recognized(words: tuple[str, ...], hint: str) -> None:
    with pytest.raises(InputError) as caught:
        CliRunner().invoke(build(list(words)), list(words), catch_exceptions=False)
    assert str(caught.value).endswith(hint)


def test_the_rising_of_the_force_is_no_part_of_its_mean() -> None:
    rising = [(20_000_000 * i, min(0.2, 0.2 * i / 50)) for i in range(400)]
    mean_N, settle_s = drive.settled_mean(rising)
    assert abs(mean_N - 0.2) < 1e-9 and settle_s == 1.5
    assert drive.settled_mean(rising[:100])[1] < 1.0 and math.isnan(drive.settled_mean([])[0])


def test_the_status_puts_the_first_cause_first() -> None:
    state = stopped_state()
    status = RigStatus(
        rig="lab", newest={"state": state}, cause="The loop was late.", remedy="Close other programs.", followed=("Then.",)
    )
    lines = status.lines()
    assert lines[0].startswith("lab: stopped") and lines[1].endswith("The loop was late.") and "Close" in lines[2]
    assert any("sends nothing" in line for line in lines) and json.dumps(status.as_json())
    assert RigStatus(rig="lab", newest={}).lines() == ["lab: no message from the control loop"]
