"""The estimator among messages, and as a process: poses in, checked forces out, everything recorded, a clean end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from host.estimation.interface import Actuation, Estimator, PoseReading, TipForce
from host.estimation.service import EstimationService, load_estimator
from host.recordings.recording import RecordingFile
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import ForceSensor, Pose, Stage
from protocol.zenoh_session import Session
from tests.waiting import PATIENCE_S, until

ROOT = Path(__file__).parents[2]
RIG = SIMULATED_RIG


class Spring:
    """Stands in for a model: the force is 10 N/m times how far the tip is from the actuated insertion, along e3."""

    def __init__(self) -> None:
        self.asked: list[tuple[PoseReading, PoseReading | None, Actuation]] = []

    def estimate(self, pose_tip: PoseReading, pose_shaft: PoseReading | None, actuation: Actuation) -> TipForce:
        self.asked.append((pose_tip, pose_shaft, actuation))
        force_N = np.array([0.0, 0.0, 10.0 * (actuation.insertion_m - pose_tip.position_m[2])])
        return TipForce(force_N, 1e-4 * np.eye(3), True, 0.5, pose_tip.stamp_ns)


def make_spring(rig: Rig) -> Estimator:
    """Return the estimator that the tests name with `--estimator MODULE:make_spring`."""
    return Spring()


class Broken:
    """Answers with what it is given, or raises it."""

    def __init__(self, answer: TipForce | Exception) -> None:
        self.answer = answer

    def estimate(self, pose_tip: PoseReading, pose_shaft: PoseReading | None, actuation: Actuation) -> TipForce:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def stage(time_ns: int, insertion_m: float = 0.05, known: bool = True) -> Stage:
    return Stage(
        stamp_ns=time_ns,
        command_insertion_m=0.0,
        command_roll_rad=0.0,
        command_knob_rad=0.0,
        joint_insertion_m=insertion_m if known else None,
        joint_roll_rad=0.1,
        joint_curvature_per_m=15.0,
    )


def pose(time_ns: int, height_m: float = 0.04, missing: bool = False) -> Pose:
    return Pose(
        stamp_ns=time_ns,
        arrival_ns=time_ns,
        frame=1,
        missing=missing,
        position_m=None if missing else (0.0, 0.0, height_m),
        quaternion_wxyz=None if missing else (1.0, 0.0, 0.0, 0.0),
    )


def test_a_pose_is_answered_once_with_the_actuation_of_its_time() -> None:
    spring = Spring()
    service = EstimationService(spring)
    for tick in range(100):
        service.receive("stage", stage(tick * 1_000_000, insertion_m=tick * 1e-3))
    service.receive("pose/shaft", pose(75_000_000, height_m=0.01))
    service.receive("pose/tip", pose(75_000_000))
    answer = service.answer(now_ns=100_000_000)
    assert answer is not None and answer.converged and answer.stamp_ns == 75_000_000
    assert answer.published_ns == 100_000_000 and answer.force_N is not None
    assert answer.force_N[2] == pytest.approx(10 * (0.075 - 0.04))
    _, shaft, actuation = spring.asked[0]
    assert actuation.stamp_ns == 75_000_000 and actuation.curvature_per_m == 15.0
    assert shaft is not None and shaft.position_m[2] == 0.01
    assert service.answer(now_ns=101_000_000) is None


def test_a_newer_pose_takes_the_place_of_an_older_one() -> None:
    service = EstimationService(Spring())
    service.receive("stage", stage(0))
    service.receive("pose/tip", pose(0))
    service.receive("pose/tip", pose(25_000_000))
    answer = service.answer(30_000_000)
    assert answer is not None and answer.stamp_ns == 25_000_000 and service.answered == 1


def test_a_shaft_pose_of_another_time_is_not_paired() -> None:
    spring = Spring()
    service = EstimationService(spring)
    service.receive("stage", stage(0))
    service.receive("pose/shaft", pose(0))
    service.receive("pose/tip", pose(25_000_000))
    service.answer(25_000_000)
    assert spring.asked[0][1] is None


@pytest.mark.parametrize(
    "messages",
    [
        [("pose/tip", pose(0))],
        [("stage", stage(0, known=False)), ("pose/tip", pose(0))],
        [("stage", stage(0)), ("pose/tip", pose(0, missing=True))],
        [("stage", stage(0)), ("pose/tip", pose(2_000_000_000))],
        [("stage", stage(0)), ("pose/shaft", pose(0))],
    ],
)
def test_without_a_pose_and_its_actuation_nothing_is_said(messages: list[tuple[str, Stage | Pose]]) -> None:
    service = EstimationService(Spring())
    for topic, message in messages:
        service.receive(topic, message)
    assert service.answer(0) is None


@pytest.mark.parametrize(
    "answer",
    [
        ValueError("outside the model"),
        ZeroDivisionError("division by zero"),
        np.linalg.LinAlgError("singular"),
        TipForce(np.array([0.0, np.nan, 0.0]), np.eye(3), True, 0.0, 0),
        TipForce(np.zeros(3), np.full((3, 3), np.inf), True, 0.0, 0),
        TipForce(np.zeros(2), np.eye(3), True, 0.0, 0),
        TipForce(np.zeros(3), -np.eye(3), True, 0.0, 0),
        TipForce(np.zeros(3), np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), True, 0.0, 0),
        TipForce(np.zeros(3), np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), True, 0.0, 0),
        TipForce(np.zeros(3), np.eye(3), False, 7.0, 0),
    ],
)
def test_no_force_is_given_that_cannot_be_believed(answer: TipForce | Exception) -> None:
    service = EstimationService(Broken(answer))
    said = service(pose(0), None, stage(0))
    assert said is not None and not said.converged and said.force_N is None and said.covariance_N2 is None
    assert service.unanswered == 1 and service.answered == 0


def test_an_estimator_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match=r"'host\.nothing:make'"):
        load_estimator("host.nothing:make", load_rig(RIG))
    with pytest.raises(ValueError, match="wanted module:function"):
        load_estimator("", load_rig(RIG))


def own_rig(tmp_path: Path) -> Path:
    """The simulated rig with sockets of its own."""
    text = RIG.read_text()
    socket = f'["unixsock-stream/{tmp_path}/rig.sock"]'
    head, _, _ = text.partition("[zenoh]")
    (tmp_path / "rig.toml").write_text(f"{head}[zenoh]\nlisten = {socket}\nconnect = {socket}\n")
    return tmp_path / "rig.toml"


def start(rig: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "host.run.model_process",
            str(rig),
            "--estimator",
            "tests.host.test_estimator_process:make_spring",
            *options,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


def test_process_estimates_records_and_ends_in_order(tmp_path: Path) -> None:
    rig_path = own_rig(tmp_path)
    rig = load_rig(rig_path)
    child = start(rig_path, "--record", str(tmp_path / "a.mcap"), "--seed", "3")
    try:
        assert child.stdout is not None and json.loads(child.stdout.readline())["ready"] is True
        with Session(rig.name, [], rig.zenoh.connect) as session:
            poses, stages = session.publisher("pose/tip"), session.publisher("stage")
            forces, sensor = session.latest("force/estimate"), session.publisher("force/sensor")
            answers = []

            def answered() -> bool:
                now_ns = time.monotonic_ns()
                stages.put(stage(now_ns))
                poses.put(pose(now_ns))
                sensor.put(ForceSensor(stamp_ns=now_ns, arrival_ns=now_ns, force_N=(0.0, 0.0, 0.1)))
                if (answer := forces.take()) is not None:
                    answers.append(answer)
                return len(answers) == 20

            until(answered, "20 estimates")
        child.send_signal(signal.SIGTERM)
        assert child.wait(timeout=PATIENCE_S) == 0
    finally:
        child.kill()
        child.communicate()
    recording = RecordingFile(tmp_path / "a.mcap")
    assert not recording.truncated and recording.run["seed"] == "3"
    assert recording.catheter["name"] == "blazer_prime_xp" and recording.configuration["control"]["loop_hz"] == 1000
    assert {"stage", "pose/tip", "force/sensor", "force/estimate"} <= set(recording.topics)
    estimates = recording.table("force/estimate")
    assert estimates["converged"].all() and np.allclose(estimates["fz_N"], 0.1)
    assert (estimates["published_ns"] >= estimates["stamp_ns"]).all()


def test_process_refuses_what_it_cannot_start_with(tmp_path: Path) -> None:
    rig_path = own_rig(tmp_path)
    (tmp_path / "there.mcap").write_bytes(b"")
    for options, says in (
        (["--estimator", "no.such:thing"], "wanted module:function"),
        (["--record", str(tmp_path / "there.mcap")], "exists"),
    ):
        child = start(rig_path, *options)
        _, complaint = child.communicate(timeout=PATIENCE_S)
        assert child.returncode == 1 and says in complaint and "Traceback" not in complaint
