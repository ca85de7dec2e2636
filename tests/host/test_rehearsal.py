"""What the processes of a rig compile at their start: whatever the rig does later, no more is compiled or loaded for it."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.rod_loads import PointLoad
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from protocol.catheter import load_catheter

ROOT = Path(__file__).parents[2]
INSERTION_m, CURVATURE_per_m, OFFSETS_m = 0.01, 15.0, (0.0, 0.02)
POSITION_STD_m, ANGLE_STD_rad = 0.29e-3, 0.0035
FRAMES = 30
# Phase, force on the tip, force on the body 30 mm behind it (N, base frame).
PARTS = (
    ("position", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ("contact", (0.0, 0.03, -0.1), (0.0, 0.0, 0.0)),
    ("contact", (0.0, 0.0, 0.0), (0.1, 0.15, 0.0)),
)


def frames() -> list[dict]:
    """A free catheter, one that is pressed, and one whose body touches, with the tracker's noise; 40 frames a second."""
    rng, out = np.random.default_rng(1), []
    for mode, tip_N, body_N in PARTS:
        loads = [PointLoad(0.03, np.array(body_N))] if any(body_N) else []
        found = solve_cosserat(
            load_catheter("blazer_prime_xp"),
            INSERTION_m,
            CURVATURE_per_m,
            np.array(tip_N),
            "base",
            stations_m=list(OFFSETS_m),
            point_loads=loads,
        )
        assert found.converged
        for _ in range(FRAMES):
            poses = []
            for position, quaternion in zip(found.station_positions_m, found.station_quaternions_wxyz, strict=True):
                turn = quaternion_of_vector(ANGLE_STD_rad * rng.standard_normal(3))
                noisy = position + POSITION_STD_m * rng.standard_normal(3)
                poses.append([*noisy, *quaternion_product(quaternion, turn)])
            out.append({"mode": mode, "poses": poses})
    return out


def loaded() -> dict[str, int]:
    """Return the compiled forms of each function that this process has compiled or loaded."""
    from numba.core.dispatcher import Dispatcher

    found = [item for item in gc.get_objects() if isinstance(item, Dispatcher)]
    return {f"{item.py_func.__module__}.{item.py_func.__name__}": len(item.overloads) for item in found if item.overloads}


def realtime_process() -> None:
    """In a process of its own: prepare the core, then press on the wall; print what of it was compiled after that."""
    from protocol.enums import Phase
    from protocol.rig_file import SIMULATED_RIG, load_rig
    from sim.forked_board import forkable_board
    from sim.scenario import TARGET_M, ContactJob, Scenario
    from sim.world import World, simulated_plant

    rig = load_rig(SIMULATED_RIG)
    run = Scenario(rig, World(rig, simulated_plant(rig, 1), forkable_board("native"), 1), lambda topic, message: None)
    run.run(0.1)
    run.loop.core.prepare()
    before, job = loaded(), ContactJob(TARGET_M)
    run.arm()
    run.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)
    run.run(5.0)
    more = {name for name, forms in loaded().items() if before.get(name) != forms and name.startswith("realtime.")}
    print(json.dumps({"phase": Phase(run.phase).label, "more": sorted(more)}))


def main(model: str) -> None:
    """In a process of its own: rehearse, then answer the frames of standard input; print what was compiled for them."""
    from host.estimation.interface import Actuation, PoseReading
    from host.estimation.service import DEFAULT_ESTIMATOR, load_estimator, rehearse
    from protocol.rig_file import SIMULATED_RIG, load_rig, parse_rig

    data = load_rig(SIMULATED_RIG).effective()
    rig = parse_rig({**data, "estimation": {**data["estimation"], "model": model}})
    rehearse(load_estimator(DEFAULT_ESTIMATOR, rig), rig)
    before, touched = loaded(), False
    estimator = load_estimator(DEFAULT_ESTIMATOR, rig)
    for number, frame in enumerate(json.loads(sys.stdin.read())):
        stamp_ns = 25_000_000 * (number + 1)
        tip, shaft = (PoseReading(np.array(pose[:3]), np.array(pose[3:]), stamp_ns) for pose in frame["poses"])
        into = np.array([0.0, 0.0, 1.0]) if frame["mode"] == "contact" else None
        answer = estimator.estimate(tip, shaft, Actuation(INSERTION_m, 0.0, CURVATURE_per_m, stamp_ns, into, frame["mode"]))
        touched |= answer.body_contact
    after = loaded()
    print(json.dumps({"touched": touched, "more": [name for name, forms in after.items() if before.get(name) != forms]}))


@pytest.mark.parametrize("model", ["spatial", "planar"])
def test_nothing_is_compiled_after_it(model: str) -> None:
    """A first start compiled for 20 s at its first pose and a minute at a touch of the body; its watchdog waits 10 s."""
    said = subprocess.run(
        [sys.executable, "-m", "tests.host.test_rehearsal", model],
        input=json.dumps(frames()),
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert said.returncode == 0, said.stderr
    assert json.loads(said.stdout) == {"touched": True, "more": []}


def test_no_command_waits_for_a_compilation() -> None:
    """The first target after a first start kept the readings from the loop for a second."""
    said = subprocess.run(
        [sys.executable, "-m", "tests.host.test_rehearsal"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert said.returncode == 0, said.stderr
    assert json.loads(said.stdout) == {"phase": "contact", "more": []}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        realtime_process()
