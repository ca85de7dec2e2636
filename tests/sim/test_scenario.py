"""The main job in lock step: outcome, determinism, and a board that is pulled out of the running job."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from protocol.enums import Phase
from protocol.rig_file import load_rig
from protocol.topics import Message
from realtime.core.lines import ToRig
from sim.board import SimulatedBoard
from sim.plant import Plant, PlantConfig
from sim.scenario import ContactJob, Scenario
from sim.world import World
from tests.realtime.conftest import RIG_FILE

TARGET = ContactJob(target_m=(0.0, -0.0107, 0.025), hold_s=3.0)
HERE = Path(__file__).parents[2]
PEAK_N = 0.55


def scenario(board: SimulatedBoard, seed: int = 1, heard: dict[str, list[Message]] | None = None) -> Scenario:
    rig = load_rig(RIG_FILE)
    plant = Plant(PlantConfig(tool_offsets_m=(0.0, rig.tracker.shaft_sensor_offset_m)), seed)

    def publish(topic: str, message: Message) -> None:
        if heard is not None:
            heard.setdefault(topic, []).append(message)

    return Scenario(rig, World(rig, plant, board, seed), publish)


@pytest.fixture
def board():  # type: ignore[no-untyped-def]
    with SimulatedBoard("native") as made:
        yield made


def test_the_tip_comes_to_the_wall_and_holds(board: SimulatedBoard) -> None:
    heard: dict[str, list[Message]] = {}
    run = scenario(board, heard=heard)
    outcome = run.press(TARGET)
    assert outcome.contact and not outcome.stopped and not outcome.notes
    status = run.loop.core.link.status
    assert status is not None
    assert (status.crc_errors, status.underruns, status.fault) == (0, 0, 0)
    assert outcome.steps_commanded == outcome.steps_on_pins == outcome.steps_reported
    assert outcome.steps_commanded != [0, 0, 0]
    force = np.array([m.force_N for m in heard["state"] if m.mode == "contact"])  # type: ignore[attr-defined]
    assert 0.05 < np.mean(force[len(force) // 2 :]) < 0.4
    assert run.world.peak_force_N < 0.5


PROGRAM = """
import sys
from tests.sim.test_scenario import scenario, TARGET
from sim.board import SimulatedBoard
with SimulatedBoard(sys.argv[1]) as board:
    run = scenario(board, int(sys.argv[2]))
    run.press(TARGET)
    print(run.world.digest)
"""


def digest_of(kind: str, seed: int) -> str:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, kind, str(seed)], cwd=HERE, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_edges_and_poses_in_another_process() -> None:
    first = digest_of("native", 1)
    assert len(first) == 64
    assert digest_of("native", 1) == first
    assert digest_of("native", 2) != first


@pytest.mark.slow
@pytest.mark.avr
def test_the_real_firmware_is_as_deterministic(avr_tools: None) -> None:
    assert digest_of("avr", 1) == digest_of("avr", 1)


def in_contact(run: Scenario) -> None:
    assert run.arm()
    run._shape(TARGET)
    run.command("target", "contact", target_m=TARGET.target_m, normal=TARGET.into, force_N=0.2)
    assert run.run(10.0, lambda: run.phase == Phase.CONTACT)
    run.run(0.5)


def rest_after(run: Scenario, seconds: float) -> float:
    """Lets the world go on alone, without the computer; the time (s) until the last step edge."""
    begin_ns, last_ns = run.world.now_ns, run.world.now_ns
    while run.world.now_ns < begin_ns + seconds * 1e9:
        run.world.exchange(run.world.now_ns + 1_000_000, ToRig())
        if run.world.slice is not None and len(run.world.slice.edge_cycle):
            last_ns = run.world.now_ns
    return (last_ns - begin_ns) * 1e-9


def test_without_the_computer_the_stages_rest_within_100_ms(board: SimulatedBoard) -> None:
    run = scenario(board)
    in_contact(run)
    assert rest_after(run, 0.5) <= 0.100
    assert run.world.peak_force_N < PEAK_N


@pytest.mark.parametrize("stall_s", [0.0, 0.05, 0.3, 2.0])
def test_a_stop_in_contact_keeps_the_force_small_whatever_the_computer_missed(board: SimulatedBoard, stall_s: float) -> None:
    run = scenario(board)
    in_contact(run)
    rest_after(run, stall_s)
    assert run.command("stop").accepted
    run.run(3.0)
    assert rest_after(run, 0.3) == 0.0
    assert run.world.peak_force_N < PEAK_N


def test_a_reset_board_stops_the_loop_until_an_operator_clears_it(board: SimulatedBoard) -> None:
    run = scenario(board)
    in_contact(run)
    board.reset()
    run.run(0.3)
    assert not run.loop.outputs[0].valid or run.loop.state[0].latched
    moved = run.world.edges.copy()
    run.run(1.0)
    assert np.array_equal(moved, run.world.edges), "nothing moves by itself after a reset"
    assert any("reset" in fault for fault in run.loop.core.board_errors)


def test_the_emergency_stop_holds_everything(board: SimulatedBoard) -> None:
    run = scenario(board)
    in_contact(run)
    run.world.estop = True
    run.run(0.2)
    edges = run.world.edges.copy()
    run.world.estop = False
    run.run(1.0)
    assert np.array_equal(edges, run.world.edges)
    assert any("ESTOP" in fault for fault in run.loop.core.board_errors)
