"""A plan from request to answer: checks, path, time, and a last look at the whole way."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from host.navigation import planner, shape, timing
from host.navigation.obstacles import Capsule, Mesh, Obstacle, Sphere, Surroundings, load_mesh, to_line_m
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.requests import Request, read_json, validate
from protocol.rig_file import Rig
from realtime.control import inverse_kinematics as ik
from realtime.control.configure import tick_parameters

Array = NDArray[np.float64]
Point = tuple[float, float, float]
LINE_POINTS = 16
# Spacing of the way's points (m of tip, about) before time is laid over it.
SPACING_M = 0.003


class SphereRequest(Request):
    """A solid sphere."""

    type: Literal["sphere"]
    centre_m: Point
    radius_m: Annotated[float, Field(gt=0)]


class CapsuleRequest(Request):
    """A solid capsule."""

    type: Literal["capsule"]
    from_m: Point
    to_m: Point
    radius_m: Annotated[float, Field(gt=0)]


class MeshRequest(Request):
    """A closed triangle mesh: a solid, or with role chamber the room to stay in. Lengths in the file times `scale` are m."""

    type: Literal["mesh"]
    file: str
    scale: Annotated[float, Field(gt=0)] = 1.0
    role: Literal["obstacle", "chamber"] = "obstacle"


class PunctureRequest(Request):
    """The transseptal hole: the catheter passes within `radius_m` of `point_m` (2.19)."""

    point_m: Point
    radius_m: Annotated[float, Field(gt=0)]


class JointRequest(Request):
    """Where the catheter is."""

    insertion_m: float
    roll_rad: float
    curvature_per_m: float


AnyObstacle = Annotated[SphereRequest | CapsuleRequest | MeshRequest, Field(discriminator="type")]


class PlanRequest(Request):
    """What `seldinger plan` reads."""

    goal_m: Point
    start: JointRequest
    obstacles: list[AnyObstacle] = Field(default_factory=list)
    puncture: PunctureRequest | None = None
    clearance_m: Annotated[float, Field(ge=0, le=0.05)] = 0.001
    seed: int = 1
    samples: Annotated[int, Field(ge=10, le=1_000_000)] = 20_000
    period_s: Annotated[float, Field(gt=0, le=1)] = 0.02


class PlanAnswer(NamedTuple):
    """A plan: one row for each period, at rest at both ends.

    `clearance_m` is the smallest on the path, measured from the catheter's surface.
    """

    time_s: Array
    stage: Array
    joint: Array
    tip_m: Array
    clearance_m: float
    checks: int
    waypoints: int

    def as_json(self) -> dict[str, Any]:
        """Return the plan as JSON: samples by column name, SI units."""
        return {
            "found": True,
            "duration_s": float(self.time_s[-1]),
            "clearance_m": self.clearance_m,
            "waypoints": self.waypoints,
            "collision_checks": self.checks,
            "time_s": self.time_s,
            "stage": {"insertion_m": self.stage[:, 0], "roll_rad": self.stage[:, 1], "knob_rad": self.stage[:, 2]},
            "joint": {"insertion_m": self.joint[:, 0], "roll_rad": self.joint[:, 1], "curvature_per_m": self.joint[:, 2]},
            "tip_m": self.tip_m,
        }


class _World:
    """Return whether this joint is free of collisions; the planner calls it."""

    def __init__(self, request: PlanRequest, rig: Rig, folder: Path) -> None:
        self.reach = shape.reach_of(rig, load_catheter(rig.catheter.name).diameter_m)
        self.surroundings = Surroundings([_obstacle(item, folder) for item in request.obstacles])
        self.puncture, self.clearance_m = request.puncture, request.clearance_m

    def clearance(self, joint: Array) -> float:
        return self.surroundings.clearance_m(shape.centre_line(self.reach, joint, LINE_POINTS), self.reach.radius_m)

    def refused(self, joint: Array) -> str:
        """Why `joint` is not free, "" if it is."""
        if not shape.within(self.reach, joint):
            return "out of the stages' travel"
        if self.puncture is not None:
            off_m = to_line_m(np.array(self.puncture.point_m), shape.centre_line(self.reach, joint, 3 * LINE_POINTS))
            if off_m > self.puncture.radius_m:
                return f"a catheter that passes the puncture {off_m * 1e3:.1f} mm off"
        clear_m = self.clearance(joint)
        if clear_m < self.clearance_m:
            return f"a clearance of {clear_m * 1e3:.1f} mm" if clear_m > 0 else "a catheter in an obstacle"
        return ""

    def free(self, scaled: Array) -> bool:
        return not self.refused(scaled / self.reach.scale_m)


def _obstacle(item: Any, folder: Path) -> Obstacle:
    if isinstance(item, SphereRequest):
        return Sphere(item.centre_m, item.radius_m)
    if isinstance(item, CapsuleRequest):
        return Capsule(item.from_m, item.to_m, item.radius_m)
    mesh: Mesh = load_mesh(folder / item.file, item.scale, item.role == "chamber")
    return mesh


def plan(request: PlanRequest, rig: Rig, folder: Path = Path()) -> PlanAnswer | None:
    """The fastest found way of the tip to the goal; None where `request.samples` found none. Mesh files are in `folder`.

    Raises InputError: goal inside an obstacle, out of reach, reachable only in contact; start not free; a mesh not usable.
    """
    try:
        world = _World(request, rig, folder)
    except ValueError as error:
        key, _, rest = str(error).partition(": found ")
        found, _, wanted = rest.rpartition(", wanted ")
        raise InputError(key, found or rest, wanted) from None
    start = np.array([request.start.insertion_m, request.start.roll_rad, request.start.curvature_per_m])
    why = world.refused(start)
    if why:
        raise InputError("start", start.tolist(), f"a free start; found {why}")
    goals = _goals(request, rig, world)
    scale = world.reach.scale_m
    path = planner.connect(
        [start * scale],
        [goal * scale for goal in goals],
        world.reach.low * scale,
        world.reach.high * scale,
        world.free,
        request.seed,
        request.samples,
    )
    if path is None:
        return None
    path = planner.shorten(path, world.free, request.seed)
    return _timed(np.array(path) / scale, world, rig, request)


def _goals(request: PlanRequest, rig: Rig, world: _World) -> list[Array]:
    goal = np.array(request.goal_m)
    inside = world.surroundings.holds(goal)
    if inside:
        raise InputError("goal_m", request.goal_m, f"a goal in free space; it is {inside}")
    reachable = shape.joints_of(world.reach, rig, goal)
    if not reachable:
        raise InputError("goal_m", request.goal_m, "a goal that the unloaded tip can reach within the stages' travel")
    reasons = [world.refused(joint) for joint in reachable]
    free = [joint for joint, why in zip(reachable, reasons, strict=True) if not why]
    if not free:
        raise InputError("goal_m", request.goal_m, f"a goal that is reached free; there is {reasons[0]}")
    return free


def _timed(way: Array, world: _World, rig: Rig, request: PlanRequest) -> PlanAnswer:
    """Time over the way; where the spline through it cuts a corner too close, again with the points nearer together."""
    for spacing in (SPACING_M, 0.5 * SPACING_M, 0.2 * SPACING_M):
        dense = _dense(way, world.reach.scale_m, spacing)
        timed = timing.fastest(shape.stages_of(rig, dense), rig, request.period_s)
        joint = joints_at(rig, timed.stage)
        clear = min(world.clearance(row) for row in joint)
        if clear >= 0.5 * request.clearance_m or len(world.surroundings.obstacles) == 0:
            break
    tips = np.array([shape.tip(world.reach, row) for row in joint])
    return PlanAnswer(timed.time_s, timed.stage, joint, tips, float(clear), world.surroundings.questions, len(way))


def joints_at(rig: Rig, stage: Array) -> Array:
    """Joints (n, 3) of stage positions (n, 3): `shape.stages_of` the other way round."""
    t = rig.transmission
    config = tick_parameters(rig)[0].kinematics
    curvature = np.array([ik.curvature_of_knob(config, value) for value in stage[:, 2]])
    return np.column_stack([stage[:, 0] * t.insertion_slope + t.insertion_at_home_m, stage[:, 1] * t.roll_slope, curvature])


def _dense(way: Array, scale: Array, spacing_m: float) -> Array:
    rows = [way[0]]
    for start, end in itertools.pairwise(way):
        count = max(1, int(np.ceil(np.linalg.norm((end - start) * scale) / spacing_m)))
        rows += [start + (end - start) * k / count for k in range(1, count + 1)]
    return np.array(rows)


def read_plan_request(source: str) -> PlanRequest:
    """Read and check the request in JSON file `source` ('-': standard input). Raises InputError naming the key."""
    return validate(PlanRequest, with_tuples(read_json(source)))


def with_tuples(value: Any) -> Any:
    """Return `value` with lists of three numbers as tuples, which strict checking of points wants."""
    if isinstance(value, dict):
        return {key: with_tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        items = [with_tuples(item) for item in value]
        if len(items) == 3 and all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in items):
            return tuple(float(item) for item in items)
        return items
    return value
