"""Homing by the running rig, in lock step: what it refuses, how it moves and ends, and that the rig arms after it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from protocol.enums import BoardState
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Log, Message, RigState
from realtime.drivers.stepper_board import LinkPhase
from sim.board import SimulatedBoard
from sim.scenario import Scenario
from sim.world import World, simulated_plant

# The switch of the insertion, from where the stage is switched on. The rig file calls that place by its real position.
SWITCH_M = -0.002


def rig_with_a_switch(folder: Path) -> Rig:
    text = SIMULATED_RIG.read_text(encoding="utf-8")
    for key, value in (("home_end", '"min"'), ("home_unit", str(SWITCH_M)), ("home_speed_unit_per_s", "0.004")):
        old = next(line for line in text.splitlines() if line.startswith(f"{key} "))
        text = text.replace(old, f"{key} = {value}", 1)
    path = folder / "switch.toml"
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


class Homed:
    """A simulated rig with a switch, disarmed and with all devices up; what it published."""

    def __init__(self, rig: Rig, board: SimulatedBoard) -> None:
        self.rig = rig
        self.modes: list[str] = []
        self.log: list[Log] = []
        self.world = World(rig, simulated_plant(rig, 1), board, 1)
        self.run = Scenario(rig, self.world, self.take)
        assert self.run.run(10.0, self.run.ready)

    def take(self, topic: str, message: Message) -> None:
        if isinstance(message, RigState) and (not self.modes or self.modes[-1] != message.mode):
            self.modes.append(message.mode)
        if isinstance(message, Log):
            self.log.append(message)

    def ended(self) -> list[Log]:
        return [line for line in self.log if line.source == "home"]

    def home(self, seconds: float = 20.0) -> Log:
        assert self.run.run(seconds, lambda: bool(self.ended())), self.log[-3:]
        self.run.run(0.3)
        return self.ended()[-1]

    @property
    def steps(self) -> np.ndarray:
        return np.array(self.world.steps)


@pytest.fixture
def homed(tmp_path: Path) -> Iterator[Homed]:
    with SimulatedBoard("native") as board:
        yield Homed(rig_with_a_switch(tmp_path), board)


def test_the_axis_is_homed_and_the_rig_is_armed_and_moves_after_it(homed: Homed) -> None:
    run, limits = homed.run, homed.run.loop.core.link.axes
    assert run.command("home", axis="insertion").accepted
    assert run.command("home", axis="insertion").reason.endswith("wanted one axis at a time")
    run.run(0.3)
    assert homed.modes == ["disarmed", "homing"] and "being homed" in run.command("arm").reason
    ended = homed.home()
    assert ended.level == "info" and ended.text.startswith("insertion: switch found, its position is -0.002 m"), ended
    link, at_steps = run.loop.core.link, round(SWITCH_M * homed.rig.stage(0).steps_per_unit)
    assert link.status is not None and link.status.state == BoardState.DISARMED and link.phase is LinkPhase.READY
    assert abs(int(homed.steps[0]) - int(link.status.position_steps[0])) <= 2, "the board's position is the true one"
    assert at_steps < homed.steps[0] < 0 and homed.steps[1:].tolist() == [0, 0], "next to the switch; no other axis moved"
    assert link.axes == limits and homed.modes[-1] == "disarmed"
    assert not [line for line in homed.log if line.level == "error"]
    assert run.arm()
    run.run(0.1)
    assert not [line for line in homed.log if "not homed" in line.text]
    assert homed.modes[-1] == "hold"
    before = homed.steps
    assert run.command("jog", axis="insertion", travel_unit=0.001, speed_unit_per_s=0.005).accepted
    run.run(1.0)
    assert homed.steps[0] > before[0] and homed.modes[-1] == "hold" and run.loop.outputs[0].action == 0


def test_arming_without_a_homing_is_warned_of_and_again_after_a_reset_of_the_board(homed: Homed) -> None:
    run = homed.run
    assert run.arm()
    run.run(0.1)
    assert [line.level for line in homed.ended()] == ["warning"]
    assert homed.ended()[0].text.startswith("armed, but insertion not homed since the board was connected")
    assert run.command("disarm").accepted
    run.run(0.3)
    homed.log.clear()
    assert run.command("home", axis="insertion").accepted
    ended = homed.home()
    assert ended.level == "info", ended
    homed.log.clear()
    assert run.arm()
    run.run(0.3)
    assert homed.modes[-1] == "hold" and {line.level for line in homed.log} == {"info"}
    homed.world.board.reset()
    run.run(1.0)
    run.command("clear_fault")
    assert run.run(5.0, run.ready) and run.arm()
    run.run(0.1)
    assert [line.level for line in homed.ended()] == ["warning"]


@pytest.mark.parametrize("ending", ["stop", "hold", "disarm"])
def test_stop_hold_and_disarm_bring_it_to_rest(homed: Homed, ending: str) -> None:
    run = homed.run
    assert run.command("home", axis="insertion").accepted
    run.run(0.6)
    assert homed.steps[0] < 0
    assert run.command(ending).accepted
    run.run(0.1)
    assert homed.modes[-1] == "disarmed", "within the time in which a stop has to be confirmed"
    before = homed.steps
    run.run(1.0)
    assert (homed.steps == before).all() and homed.ended()[-1].level == "error"
    assert "ended by the operator; not homed" in homed.ended()[-1].text
    run.command("clear_fault")
    run.run(0.3)
    assert run.arm(), "the rig file's limits are the board's again"


def test_a_force_on_the_tip_ends_it_and_forbids_another(homed: Homed) -> None:
    run = homed.run
    run.command("home", axis="insertion")
    run.run(0.3)
    homed.world.plant.measured_wrench = lambda: (np.array([0.0, 0.0, 1.0]), np.zeros(3))  # type: ignore[method-assign]
    ended = homed.home(1.0)
    assert ended.level == "error" and "wanted at most safety.over_force_N" in ended.text and homed.modes[-1] == "disarmed"
    assert "N on the tip, wanted less than control.contact_force_N" in run.command("home", axis="insertion").reason


def test_a_board_that_falls_silent_ends_it(homed: Homed) -> None:
    run = homed.run
    run.command("home", axis="insertion")
    run.run(0.3)
    homed.world.advance = lambda until_ns, to_board, real=homed.world.advance: real(until_ns, b"") and b""  # type: ignore
    ended = homed.home(5.0)
    assert "found no status of the board for 0.5 s" in ended.text and homed.modes[-1] == "disarmed"


def test_what_may_not_be_homed_is_refused_and_does_not_move(homed: Homed) -> None:
    run = homed.run
    assert "stages.roll.home_end" in run.command("home", axis="roll").reason
    assert run.arm()
    assert run.command("home", axis="insertion").reason.endswith("refused: found the rig armed, wanted disarmed")
    run.command("disarm")
    run.run(0.3)
    homed.world.estop = True
    run.run(0.1)
    assert "fault ESTOP" in run.command("home", axis="insertion").reason
    assert homed.steps[0] == 0 and "homing" not in homed.modes
