"""What an operator asks for and cannot have: refused in one line, and the loop's command stays what it was."""

import pytest

from protocol.rig_file import Rig
from protocol.topics import Command
from realtime.control.records import INPUTS, new
from realtime.core.board_intake import axis_limits
from realtime.core.operator_commands import OperatorCommands
from realtime.drivers.stepper_board import StepperBoardLink


@pytest.mark.parametrize(
    ("target_m", "words"),
    [
        ((0.0, -0.1, 0.0), "wanted a point that the unloaded tip can reach: it comes no nearer than 69.6 mm"),
        ((0.0, 0.0, 0.2), "it comes no nearer than"),
        ((0.0, 0.0, 0.5), "safety.workspace"),
    ],
)
@pytest.mark.parametrize("target", ["position", "contact"])
def test_a_target_out_of_reach_changes_nothing(rig: Rig, target: str, target_m: tuple, words: str) -> None:
    record = new(INPUTS)[0].command
    commands = OperatorCommands(rig, record, StepperBoardLink(axis_limits(rig)))
    record.armed = 1
    before = record.tobytes()
    reply = commands.execute(
        Command(
            stamp_ns=1,
            sequence=1,
            id="a",
            commander="b",
            expires_ns=2,
            action="target",
            target=target,
            target_m=target_m,
            normal=(0.0, 0.0, 1.0),
            force_N=0.1,
        ),
        1,
    )
    assert reply.result == "refused" and words in reply.text and "\n" not in reply.text
    assert record.tobytes() == before and not commands.take_frames()
    good = commands.execute(
        Command(
            stamp_ns=1,
            sequence=2,
            id="c",
            commander="b",
            expires_ns=2,
            action="target",
            target=target,
            target_m=(0.0, -0.0107, 0.025),
            normal=(0.0, 0.0, 1.0),
            force_N=0.1,
        ),
        1,
    )
    assert good.result == "accepted"
