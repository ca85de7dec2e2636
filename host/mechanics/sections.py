"""From the rows a sweep leaves behind to poses in the base frame and their Jacobians."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.cosserat_kernels import (
    ALL_TANGENTS,
    BODY_1,
    BODY_LENGTH,
    EXACT,
    K0,
    ROW,
    SHAFT_LENGTH,
    WORK,
    sweep,
)
from host.mechanics.rotations import conjugate, quaternion_product, rotation_matrix

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def tip_pose(row: Array, position: Array, quaternion: Array) -> None:
    """Set position (3,), quaternion (4,) of the tip in the base frame, from the row (48,) at the base."""
    for i in range(3):
        position[i] = -row[i]
    quaternion[:] = conjugate(row[6:10])


@njit(cache=True, error_model="numpy", nogil=True)
def section_pose(base: Array, row: Array, inside_m: float, position: Array, quaternion: Array) -> None:
    """Set position (3,), quaternion (4,) of a section in the base frame, from the rows (48,) at the base and at the section.

    Argument: inside_m, how far inside the straight sheath the section is; its row is then the base's.
    """
    quaternion[:] = quaternion_product(conjugate(base[6:10]), row[6:10])
    R = rotation_matrix(quaternion)
    for i in range(3):
        position[i] = -base[i] + R[i, 0] * row[0] + R[i, 1] * row[1] + R[i, 2] * row[2]
    position[2] -= inside_m


def exposed(rod: Array, stations: Array) -> tuple[Array, NDArray[np.int64], Array]:
    """Stations cut off at the base and ascending, where each asked one is in that order, and how far inside it is."""
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    order = np.argsort(stations, kind="stable")
    place = np.empty(len(stations), dtype=np.int64)
    place[order] = np.arange(len(stations))
    return np.minimum(stations, total)[order], place, np.maximum(stations - total, 0.0)


def exact_rows(rod: Array, force: Array, stations: Array) -> Array:
    """Rows (n + 1, 48) with all tangents at the stations (n,), exposed and ascending, and at the base."""
    rows = np.zeros((len(stations) + 1, ROW))
    sweep(rod, force, stations, EXACT, ALL_TANGENTS, rows, np.zeros(WORK))
    return rows


def base_curvature(rod: Array, row: Array) -> tuple[Array, Array]:
    """Curvature (3,) 1/m and moment (3,) N m at the base, from the row (48,) there."""
    body = rod[BODY_LENGTH] > 0.0
    moment = np.cross(row[3:6], row[:3])
    compliance = rod[BODY_1 : BODY_1 + 3] if body else rod[:BODY_1]
    return compliance * moment + np.array([0.0 if body else rod[K0], 0.0, 0.0]), moment


def rigid_motion(position: Array, curvature: Array) -> Array:
    """Tip's motion (6, 2) by insertion and roll when the rod moves as a body; curvature (3,) that of the base."""
    e3 = np.array([0.0, 0.0, 1.0])
    return np.column_stack(
        [np.concatenate([e3 + np.cross(curvature, position), curvature]), np.concatenate([np.cross(e3, position), e3])]
    )


def jacobians_tip_frame(rod: Array, row: Array) -> tuple[Array, Array]:
    """Tip position and turn (6, 3) by the force in the tip frame, and (6, 3) by insertion, roll, curvature."""
    curvature, _ = base_curvature(rod, row)
    by_lanes = -np.vstack([row[12:24].reshape(3, 4), row[36:48].reshape(3, 4)])
    return by_lanes[:, :3], np.column_stack([rigid_motion(-row[:3], curvature), by_lanes[:, 3]])


def jacobians_base_frame(rod: Array, row: Array) -> tuple[Array, Array]:
    """The same with the force held in the base frame: n(base) is that force, and its tangents are those of n(base).

    More insertion or roll moves the rod as a body and, seen from the rod, turns the force the other way.
    """
    curvature, _ = base_curvature(rod, row)
    by_tip_force, actuation = jacobians_tip_frame(rod, row)
    G, force = row[24:36].reshape(3, 4), row[3:6]
    by_force = by_tip_force @ np.linalg.inv(G[:, :3])
    turned = np.column_stack([np.cross(force, curvature), np.cross(force, [0.0, 0.0, 1.0]), -G[:, 3]])
    return by_force, actuation + by_force @ turned
