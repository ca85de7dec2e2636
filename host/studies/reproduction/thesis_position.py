"""The thesis' position controller (Fig. 6.12) on the simulated catheter: three integral controllers, a tracker frame
each."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.rig_file import Rig
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

Array = NDArray[np.float64]
_FREE = TissueConfig(point_m=(0.0, 0.0, 10.0))
_PLANT_STEP_S = 0.005
# A reversal of the commanded body by less than this does not turn the compensator (m).
_REVERSAL_M = 5e-5


@dataclass(frozen=True)
class IntegralGains:
    """Per iteration, as printed (6.4.3): insertion, roll, knob."""

    K_Ia: float = 0.0075
    K_It: float = 0.05
    K_Ik: float = 0.005


class Navigation(NamedTuple):
    """A row a tracker frame: time (s), true tip (m), stages (m, rad, rad), and the goal (3,) m."""

    time_s: Array
    tip_m: Array
    stage: Array
    goal_m: Array

    @property
    def error_m(self) -> Array:
        """Distance of the tip from the goal (n,)."""
        return np.linalg.norm(self.tip_m - self.goal_m, axis=1)


def unloaded_tip(joint: Array, curvature_per_m: float, length_m: float) -> Array:
    """Tip (3,) m of body insertion (m), roll (rad) and curvature (1/m), nothing touched; (7.1), (7.2) in space."""
    out_m = min(length_m, length_m + joint[0])
    bend = curvature_per_m * out_m
    across = out_m * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2
    along = max(joint[0], 0.0) + out_m * np.sinc(bend / np.pi)
    return np.array([across * np.sin(joint[1]), -across * np.cos(joint[1]), along])


def navigate(
    rig: Rig, start: Array, goal_m: Array, seconds: float, gains: IntegralGains | None = None, seed: int = 1
) -> Navigation:
    """Drive the tip from joints `start` (3,) (body m, roll rad, knob rad) to `goal_m` (3,) with noise and delay of `rig`."""
    gains = gains or IntegralGains()
    transmission, tracker = rig.transmission, rig.tracker
    config = tick_parameters(rig)[0].kinematics
    # On the rig the printed knob and insertion gains act at one iteration of the thesis' loop, taken as a tracker frame.
    per_frame = np.array([gains.K_Ia, gains.K_It, gains.K_Ik])
    joint, direction = np.array(start, float), 1.0

    def stages() -> Array:
        handle = (joint[0] - transmission.insertion_at_home_m) / transmission.insertion_slope
        return np.array(
            [handle + 0.5 * direction * transmission.insertion_backlash_m, joint[1] / transmission.roll_slope, joint[2]]
        )

    first = stages()
    plant = Plant(PlantConfig(start_stage=tuple(first), vessel=VesselConfig(start_in_play=1.0), tissue=_FREE), seed)
    random, measured, wanted = np.random.default_rng(seed), np.zeros(3), np.zeros(3)
    late: deque[Array] = deque()
    rows, extreme = [], joint[0]
    frame_s = 1.0 / tracker.rate_hz
    for k in range(round(seconds / frame_s)):
        late.append(plant.sensor_pose(0.0)[0] + tracker.position_noise_m * random.standard_normal(3))
        seen = late.popleft() if len(late) > 1 else late[0]
        measured[:] = inverse_kinematics.apply_nearest(config, seen, joint)
        wanted[:] = inverse_kinematics.apply_nearest(config, goal_m, joint)
        before = stages()
        joint += per_frame * (wanted - measured)
        if direction * (joint[0] - extreme) >= 0.0:
            extreme = joint[0]
        elif abs(joint[0] - extreme) > _REVERSAL_M:
            direction, extreme = -direction, joint[0]
        after = stages()
        parts = round(frame_s / _PLANT_STEP_S)
        for part in range(parts):
            plant.step(_PLANT_STEP_S, before + (after - before) * (part + 1) / parts)
        rows.append([(k + 1) * frame_s, *plant.sensor_pose(0.0)[0], *after])
    table = np.array(rows)
    return Navigation(table[:, 0], table[:, 1:4], table[:, 4:7], np.asarray(goal_m, float))


def faster(gains: IntegralGains, insertion: float) -> IntegralGains:
    """The same with the insertion's gain times `insertion`."""
    return replace(gains, K_Ia=gains.K_Ia * insertion)
