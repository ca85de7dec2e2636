"""Is the covariance of the rig's force estimates true: errors and coverage of both estimators on simulated demos.

    python -m host.studies.benchmarks.force_coverage --seeds 101 102 103

The truth of the simulator is only compared with; the estimators receive messages of poses and stages, as on the rig.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.enums import Phase
from protocol.rig_file import Rig
from protocol.topics import Message, Pose, Stage
from sim.forked_board import forkable_board
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """Messages of one frame of the tracker, and the truth at its time: force on the tissue (N), joints, phase."""

    tip: Pose
    shaft: Pose | None
    stage: Stage
    force_N: Array
    joints: tuple[float, float, float]
    phase: int


def record(rig: Rig, seed: int, seconds: float, job: ContactJob | None = None, **plant: Any) -> list[Sample]:
    """Run the demo's job by the force sensor for `seconds` after contact; one sample for each frame of the tracker."""
    samples: list[Sample] = []
    truth: dict[int, tuple[Array, tuple[float, float, float], int]] = {}
    latest: dict[str, Message] = {}
    stages: dict[int, Stage] = {}

    def publish(topic: str, message: Message) -> None:
        latest[topic] = message
        if isinstance(message, Stage):
            stages[message.stamp_ns // 1_000_000] = message
        if topic == "pose/tip" and isinstance(message, Pose) and not message.missing:
            at = message.stamp_ns // 1_000_000
            near = min((k for k in range(at - 4, at + 5) if k in stages), key=lambda k: abs(k - at), default=None)
            if near is not None and at in truth:
                shaft = latest.get("pose/shaft")
                fresh = isinstance(shaft, Pose) and not shaft.missing and shaft.stamp_ns == message.stamp_ns
                samples.append(Sample(message, shaft if fresh else None, stages[near], *truth[at]))  # type: ignore[arg-type]

    world = World(rig, simulated_plant(rig, seed, **plant), forkable_board("native"), seed)
    run = Scenario(rig, world, publish)

    def watch() -> bool:
        true = world.plant.truth()
        joints = (true["insertion_m"], true["roll_rad"], true["curvature_per_m"])
        truth[run.now_ns // 1_000_000] = (true["contact_force_N"], joints, run.phase)
        return False

    job = job or ContactJob(target_m=TARGET_M)
    run.run(10.0, lambda: watch() or run.ready())
    run.command("arm")
    run.run(1.0, watch)
    free = np.array(job.target_m) - job.clearance_m * np.array(job.into)
    run.command("target", "position", target_m=tuple(map(float, free)))
    run.run(4.0, watch)
    run.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)
    run.run(job.approach_s, lambda: watch() or run.phase == Phase.CONTACT)
    run.run(seconds, watch)
    return samples
