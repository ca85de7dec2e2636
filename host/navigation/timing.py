"""Time along a path of the stages: as fast as their speed and acceleration allow (TOPP-RA, package toppra)."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import toppra
from numpy.typing import NDArray
from toppra import algorithm, constraint

from protocol.rig_file import Rig

Array = NDArray[np.float64]
logging.getLogger("toppra").setLevel(logging.ERROR)
# Share of the stages' limits that a plan uses; the remainder is for feedback.
SPEED_SHARE, ACCELERATION_SHARE = 0.8, 0.5


class Timed(NamedTuple):
    """Stages (n, 3) over time (n,), at rest at both ends."""

    time_s: Array
    stage: Array
    speed: Array
    acceleration: Array


def fastest(waypoints: Array, rig: Rig, period_s: float) -> Timed:
    """Time-optimal motion along a cubic spline through `waypoints` (n, 3) of the stages, a row every `period_s`.

    Raises ValueError where no motion within the limits follows it.
    """
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints * _scale(rig), axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(distance) > 1e-9])
    waypoints, distance = waypoints[keep], distance[keep]
    if len(waypoints) < 2:
        rest = waypoints[:1]
        return Timed(np.zeros(1), rest, np.zeros((1, 3)), np.zeros((1, 3)))
    path = toppra.SplineInterpolator(distance / distance[-1], waypoints, bc_type="natural")
    speed = np.array([rig.stage(axis).max_speed_unit_per_s for axis in range(3)]) * SPEED_SHARE
    push = np.array([rig.stage(axis).max_accel_unit_per_s2 for axis in range(3)]) * ACCELERATION_SHARE
    limits = [
        constraint.JointVelocityConstraint(np.column_stack([-speed, speed])),
        constraint.JointAccelerationConstraint(np.column_stack([-push, push])),
    ]
    grid = np.linspace(0.0, 1.0, max(100, 6 * len(waypoints)))
    trajectory = algorithm.TOPPRA(limits, path, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0.0, 0.0)
    if trajectory is None:
        raise ValueError("path: found no motion along it within the stages' limits, wanted a smoother path")
    count = max(2, int(np.ceil(trajectory.duration / period_s)) + 1)
    time_s = np.linspace(0.0, trajectory.duration, count)
    return Timed(time_s, trajectory(time_s), trajectory(time_s, 1), trajectory(time_s, 2))


def _scale(rig: Rig) -> Array:
    """Return the stage motion as seconds at full speed, so that every axis has weight."""
    return 1.0 / np.array([rig.stage(axis).max_speed_unit_per_s for axis in range(3)])
