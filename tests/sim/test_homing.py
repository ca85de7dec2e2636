"""Homing against the real firmware: the switch is found to the step, and what is not as wired is said in one line."""

from __future__ import annotations

from itertools import pairwise

import pytest

from protocol.serial_frames import Fault
from realtime.drivers.homing import SLOW_STEPS_PER_S, Home, Homing, HomingFailed, homing_limits
from realtime.drivers.stepper_board import StepperBoardLink
from tests.sim.board_rig import EVERY_BOARD, LIMITS, BoardRig

HOME = Home(axis=0, end=-1, at_steps=-16_000, travel_steps=6_000, speed_steps_per_s=2_000.0)
# A switch opens here by true position, and stays open beyond.
SWITCH_STEPS = -3_000


class Stage:
    """A board whose axis 0 has switches; `follow` runs a homing to its end."""

    def __init__(self, kind: str, mcu: str, home: Home = HOME) -> None:
        self.rig, self.home = BoardRig(kind, mcu), home
        self.rig.link = StepperBoardLink(homing_limits(LIMITS, home))
        self.homing = Homing(self.rig.link, home)
        self.switches = {0: lambda steps: steps <= SWITCH_STEPS}

    def follow(self, seconds: float = 30.0) -> None:
        for _ in range(round(seconds * 1000)):
            steps = int(self.rig.position[0])
            self.rig.inputs = {"limit_bits": sum(1 << bit for bit, opens in self.switches.items() if opens(steps))}
            self.rig.slice(self.homing.advance(self.rig.now_ns))
            if self.homing.done:
                return
        raise AssertionError(f"not done after {seconds} s: {self.rig.events}")


@pytest.fixture
def stage(request: pytest.FixtureRequest) -> Stage:
    made = Stage(*getattr(request, "param", ("native", "atmega2560")))
    request.addfinalizer(made.rig.close)
    return made


@pytest.mark.parametrize("stage", EVERY_BOARD, indirect=True)
def test_the_switch_is_found_to_the_step(stage: Stage) -> None:
    stage.follow()
    status = stage.rig.status
    true_minus_named = int(stage.rig.position[0]) - int(status.position_steps[0])
    assert abs(true_minus_named - (SWITCH_STEPS - HOME.at_steps)) <= 2
    assert not stage.rig.link.armed and status.fault == Fault.NONE and not status.inputs & 1
    assert 2 <= stage.homing.difference_steps <= 0.01 * HOME.speed_steps_per_s  # what the fast touch ran on
    assert int(status.position_steps[0]) > HOME.at_steps and stage.rig.position[1:].tolist() == [0, 0]
    stage.rig.run_ms(50)
    assert int(stage.rig.position[0]) - int(stage.rig.status.position_steps[0]) == true_minus_named


def test_from_on_the_switch_it_leaves_first(stage: Stage) -> None:
    stage.switches = {0: lambda steps: steps <= 100}
    stage.follow()
    assert abs(int(stage.rig.position[0]) - int(stage.rig.status.position_steps[0]) - (100 - HOME.at_steps)) <= 2


def test_the_slow_touch_is_within_a_step(stage: Stage) -> None:
    stage.follow()
    edges_s = [time_us * 1e-6 for time_us in stage.rig.edge_us[0]]
    assert 1 / min(b - a for a, b in pairwise(edges_s)) < 1.2 * HOME.speed_steps_per_s
    assert SLOW_STEPS_PER_S * 0.003 < 1.0


@pytest.mark.parametrize(
    ("switches", "says"),
    [
        ({}, "found no change of the lower switch after 7"),
        ({0: lambda steps: True}, "found no change of the lower switch after 7"),
        ({1: lambda steps: steps <= SWITCH_STEPS}, "found another switch than the lower one"),
        ({4: lambda steps: steps <= SWITCH_STEPS}, "found another switch than the lower one"),
    ],
)
def test_what_is_wired_wrong_is_said_and_nothing_moves_on(stage: Stage, switches: dict, says: str) -> None:
    stage.switches = switches
    with pytest.raises(HomingFailed, match=says):
        stage.follow()
    stage.rig.run_ms(100)
    before = stage.rig.position.copy()
    stage.rig.run_ms(100)
    assert not stage.rig.link.armed and (stage.rig.position == before).all()


def test_an_emergency_stop_ends_it_in_words(stage: Stage) -> None:
    def follow() -> None:
        for tick in range(5000):
            stage.rig.inputs = {"estop": tick > 1000}
            stage.rig.slice(stage.homing.advance(stage.rig.now_ns))

    with pytest.raises(HomingFailed, match="found ESTOP, wanted its switch"):
        follow()
