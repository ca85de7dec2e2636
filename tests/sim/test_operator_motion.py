"""Jog, zero and mark on the simulated rig in lock step: how far it moves, where it ends, what it refuses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from protocol.enums import Phase
from protocol.topics import Log, Message
from sim.board import SimulatedBoard
from sim.scenario import ContactJob, Scenario
from tests.sim.test_scenario import scenario

BEFORE_WALL_M = (0.0, -0.0107, 0.020)


pytestmark = pytest.mark.slow


class Driven:
    """An armed rig; `begin` brings the tip 5 mm before the wall and holds."""

    def __init__(self, board: SimulatedBoard) -> None:
        self.heard: dict[str, list[Message]] = {}
        self.run: Scenario = scenario(board, heard=self.heard)
        assert self.run.arm()
        self.wrench = self.run.world.plant.measured_wrench

    def begin(self) -> Driven:
        self.run.world.plant.measured_wrench = self.wrench  # type: ignore[method-assign]
        self.run.world.peak_force_N = 0.0
        self.run.run(0.1)  # a disarmed rig says so after its next tick
        if self.run.phase == Phase.DISARMED:
            assert self.run.arm()
        self.run.command("target", "retract")
        assert self.run.run(2.0, lambda: self.run.phase == Phase.STOPPED)
        self.run.command("disarm")
        self.run.run(0.1)
        assert self.run.arm() and self.run.command("target", "position", target_m=BEFORE_WALL_M).accepted
        self.run.run(1.5)
        assert self.run.command("hold").accepted
        self.run.run(0.2)
        self.heard.clear()
        return self

    @property
    def tip_m(self) -> np.ndarray:
        """The true tip."""
        return np.array(self.run.world.plant.truth()["tip_m"])

    def jog(self, axis: str, travel: float, speed: float, **fields: object) -> str:
        """Give one jog; the reason of a refusal."""
        answer = self.run.command("jog", axis=axis, travel_unit=travel, speed_unit_per_s=speed, **fields)
        return answer.reason

    def logged(self, source: str) -> list[str]:
        return [line.text for line in self.heard["log"] if isinstance(line, Log) and line.source == source]


@pytest.fixture(scope="module")
def rig() -> Iterator[Driven]:
    with SimulatedBoard("native") as board:
        yield Driven(board)


@pytest.fixture
def driven(rig: Driven) -> Driven:
    return rig.begin()


def test_a_jog_of_the_tip_moves_it_that_way_at_that_speed_and_ends(driven: Driven) -> None:
    start_m = driven.tip_m
    assert driven.jog("tip", 0.003, 0.005, direction=(0.0, 1.0, 0.0)) == ""
    driven.run.run(0.3)
    assert driven.run.phase == Phase.JOG and np.linalg.norm(driven.tip_m - start_m) < 0.0025, "no faster than commanded"
    assert driven.run.run(2.0, lambda: driven.run.phase == Phase.HOLD)
    moved_m = driven.tip_m - start_m
    assert abs(moved_m[1] - 0.003) < 0.0008 and np.linalg.norm(moved_m[[0, 2]]) < 0.0008
    driven.run.run(1.0)
    assert np.linalg.norm(driven.tip_m - start_m - moved_m) < 0.0003, "it ends by itself"


def test_a_stop_ends_with_disarm_and_arm(driven: Driven) -> None:
    assert driven.run.command("stop").accepted
    driven.run.run(1.0)
    assert driven.run.command("disarm").accepted
    driven.run.run(0.1)
    assert driven.run.command("arm").accepted
    driven.run.run(0.2)
    assert driven.run.phase == Phase.HOLD


def test_a_jog_of_each_axis_moves_that_axis_alone(driven: Driven) -> None:
    for axis, name, travel, speed, tolerance in (
        (0, "insertion", -0.002, 0.005, 0.0004),
        (1, "roll", 0.1, 0.5, 0.01),
        (2, "knob", -0.1, 0.5, 0.01),
    ):
        before = np.array(driven.run.loop.outputs[0].joint)
        assert driven.jog(name, travel, speed) == ""
        assert driven.run.run(1.5, lambda: driven.run.phase == Phase.HOLD), "a jog that is done holds"
        change = np.array(driven.run.loop.outputs[0].joint) - before
        assert abs(change[axis] - travel) < tolerance, name
        driven.run.run(0.5)
        held = np.array(driven.run.loop.outputs[0].joint) - before
        assert abs(held[axis] - travel) < tolerance, f"hold keeps what the jog of {name} reached"


def test_a_held_button_is_a_chain_of_short_jogs_and_ends_when_it_breaks(driven: Driven) -> None:
    start_m = driven.tip_m
    for _ in range(10):
        assert driven.jog("tip", 0.0015, 0.005, direction=(0.0, 1.0, 0.0)) == ""
        driven.run.run(0.1)
    way_m = float(driven.tip_m[1] - start_m[1])
    assert 0.0035 < way_m < 0.006, "1 s at 5 mm/s, without a pause between two commands"
    driven.run.run(3.0)
    assert float(driven.tip_m[1] - start_m[1]) < way_m + 0.0025, "without its commander it ends within one jog"


def test_a_jog_into_the_wall_ends_where_it_touches_and_only_leads_away(driven: Driven) -> None:
    assert driven.jog("tip", 0.015, 0.005, direction=(0.0, 0.0, 1.0)) == ""
    assert driven.run.run(4.0, lambda: driven.run.phase == Phase.HOLD)
    driven.run.run(0.02)
    assert driven.run.world.peak_force_N < 0.15
    # The wall beats: take the moment when it presses.
    assert driven.run.run(3.0, lambda: bool(np.linalg.norm(driven.run.loop.outputs[0].force_N) > 0.06))
    assert "wanted a jog away" in driven.jog("tip", 0.002, 0.005, direction=(0.0, 0.0, 1.0))
    assert "wanted a jog away" in driven.jog("roll", 0.1, 0.5)
    assert driven.jog("tip", 0.003, 0.010, direction=(0.0, 0.0, -1.0)) == ""
    driven.run.run(1.5)
    assert float(np.linalg.norm(driven.run.loop.outputs[0].force_N)) < 0.02


def test_a_jog_beyond_a_limit_is_refused_with_the_limit(driven: Driven) -> None:
    steps = driven.run.world.steps.copy()
    assert "at most 0.02 m in one jog" in driven.jog("insertion", 0.1, 0.005)
    assert "at most 0.01 m/s" in driven.jog("insertion", 0.01, 0.05)
    assert "at most 1.2 rad/s" in driven.jog("knob", 0.1, 3.0)
    assert "the stage's travel" in driven.jog("knob", -0.8, 1.0) or "the stage's travel" in driven.jog("knob", 0.8, 1.0)
    assert "unloaded tip can reach" in driven.jog("tip", 0.02, 0.01, direction=(0.0, 0.0, -1.0))
    assert "wanted one for a jog of the tip" in driven.jog("tip", 0.002, 0.01)
    assert driven.run.phase == Phase.HOLD and np.all(abs(driven.run.world.steps - steps) < 40), "nothing moved"


def test_a_jog_is_refused_in_contact_and_while_disarmed(driven: Driven) -> None:
    job = ContactJob(target_m=(0.0, -0.0107, 0.025))
    driven.run.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=0.1)
    driven.run.run(0.2)
    assert "found the loop in phase approach" in driven.jog("insertion", -0.001, 0.005)
    driven.run.command("disarm")
    assert "found the rig disarmed" in driven.jog("insertion", -0.001, 0.005)


def test_zero_removes_a_standing_load_and_refuses_one_that_moves(driven: Driven) -> None:
    box = driven.run.world.force_box
    measured = driven.wrench
    bias_N = np.array([0.05, -0.03, 0.08])
    driven.run.world.plant.measured_wrench = lambda: (measured()[0] + bias_N, measured()[1])  # type: ignore[method-assign]
    driven.run.run(0.6)
    assert box is not None and np.linalg.norm(driven.run.loop.outputs[0].force_N) > 0.09
    assert driven.run.command("zero").accepted
    driven.run.run(0.2)
    assert np.linalg.norm(driven.run.loop.outputs[0].force_N) < 0.015
    assert any("are subtracted from every reading" in text for text in driven.logged("force_zero"))
    phase = iter(np.linspace(0.0, 750.0, 100_000))
    driven.run.world.plant.measured_wrench = lambda: (np.array([0.0, 0.0, 0.1 * np.sin(next(phase))]), measured()[1])  # type: ignore[method-assign]
    driven.run.run(0.6)
    assert "has to hang free" in driven.run.command("zero").reason


def test_a_mark_is_a_line_of_the_log_and_needs_no_lease(driven: Driven) -> None:
    driven.run.commander.release()
    assert driven.run.commander.give("mark", note="sheath moved").accepted
    assert driven.logged("mark") == ["sheath moved"]
    assert "note" in driven.run.commander.give("mark", note=" ").reason


def test_one_clear_after_a_fault_of_the_board_is_enough(driven: Driven) -> None:
    """The fault still stands at the time of the command. The last test: a reset board does not know its position."""
    driven.run.world.board.reset()
    driven.run.run(1.0)
    assert not driven.run.command("arm").accepted
    assert driven.run.command("clear_fault").accepted
    driven.run.run(1.0)
    assert int(driven.run.loop.outputs[0].action) == 0 and driven.run.command("arm").accepted
    driven.run.run(0.2)
    assert driven.run.phase == Phase.HOLD
