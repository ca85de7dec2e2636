"""Inverse kinematics to compare with, planar: the Jacobian's inverse (7.3) and damped least squares, as rate laws.

Plane of bending: x along the axis, y across. Joints: curvature (1/m) and body insertion (m).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from realtime.control.inverse_kinematics import bend_of_reach

Array = NDArray[np.float64]
Step = Callable[[Array, Array, Array], Array]


def tip(joint: Array, length_m: float) -> Array:
    """Tip (2,) of curvature and insertion; (7.1), (7.2), smooth through straight."""
    bend = float(joint[0]) * length_m
    return np.array([length_m * np.sinc(bend / np.pi) + joint[1], length_m * 0.5 * bend * np.sinc(bend / (2 * np.pi)) ** 2])


def jacobian(joint: Array, length_m: float) -> Array:
    """d tip / d (curvature, insertion) (2, 2); (7.3), with series near straight."""
    bend = float(joint[0]) * length_m
    if abs(bend) < 1e-3:
        along, across = -bend / 3.0, 0.5 - bend**2 / 8.0
    else:
        along = (bend * math.cos(bend) - math.sin(bend)) / bend**2
        across = (math.cos(bend) - 1.0 + bend * math.sin(bend)) / bend**2
    return np.array([[length_m**2 * along, 1.0], [length_m**2 * across, 0.0]])


def jacobian_inverse_step(length_m: float) -> Step:
    """(joint, tip, goal) -> joint step by the inverse of (7.3): grows without bound at the fold, where the tip is furthest
    off."""

    def step(joint: Array, measured: Array, goal: Array) -> Array:
        J = jacobian(joint, length_m)
        if abs(J[1, 0]) < 1e-12:
            return np.zeros(2)
        return np.asarray(np.linalg.solve(J, goal - measured), np.float64)

    return step


def damped_step(length_m: float, damping: float = 0.02) -> Step:
    """Damped least squares, J^T (J J^T + damping^2)^-1, on joints scaled by the length (bend in rad, insertion / length)."""
    scale = np.array([1.0 / length_m, length_m])

    def step(joint: Array, measured: Array, goal: Array) -> Array:
        J = jacobian(joint, length_m) * scale / length_m
        return scale * (J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(2), (goal - measured) / length_m))

    return step


def fitted_curve_step(length_m: float) -> Step:
    """The difference of two calls of the inverse kinematics (Fig. 6.12), for the goal and for the tip as measured."""

    def inverse(place: Array, last_bend: float) -> Array:
        ratio = abs(place[1]) / length_m
        bends = (bend_of_reach(ratio, False), bend_of_reach(ratio, True))
        bend = min(bends, key=lambda b: abs(b - abs(last_bend)))
        return np.array([math.copysign(bend, place[1]) / length_m, place[0] - length_m * np.sinc(bend / np.pi)])

    def step(joint: Array, measured: Array, goal: Array) -> Array:
        return inverse(goal, joint[0] * length_m) - inverse(measured, joint[0] * length_m)

    return step


class Path(NamedTuple):
    """A controlled motion: tip (n, 2) m, joints (n, 2); `largest_step` of the curvature in one iteration (1/m)."""

    tip_m: Array
    joint: Array

    @property
    def largest_step_per_m(self) -> float:
        """Greatest change of curvature in one iteration (1/m)."""
        return float(np.max(np.abs(np.diff(self.joint[:, 0])), initial=0.0))

    @property
    def jitter_m(self) -> float:
        """RMS second difference of the tip's path (m): zero for a smooth one."""
        return float(np.sqrt(np.mean(np.sum(np.diff(self.tip_m, 2, axis=0) ** 2, axis=1))))


def run(
    step: Step,
    start: Array,
    goals: Array,
    length_m: float,
    gain: float,
    noise_m: float,
    seed: int,
    limit_per_m: float = 60.0,
) -> Path:
    """Track `goals` (n, 2) by joint += gain * step; the tip measured with noise, the curvature limited. Fig. 7.8's
    setting."""
    random = np.random.default_rng(seed)
    joint, joints, tips = np.array(start, float), [], []
    for goal in goals:
        measured = tip(joint, length_m) + noise_m * random.standard_normal(2)
        joint = joint + gain * step(joint, measured, goal)
        joint[0] = min(max(joint[0], -limit_per_m), limit_per_m)
        joints.append(joint.copy())
        tips.append(tip(joint, length_m))
    return Path(np.array(tips), np.array(joints))
