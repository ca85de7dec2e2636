"""What the catheter must not touch: spheres, capsules, meshes, a chamber to stay in. Distances by FCL, meshes by trimesh."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Distances beyond this count as equal (m).
FAR_M = 1.0


@dataclass(frozen=True)
class Sphere:
    """A solid sphere."""

    centre_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True)
class Capsule:
    """A solid capsule: all points within `radius_m` of the line between two points."""

    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True)
class Mesh:
    """A closed surface: a solid, or with `chamber` the wall of the space that the tip must not leave."""

    vertices_m: Array
    faces: NDArray[np.int64]
    chamber: bool = False


Obstacle = Sphere | Capsule | Mesh


def load_mesh(path: Path, scale: float, chamber: bool) -> Mesh:
    """The triangle mesh in `path` (STL, OBJ, PLY, OFF), lengths times `scale`. Raises ValueError: unreadable, not closed."""
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=True)
        closed = bool(mesh.is_watertight)
    except (OSError, ValueError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"obstacles.file: found {path}: {error}, wanted a triangle mesh (STL, OBJ, PLY, OFF)") from None
    if len(mesh.faces) == 0 or not closed or not np.all(np.isfinite(mesh.vertices)):
        raise ValueError(
            f"obstacles.file: found {path} with {len(mesh.faces)} triangles, closed: {closed}; wanted a closed mesh"
        )
    return Mesh(np.array(mesh.vertices, np.float64) * scale, np.array(mesh.faces, np.int64), chamber)


def winding_number(mesh: Mesh, point_m: Array) -> float:
    """Turns of the surface about the point: about 1 or -1 inside, 0 outside (sum of solid angles, Van Oosterom,
    Strackee).
    """
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] - point_m for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = (
        la * lb * lc + np.einsum("ij,ij->i", a, b) * lc + np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(np.sum(2.0 * np.arctan2(above, below)) / (4.0 * np.pi))


def _capsule_object(start: Array, end: Array, radius_m: float) -> fcl.CollisionObject:
    axis = end - start
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        return fcl.CollisionObject(fcl.Sphere(radius_m), fcl.Transform(start))
    return fcl.CollisionObject(fcl.Capsule(radius_m, length), fcl.Transform(_turn_to(axis / length), 0.5 * (start + end)))


def _turn_to(axis: Array) -> Array:
    """A rotation matrix (3, 3) whose third column is `axis` (unit)."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])


class Surroundings:
    """All obstacles together; computes the distance of a polyline with thickness from them."""

    def __init__(self, obstacles: list[Obstacle]) -> None:
        self.obstacles = obstacles
        self.questions = 0
        self._manager = fcl.DynamicAABBTreeCollisionManager()
        self._manager.registerObjects([self._object(item) for item in obstacles])
        self._manager.setup()

    @staticmethod
    def _object(item: Obstacle) -> fcl.CollisionObject:
        if isinstance(item, Sphere):
            return fcl.CollisionObject(fcl.Sphere(item.radius_m), fcl.Transform(np.array(item.centre_m)))
        if isinstance(item, Capsule):
            return _capsule_object(np.array(item.from_m), np.array(item.to_m), item.radius_m)
        model = fcl.BVHModel()
        model.beginModel(len(item.vertices_m), len(item.faces))
        model.addSubModel(item.vertices_m, item.faces)
        model.endModel()
        return fcl.CollisionObject(model, fcl.Transform())

    def clearance_m(self, line_m: Array, radius_m: float) -> float:
        """Least distance (m) of a tube of `radius_m` about the polyline (n, 3) from all obstacles; zero or less:
        touching.
        """
        self.questions += 1
        if not self.obstacles:
            return FAR_M
        least = FAR_M
        for start, end in itertools.pairwise(line_m):
            data = fcl.DistanceData(fcl.DistanceRequest())
            data.result.min_distance = least + radius_m
            self._manager.distance(_capsule_object(start, end, 1e-6), data, fcl.defaultDistanceCallback)
            least = min(least, data.result.min_distance - radius_m)
            if least <= 0.0:
                break
        return least

    def holds(self, point_m: Array) -> str:
        """Return why a point cannot be a goal (inside an obstacle, outside the chamber); empty if it can."""
        for number, item in enumerate(self.obstacles):
            if isinstance(item, Sphere):
                if np.linalg.norm(point_m - np.array(item.centre_m)) <= item.radius_m:
                    return f"inside obstacle {number} (sphere)"
            elif isinstance(item, Capsule):
                if _to_segment_m(point_m, np.array(item.from_m), np.array(item.to_m)) <= item.radius_m:
                    return f"inside obstacle {number} (capsule)"
            else:
                inside = abs(winding_number(item, point_m)) > 0.5
                if inside != item.chamber:
                    return f"{'inside' if inside else 'outside'} {'obstacle' if inside else 'chamber'} {number} (mesh)"
        return ""


def _to_segment_m(point: Array, start: Array, end: Array) -> float:
    axis = end - start
    square = float(axis @ axis)
    share = 0.0 if square < 1e-18 else min(max(float((point - start) @ axis) / square, 0.0), 1.0)
    return float(np.linalg.norm(point - start - share * axis))


def to_line_m(point: Array, line: Array) -> float:
    """Least distance (m) of a point (3,) from a polyline (n, 3)."""
    least = math.inf
    for start, end in itertools.pairwise(line):
        least = min(least, _to_segment_m(point, start, end))
    return least
