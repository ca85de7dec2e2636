"""Contact of the body, watched: three sensors find it and its place, and a beating wall at the tip raises nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from host.estimation.interface import Actuation, PoseReading, TipForce
from host.estimation.rig_estimator import make_estimator
from host.estimation.service import EstimationService
from host.recordings.header import header_of
from host.recordings.recording import RecordingFile
from host.recordings.writer import RecordingWriter
from host.studies.benchmarks.body_contact import CASES, COMES_S, THREE, TWO, ObstacleCase, clean, run, with_sensors
from protocol.rig_file import SIMULATED_RIG, load_rig
from protocol.topics import BodyContact, ForceEstimate, Message, RigState
from sim.forked_board import forkable_board
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant


def recorded(path: Path, offsets_m: tuple[float, ...]) -> tuple[World, ForceEstimate]:
    """Two seconds of the rig at rest, recorded: the world and the newest estimate."""
    rig, estimates = with_sensors(load_rig(SIMULATED_RIG), offsets_m), []
    world = World(rig, simulated_plant(rig, 3), forkable_board("native"), 3)
    with RecordingWriter(path, header_of(rig, "virtual", 3, {})) as writer:

        def publish(topic: str, message: Message) -> None:
            writer.write(topic, message, world.now_ns)
            if isinstance(message, ForceEstimate) and message.converged:
                estimates.append(message)

        Scenario(rig, world, publish, estimator=EstimationService(make_estimator(rig))).run(2.2)
    return world, estimates[-1]


def test_a_third_sensor_goes_through_driver_topic_recording_and_model_process(tmp_path: Path) -> None:
    """With three sensors its pose is where the catheter is 40 mm behind the tip; with two there is nothing of it."""
    _, by_two = recorded(tmp_path / "2.mcap", TWO)
    world, by_three = recorded(tmp_path / "3.mcap", THREE)
    assert "pose/rear" not in RecordingFile(tmp_path / "2.mcap").topics
    tip, rear = (RecordingFile(tmp_path / "3.mcap").table(topic) for topic in ("pose/tip", "pose/rear"))
    assert len(rear["stamp_ns"]) > 20 and np.array_equal(rear["stamp_ns"], tip["stamp_ns"])
    true_m = world.plant.sensor_pose(THREE[2])[0]
    for row, name in enumerate(("x_m", "y_m", "z_m")):
        assert rear[name].mean() == pytest.approx(true_m[row], abs=4.0 * world.rig.tracker.position_noise_m / np.sqrt(20))
    assert by_two.force_N != by_three.force_N  # the estimator uses it


def test_a_third_pose_is_given_to_an_estimator_only_where_the_rig_has_one() -> None:
    """An estimator of two sensors, from another package, keeps its three arguments."""
    rig = load_rig(SIMULATED_RIG)
    asked: list[tuple] = []

    class OfTwo:
        def estimate(self, tip: PoseReading, shaft: PoseReading | None, actuation: Actuation) -> TipForce:
            asked.append((tip, shaft, actuation))
            return TipForce(np.zeros(3), np.eye(3), True, 0.0, tip.stamp_ns)

    world = World(rig, simulated_plant(rig, 1), forkable_board("native"), 1)
    Scenario(rig, world, lambda topic, message: None, estimator=EstimationService(OfTwo())).run(2.0)  # type: ignore
    assert len(asked) > 5


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case.offsets_m == THREE][:3])
def test_three_sensors_of_the_running_rig_find_the_place_to_five_millimetres(case: ObstacleCase) -> None:
    found = run(load_rig(SIMULATED_RIG), 7, case, 6.0)
    before = [report for report in found.reports if report.stamp_ns < COMES_S * 1e9]
    assert len(before) > 20 and {report.place for report in before} == {"tip"}
    last = [report for report in found.reports if report.place != "tip"][-1]
    assert found.true_force_N > 0.05 and 0.0 < found.warned_s < 0.6
    assert last.place == "body" and last.sensors == 3 and last.body_offset_m is not None
    assert abs(last.body_offset_m - found.true_offset_m) < 0.005
    assert last.body_force_N is not None
    assert np.linalg.norm(last.body_force_N) == pytest.approx(found.true_force_N, rel=0.3)


@pytest.mark.slow
def test_pressing_on_the_beating_wall_with_three_sensors_warns_of_nothing() -> None:
    rig, warned = with_sensors(load_rig(SIMULATED_RIG), THREE), []
    reports: list[BodyContact] = []

    def publish(topic: str, message: Message) -> None:
        if isinstance(message, BodyContact):
            reports.append(message)
        elif isinstance(message, RigState) and message.safety_action not in ("none",):
            warned.append(message)

    world = World(rig, simulated_plant(rig, 11), forkable_board("native"), 11)
    scenario = Scenario(rig, world, publish, estimator=EstimationService(make_estimator(rig)))
    pressed = scenario.press(ContactJob(target_m=TARGET_M, hold_s=8.0))
    assert pressed.contact and len(reports) > 40 and {report.place for report in reports} == {"tip"}
    assert not any("body touches" in state.cause for state in warned)


@pytest.mark.parametrize("offsets_m", [TWO, THREE])
def test_a_beating_wall_at_the_tip_is_no_contact_of_the_body(offsets_m: tuple[float, ...]) -> None:
    reports, force_N, touched = clean(load_rig(SIMULATED_RIG), 8, 6.0, offsets_m)
    assert force_N > 0.05 and len(reports) > 20
    assert not touched and {report.place for report in reports} == {"tip"}
