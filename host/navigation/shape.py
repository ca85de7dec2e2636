"""The unloaded catheter for planning: centre line of a joint, joints of a tip, limits of the rig's stages.

Joints: body insertion (m), roll (rad), curvature (1/m) of the distal shaft.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.rig_file import Rig
from realtime.control import inverse_kinematics as ik
from realtime.control.configure import tick_parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reach:
    """Limits of the rig's catheter and stages. `low`, `high` (3,): joint limits; `scale_m` (3,): tip motion per joint."""

    length_m: float
    radius_m: float
    low: Array
    high: Array
    scale_m: Array


def reach_of(rig: Rig, diameter_m: float) -> Reach:
    """Return the joint limits from the stages' travel through the transmission; those of the knob from its curve."""
    t, length = rig.transmission, rig.catheter.distal_length_m
    play = 0.5 * t.insertion_backlash_m
    stage = rig.stages.insertion
    low_m = (stage.min_unit + play) * t.insertion_slope + t.insertion_at_home_m
    high_m = (stage.max_unit - play) * t.insertion_slope + t.insertion_at_home_m
    bend = rig.catheter.max_curvature_per_m
    low = np.array([max(low_m, 0.006 - length), rig.stages.roll.min_unit * t.roll_slope, -bend])
    high = np.array([high_m, rig.stages.roll.max_unit * t.roll_slope, bend])
    return Reach(length, 0.5 * diameter_m, low, high, np.array([1.0, 0.4 * length, 0.25 * length**2]))


def centre_line(reach: Reach, joint: Array, points: int) -> Array:
    """`points` positions (points, 3) m from the sheath's exit to the tip, evenly spaced; positive curvature bends to -e2."""
    body, roll, curvature = (float(value) for value in joint)
    bending = min(reach.length_m, reach.length_m + body)
    straight = max(body, 0.0)
    s = np.linspace(0.0, straight + bending, points)
    arc = np.maximum(s - straight, 0.0)
    bend = curvature * arc
    across = arc * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2
    along = np.minimum(s, straight) + arc * np.sinc(bend / np.pi)
    return np.column_stack([across * math.sin(roll), -across * math.cos(roll), along])


def tip(reach: Reach, joint: Array) -> Array:
    """Return the position (3,) m of the tip."""
    return centre_line(reach, joint, 2)[-1]


def joints_of(reach: Reach, rig: Rig, goal_m: Array) -> list[Array]:
    """Return all joints within the limits whose unloaded tip is at `goal_m` (3,): both rolls, both sides of the fold."""
    config = tick_parameters(rig)[0].kinematics
    across, along = math.hypot(goal_m[0], goal_m[1]), float(goal_m[2])
    turn = math.atan2(goal_m[0], -goal_m[1])
    bends = [ik.bend_and_insertion(config, across, along)]
    bend = ik.bend_of_reach(across / reach.length_m, True)
    bends.append((bend / reach.length_m, along - reach.length_m * float(np.sinc(bend / np.pi))))
    found = []
    for curvature, body in bends:
        for side in (1.0, -1.0):
            for wraps in (-1, 0, 1):
                joint = np.array([body, turn + (0.0 if side > 0 else math.pi) + 2 * math.pi * wraps, side * curvature])
                if within(reach, joint) and np.linalg.norm(tip(reach, joint) - goal_m) < 1e-5:
                    found.append(joint)
    return found


def within(reach: Reach, joint: Array) -> bool:
    """Whether `joint` is within the limits."""
    return bool(np.all(joint >= reach.low) and np.all(joint <= reach.high))


def stages_of(rig: Rig, joint: Array) -> Array:
    """Stage positions (n, 3) (m, rad, rad) of joints (n, 3), in the middle of the backlash (control chooses the flank)."""
    t = rig.transmission
    config = tick_parameters(rig)[0].kinematics
    knob = np.array([ik.knob_of_curvature(config, value) for value in joint[:, 2]])
    return np.column_stack([(joint[:, 0] - t.insertion_at_home_m) / t.insertion_slope, joint[:, 1] / t.roll_slope, knob])
