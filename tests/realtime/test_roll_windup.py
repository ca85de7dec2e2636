"""Windup of the roll: learned from the tip's azimuth in contact, bounded, unlearned when the tip is free."""

import math

import numpy as np
import pytest

from protocol.rig_file import SIMULATED_RIG, load_rig
from realtime.control import free_tip, roll_windup, target_predictor, wall_observer
from realtime.control.configure import tick_parameters
from realtime.control.records import POSE, STATE, new

JOINT = (-0.075, 0.2, 0.8)  # 11 mm from the axis
MEMORY_S = 1.0


class Tip:
    """A tip that is turned by `turned_rad` further than the handle says, seen each 25 ms with noise."""

    def __init__(self, noise_m: float = 0.0) -> None:
        self.kinematics = tick_parameters(load_rig(SIMULATED_RIG))[0].kinematics
        self.state, self.pose = new(STATE)[0].windup, new(POSE)[0]
        self.noise_m, self.rng = noise_m, np.random.default_rng(3)

    def run(self, seconds: float, turned_rad: float, touching: bool = True, free: bool = False) -> float:
        """Return the roll that the last pose shows."""
        shown_rad = math.nan
        place = free_tip.apply(self.kinematics, (JOINT[0], JOINT[1] + turned_rad, JOINT[2]))
        for _ in range(round(seconds / 0.025)):
            self.pose.stamp_ns += 25_000_000
            self.pose.position_m[:] = np.array(place) + self.noise_m * self.rng.standard_normal(3)
            shown_rad = roll_windup.apply(
                self.kinematics,
                self.state,
                JOINT[1] + self.state.windup_rad,
                self.pose,
                np.zeros(3),
                touching,
                free,
                MEMORY_S,
            )
        return shown_rad


@pytest.mark.parametrize("turned_rad", [-1.2, -0.3, 0.4, 0.9])
def test_what_turns_the_tip_in_contact_is_learned(turned_rad: float) -> None:
    tip = Tip()
    assert tip.run(8.0, turned_rad) == pytest.approx(JOINT[1] + turned_rad, abs=1e-3)
    assert tip.state.windup_rad == pytest.approx(turned_rad, abs=1e-3)


def test_noise_of_the_tracker_turns_the_roll_by_a_tenth_of_a_millimetre_at_most() -> None:
    tip, learned = Tip(noise_m=0.29e-3), []
    for _ in range(200):
        tip.run(0.1, 0.0)
        learned.append(tip.state.windup_rad)
    assert 0.011 * np.std(learned) < 1e-4


def test_the_windup_is_bounded() -> None:
    tip = Tip()
    for step in range(1, 30):
        tip.run(2.0, 0.1 * step)
    assert tip.state.windup_rad == pytest.approx(2.0)


def test_a_free_tip_unwinds_and_a_retracting_one_keeps_its_roll() -> None:
    tip = Tip()
    tip.run(8.0, 0.9)
    tip.run(1.0, 0.0, touching=False)
    assert tip.state.windup_rad == pytest.approx(0.9, abs=1e-3)
    tip.run(4.0, 0.0, touching=False, free=True)
    assert abs(tip.state.windup_rad) < 1e-3


def test_a_shaft_that_winds_up_is_softer_along_a_tilted_wall_by_its_lever_squared() -> None:
    """0.1 N across at 11 mm winds a shaft of 600 rad/Nm up by 0.66 rad; both are averaged over the same time."""
    tip, normal = Tip(), (math.sin(math.radians(30.0)), 0.0, -math.cos(math.radians(30.0)))
    free_m = np.array(free_tip.apply(tip.kinematics, JOINT))
    on_tissue_N = np.array([-0.1, 0.0, 0.17])
    wound_rad = 600.0 * (free_m[1] * on_tissue_N[0] - free_m[0] * on_tissue_N[1])
    assert abs(wound_rad) > 0.5
    for _ in range(40):
        tip.run(0.025, wound_rad)
        roll_windup.take_force(tip.state, free_m, on_tissue_N, 0.025, MEMORY_S)
    assert abs(tip.state.windup_rad) < 0.7 * abs(wound_rad)  # not learned yet, but the ratio is right
    lever_m = free_m[0] * normal[1] - free_m[1] * normal[0]
    assert roll_windup.softer_m_per_N(tip.state, free_m, normal) == pytest.approx(600.0 * lever_m**2, rel=0.03)
    assert roll_windup.softer_m_per_N(tip.state, free_m, (0.0, 0.0, -1.0)) == 0.0
    tip.run(5.0, 0.0, touching=False, free=True)
    assert roll_windup.softer_m_per_N(tip.state, free_m, normal) == 0.0


def test_another_compliance_does_not_move_the_free_tip() -> None:
    """Wall + compliance * force is where the free tip is, whatever the compliance."""
    params, wall = tick_parameters(load_rig(SIMULATED_RIG))[0].wall, new(STATE)[0].wall
    wall_observer.forget(params, wall)
    target_predictor.start(params.by_estimate, wall.force, 10**9, 0.020)
    wall_observer.soften(wall, 0.030, 0.2)
    assert wall.compliance_m_per_N == 0.030
    tip_m = target_predictor.at(wall.force, 10**9) + 0.030 * 0.2
    assert tip_m == pytest.approx(0.020 + params.compliance_m_per_N * 0.2)
    assert wall_observer.force_at(wall, tip_m, 10**9) == pytest.approx(0.2)
