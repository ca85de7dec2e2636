"""A wall that is tilted out of the bending plane: the force across turns the tip, the law turns it back."""

import numpy as np
import pytest

from host.studies.control.pose_only_study import tilted_wall
from host.studies.control.runs import REGULAR, STILL, _scenario, hold
from protocol.enums import Phase
from protocol.rig_file import SIMULATED_RIG, load_rig


@pytest.mark.slow
def test_the_force_is_reached_at_the_target_on_a_wall_tilted_by_30_degrees() -> None:
    job, wall = tilted_wall(30.0)
    run = _scenario(load_rig(SIMULATED_RIG), 5, heart=STILL, tissue=wall)
    assert run.arm()
    run.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)
    assert run.run(job.approach_s, lambda: run.phase == Phase.CONTACT)
    run.run(7.0)
    plant = run.world.plant
    assert plant.contact_force_N @ job.into == pytest.approx(job.force_N, abs=0.01)
    along = np.cross(job.into, (0.0, 1.0, 0.0))
    off_m = plant.sensor_pose(0.0)[0] - job.target_m
    assert abs(off_m @ along) < 1.5e-3 and abs(off_m[1]) < 1.5e-3


@pytest.mark.slow
def test_the_contact_is_kept_by_poses_alone_on_a_beating_wall_tilted_by_30_degrees() -> None:
    """With the compliance of the rig file alone this run swung, the swing was taken for the heart, and the wall was lost."""
    job, wall = tilted_wall(30.0)
    held = hold(load_rig(SIMULATED_RIG), 8801, REGULAR, 14.0, "estimate", job, tissue=wall)
    assert held.kept() == 1.0
    assert held.mean_N() == pytest.approx(0.2, abs=0.02) and held.rms_N(0.2) < 0.025
