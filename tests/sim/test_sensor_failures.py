"""A failure of each sensor in each phase of the job: what the loop does, what force it comes to, and how it recovers."""

from collections import deque

import numpy as np
import pytest

from protocol.enums import ForceSource, Phase
from protocol.rig_file import load_rig
from protocol.topics import ForceEstimate, Message
from realtime.control import safety
from sim.forked_board import forkable_board
from sim.plant import Plant, PlantConfig
from sim.scenario import ContactJob, Scenario
from sim.sensor_faults import SensorFault
from sim.world import World
from tests.realtime.conftest import RIG_FILE

JOB = ContactJob(target_m=(0.0, -0.0107, 0.025))
PHASES = ("approach", "contact", "hold", "retract")
# A catheter that stands still in the beating wall is pressed by up to 0.14 N more than before.
PEAK_N = 0.45


class Job:
    """The job up to the beginning of a phase; `modelled` gives the loop estimates like those of the model process."""

    def __init__(self, phase: str, modelled: bool = False) -> None:
        rig = load_rig(RIG_FILE)
        plant = Plant(PlantConfig(tool_offsets_m=(0.0, rig.tracker.shaft_sensor_offset_m)), 1)
        self.world = World(rig, plant, forkable_board("native"), 1)
        self._rng, self._past = np.random.default_rng(3), deque[tuple[int, float]](maxlen=100)
        self.run = Scenario(rig, self.world, lambda topic, message: None, estimator=self._estimate if modelled else None)
        self.force_N: list[float] = []
        self.causes: set[str] = set()
        assert self.run.arm()
        self.run._shape(JOB)
        self.run.command("target", "contact", target_m=JOB.target_m, normal=JOB.into, force_N=JOB.force_N)
        self.go(0.1)
        if phase != "approach":
            assert self.run.run(10.0, lambda: self._watch() or self.run.phase == Phase.CONTACT)
            self.go(0.3 if phase == "contact" else 3.0)
        if phase == "retract":
            self.run.command("target", "retract")
            self.go(0.05)
        self.causes.clear()

    def _watch(self) -> bool:
        force_N = float(self.world.plant.contact_force_N[2])
        self.force_N.append(force_N)
        self._past.append((self.world.now_ns, force_N))
        self.causes.update(safety.names(int(self.run.loop.outputs[0].cause)))
        return False

    def go(self, seconds: float) -> np.ndarray:
        """So many seconds; the true force (n,) of them."""
        begin = len(self.force_N)
        self.run.run(seconds, self._watch)
        return np.array(self.force_N[begin:])

    def _estimate(self, tip: Message, shaft: Message | None, stage: Message, *_: object) -> ForceEstimate | None:
        """The force at the time of the pose, 15 mN off and 20 mN noisy."""
        near = [force for stamp_ns, force in self._past if abs(stamp_ns - tip.stamp_ns) <= 1_000_000]
        if not near:
            return None
        force_N = (0.0, 0.0, near[0] + 0.015 + 0.02 * float(self._rng.standard_normal()))
        return ForceEstimate(
            stamp_ns=tip.stamp_ns,
            frame="base",
            converged=True,
            published_ns=tip.stamp_ns,
            force_N=force_N,
            covariance_N2=tuple(np.diag([4e-4] * 3).ravel()),
            residual=0.0,
            compute_us=100.0,
        )

    def fail(self, sensor: str, kind: str, seconds: float) -> None:
        """From now on, for `seconds`."""
        box = self.world.force_box if sensor == "force" else self.world.tracker
        box.faults.append(SensorFault(kind, self.world.now_ns, self.world.now_ns + round(seconds * 1e9)))

    @property
    def phase(self) -> int:
        return self.run.phase

    @property
    def source(self) -> int:
        return int(self.run.loop.outputs[0].force_source)


@pytest.mark.parametrize("phase", PHASES)
def test_without_poses_it_holds_then_leaves_the_wall_and_stops(phase: str) -> None:
    job = Job(phase)
    job.fail("tracker", "silent", 4.0)
    before_N = job.go(0.3)
    assert {"pose_stale", "pose_lost"} <= job.causes
    assert job.phase == Phase.STOPPED or (job.phase == Phase.RETRACT and phase != "approach")
    leaving_N = job.go(1.2)
    assert job.phase == Phase.STOPPED
    steps = job.world.steps.copy()
    force_N = job.go(1.0)
    assert np.array_equal(job.world.steps, steps), "stages moved after the stop"
    assert np.max([*before_N, *leaving_N]) < PEAK_N and np.max(force_N) == 0.0


@pytest.mark.parametrize("phase", PHASES)
def test_without_force_it_holds_then_retracts(phase: str) -> None:
    job = Job(phase)
    job.fail("force", "silent", 3.0)
    force_N = job.go(1.2)
    assert job.phase == Phase.STOPPED and np.max(force_N) < PEAK_N
    assert force_N[-1] == 0.0, "it must have let go of the wall"
    if phase != "retract":
        assert {"force_stale", "force_lost"} <= job.causes


@pytest.mark.parametrize("kind", ["silent", "frozen"])
def test_in_contact_the_estimate_takes_over_and_hands_back_without_a_bump(kind: str) -> None:
    job = Job("hold", modelled=True)
    before = job.go(1.0)
    job.fail("force", kind, 2.0)
    during = job.go(2.0)
    assert job.phase == Phase.CONTACT and job.source == ForceSource.ESTIMATE
    assert job.causes == {"force_handover"}
    after = job.go(3.0)
    assert job.phase == Phase.CONTACT and job.source == ForceSource.SENSOR
    assert np.min([*during, *after]) > 0.0 and np.max([*during, *after]) < JOB.force_N + 0.08
    assert abs(np.mean(during) - np.mean(before)) < 0.03
    every_50_ms = np.concatenate([before, during, after])[::50]
    assert np.max(np.abs(np.diff(every_50_ms))) < 0.05
    assert np.sqrt(np.mean((after[2000:] - JOB.force_N) ** 2)) < 0.01


def test_before_any_contact_there_is_nothing_to_hand_over_to() -> None:
    job = Job("approach", modelled=True)
    job.fail("force", "silent", 3.0)
    job.go(1.2)
    assert job.phase == Phase.STOPPED and "force_handover" not in job.causes


@pytest.mark.parametrize("phase", ["approach", "hold"])
def test_a_short_gap_in_the_poses_is_bridged(phase: str) -> None:
    job = Job(phase)
    job.fail("tracker", "missing", 0.045)
    job.go(0.5)
    assert "pose_lost" not in job.causes
    assert job.phase in (Phase.APPROACH, Phase.CONTACT)


def test_wild_poses_are_told_and_not_followed() -> None:
    job = Job("hold")
    box = job.world.tracker
    box.faults.append(SensorFault("wild", job.world.now_ns, job.world.now_ns + 60_000_000, value=0.1))
    force_N = job.go(0.6)
    assert "pose_rejected" in job.causes and job.phase in (Phase.CONTACT, Phase.RETRACT)
    assert np.max(np.abs(force_N - JOB.force_N)) < 0.2
