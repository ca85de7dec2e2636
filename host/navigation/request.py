"""A plan from request to answer: checks, path, time, and a last look at the whole way."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from host.navigation import planner, shape, timing
from host.navigation.loaded_shape import LoadedLine, aimed, pressed, through_hole
from host.navigation.obstacles import Capsule, Mesh, Obstacle, Sphere, Surroundings, load_mesh, to_line_m
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.requests import Request, validate
from protocol.rig_file import Rig
from protocol.text_files import read_json
from protocol.topics import SHAPE_POINTS
from realtime.control import inverse_kinematics as ik
from realtime.control.configure import tick_parameters

Array = NDArray[np.float64]
# Wide bounds: beyond them a value is one in another unit, and the refusal says so.
Coordinate_m = Annotated[float, Field(ge=-1.0, le=1.0)]
Length_m = Annotated[float, Field(gt=0.0, le=1.0)]
Point = tuple[Coordinate_m, Coordinate_m, Coordinate_m]
Component_N = Annotated[float, Field(ge=-1.0, le=1.0)]
LINE_POINTS = 16
# Spacing of the way's points (m of tip, about) before time is laid over it.
SPACING_M = 0.003
# Length at the tip that lies on the tissue in contact.
TISSUE_m = 0.005
DRAWN_SHAPES = 16


class SphereRequest(Request):
    """A solid sphere."""

    type: Literal["sphere"]
    centre_m: Point
    radius_m: Length_m


class CapsuleRequest(Request):
    """A solid capsule."""

    type: Literal["capsule"]
    from_m: Point
    to_m: Point
    radius_m: Length_m


class MeshRequest(Request):
    """A closed triangle mesh: a solid, or with role chamber the space to stay in. File lengths times `scale` are m."""

    type: Literal["mesh"]
    file: str
    scale: Annotated[float, Field(gt=0)] = 1.0
    role: Literal["obstacle", "chamber"] = "obstacle"


class PunctureRequest(Request):
    """The transseptal hole: the catheter passes `point_m` (2.19).

    Within `radius_m` it passes freely; further off the hole bends it, with at most `largest_force_N`.
    """

    point_m: Point
    radius_m: Length_m
    largest_force_N: Annotated[float, Field(ge=0, le=0.5)] = 0.2


class JointRequest(Request):
    """Joints at the start: insertion, roll and curvature of the distal end."""

    insertion_m: Coordinate_m
    roll_rad: Annotated[float, Field(ge=-50.0, le=50.0)]
    curvature_per_m: Annotated[float, Field(ge=-1000.0, le=1000.0)]


AnyObstacle = Annotated[SphereRequest | CapsuleRequest | MeshRequest, Field(discriminator="type")]


class PlanRequest(Request):
    """Request of `seldinger plan`, as in docs/navigation.md."""

    goal_m: Point
    start: JointRequest
    obstacles: list[AnyObstacle] = Field(default_factory=list)
    puncture: PunctureRequest | None = None
    contact_force_N: tuple[Component_N, Component_N, Component_N] | None = None
    clearance_m: Annotated[float, Field(ge=0, le=0.05)] = 0.001
    seed: int = 1
    samples: Annotated[int, Field(ge=10, le=1_000_000)] = 20_000
    period_s: Annotated[float, Field(gt=0, le=1)] = 0.02


class PlannedShape(NamedTuple):
    """The catheter at row `row` of a plan: centre line (SHAPE_POINTS, 3) m, and the force (N) of the puncture on it."""

    row: int
    points_m: Array
    load_N: float


class PressedShape(NamedTuple):
    """The catheter that presses at the goal: centre line (SHAPE_POINTS, 3) m, and the force (3,) N on the tissue."""

    points_m: Array
    contact_force_N: Array


class PlanAnswer(NamedTuple):
    """A plan: one row for each period, at rest at both ends.

    `clearance_m` is the smallest on the path, measured from the catheter's surface. `puncture_force_N` is the greatest with
    which the puncture bends the catheter on the path. `shapes` are some rows as pictures draw them, evenly spaced in time;
    `pressed` is the goal under the request's contact force.
    """

    time_s: Array
    stage: Array
    joint: Array
    tip_m: Array
    clearance_m: float
    checks: int
    waypoints: int
    puncture_force_N: float
    shapes: tuple[PlannedShape, ...] = ()
    pressed: PressedShape | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the plan as JSON: samples by column name, SI units; `pressed` only for a request with a contact force."""
        pressing = self.pressed
        pressed = (
            {}
            if pressing is None
            else {"pressed": {"contact_force_N": pressing.contact_force_N, "shape_m": pressing.points_m}}
        )
        return {
            "found": True,
            "duration_s": float(self.time_s[-1]),
            "clearance_m": self.clearance_m,
            "puncture_force_N": self.puncture_force_N,
            "waypoints": self.waypoints,
            "collision_checks": self.checks,
            "time_s": self.time_s,
            "stage": {"insertion_m": self.stage[:, 0], "roll_rad": self.stage[:, 1], "knob_rad": self.stage[:, 2]},
            "joint": {"insertion_m": self.joint[:, 0], "roll_rad": self.joint[:, 1], "curvature_per_m": self.joint[:, 2]},
            "tip_m": self.tip_m,
            **pressed,
        }


class _World:
    """Test whether a set of joints is free of collision; the planner calls it."""

    def __init__(self, request: PlanRequest, rig: Rig, folder: Path) -> None:
        self.catheter = load_catheter(rig.catheter.name)
        self.reach = shape.reach_of(rig, self.catheter.diameter_m)
        self.surroundings = Surroundings([_obstacle(item, folder) for item in request.obstacles])
        self.puncture, self.clearance_m = request.puncture, request.clearance_m

    def line(self, joint: Array) -> LoadedLine | None:
        """Return the catheter at `joint`, bent by the puncture if it touches its edge; None if it cannot pass."""
        if self.puncture is None:
            return LoadedLine(shape.centre_line(self.reach, joint, LINE_POINTS), 0.0)
        hole, free = np.array(self.puncture.point_m), shape.centre_line(self.reach, joint, 3 * LINE_POINTS)
        if to_line_m(hole, free) <= self.puncture.radius_m:
            return LoadedLine(free, 0.0)
        return through_hole(self.catheter, self.reach, joint, hole, self.puncture.radius_m, 3 * LINE_POINTS)

    def tip(self, joint: Array) -> Array:
        """Return the position (3,) m of the tip; NaN if the catheter has no shape."""
        line = self.line(joint)
        return np.full(3, np.nan) if line is None else line.points_m[-1]

    def clearance(self, joint: Array) -> float:
        line = self.line(joint)
        return 0.0 if line is None else self.surroundings.clearance_m(line.points_m, self.reach.radius_m)

    def refused(self, joint: Array) -> str:
        """Return why `joint` is not free; empty if it is."""
        if not shape.within(self.reach, joint):
            return "out of the stages' travel"
        line = self.line(joint)
        if self.puncture is not None:
            out_m = abs(float(np.dot(self.puncture.point_m, [math.cos(joint[1]), math.sin(joint[1]), 0.0])))
            if line is None:
                return "no shape of the catheter that passes the puncture"
            if line.force_N > 0.0 and out_m > self.puncture.radius_m:
                return f"a catheter that passes the puncture {out_m * 1e3:.1f} mm off, out of its bending plane"
            if line.force_N > self.puncture.largest_force_N:
                return f"a catheter that passes the puncture only if that bends it with {line.force_N:.2f} N"
        assert line is not None
        return self._touches(line.points_m)

    def pressed_line(self, joint: Array, goal_m: Array, contact_force_N: Array) -> LoadedLine | None:
        """Return the catheter that presses at the goal, reached from `joint` free; None if there is no such shape.

        The tip stays at the goal while the base goes on, so another joint is looked for, where the loaded tip is there.
        """

        def tip(at: Array) -> Array:
            line = pressed(self.catheter, self.reach, at, contact_force_N, LINE_POINTS)
            return np.full(3, np.nan) if line is None else line.points_m[-1]

        at = aimed(tip, joint, goal_m, self.reach.scale_m)
        if at is None or not shape.within(self.reach, at):
            return None
        return pressed(self.catheter, self.reach, at, contact_force_N, 2 * LINE_POINTS)

    def refused_pressed(self, line: LoadedLine | None, goal_m: Array) -> str:
        """Return why the catheter cannot press at the goal with the shape `line`; empty if it can.

        The last TISSUE_m are left out: they lie on the tissue.
        """
        if line is None:
            return "no shape of the catheter that presses there with this force"
        kept = np.linalg.norm(line.points_m - goal_m, axis=1) > TISSUE_m
        why = self._touches(line.points_m[kept]) if np.count_nonzero(kept) > 1 else ""
        return f"{why} when it presses" if why else ""

    def aim(self, joint: Array, goal_m: Array) -> Array | None:
        """Return the joint next to `joint` whose tip, bent by the puncture, is at the goal; None if there is none."""
        return aimed(self.tip, joint, goal_m, self.reach.scale_m)

    def _touches(self, points_m: Array) -> str:
        clear_m = self.surroundings.clearance_m(points_m, self.reach.radius_m)
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
    """Return the fastest path of the tip to the goal; None if `request.samples` found none. Mesh files are in `folder`.

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
        raise InputError("start", start.tolist(), f"a free start; this one is refused for {why}")
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
    if request.puncture is not None:
        reachable = [found for found in (world.aim(joint, goal) for joint in reachable) if found is not None]
    if not reachable:
        raise InputError("goal_m", request.goal_m, "a goal that the unloaded tip can reach within the stages' travel")
    reasons = [world.refused(joint) for joint in reachable]
    if request.contact_force_N is not None:
        force = np.array(request.contact_force_N)
        reasons = [
            why or world.refused_pressed(world.pressed_line(joint, goal, force), goal)
            for joint, why in zip(reachable, reasons, strict=True)
        ]
    free = [joint for joint, why in zip(reachable, reasons, strict=True) if not why]
    if not free:
        raise InputError("goal_m", request.goal_m, f"a goal that is reached free; there is {reasons[0]}")
    return free


def _timed(way: Array, world: _World, rig: Rig, request: PlanRequest) -> PlanAnswer:
    """Compute the time along the path; if the spline cuts a corner too closely, repeat it with denser points."""
    for spacing in (SPACING_M, 0.5 * SPACING_M, 0.2 * SPACING_M):
        dense = _dense(way, world.reach.scale_m, spacing)
        timed = timing.fastest(shape.stages_of(rig, dense), rig, request.period_s)
        joint = joints_at(rig, timed.stage)
        clear = min(world.clearance(row) for row in joint)
        if clear >= 0.5 * request.clearance_m or len(world.surroundings.obstacles) == 0:
            break
    lines = [world.line(row) for row in joint]
    tips = np.array([np.full(3, np.nan) if line is None else line.points_m[-1] for line in lines])
    force_N = max((line.force_N for line in lines if line is not None), default=0.0)
    asked = world.surroundings.questions
    return PlanAnswer(
        timed.time_s,
        timed.stage,
        joint,
        tips,
        float(clear),
        asked,
        len(way),
        force_N,
        _shapes(lines),
        _pressed_at(way[-1], world, request),
    )


def _pressed_at(joint: Array, world: _World, request: PlanRequest) -> PressedShape | None:
    """Return the catheter under the request's contact force at the goal, for the `joint` that the path ends with."""
    if request.contact_force_N is None or not any(request.contact_force_N):
        return None
    force_N = np.array(request.contact_force_N)
    line = world.pressed_line(joint, np.array(request.goal_m), force_N)
    return None if line is None else PressedShape(_drawn(line), force_N)


def _shapes(lines: list[LoadedLine | None]) -> tuple[PlannedShape, ...]:
    """At most DRAWN_SHAPES of the plan's lines, the first and the last among them, with SHAPE_POINTS points each."""
    shapes = []
    for row in np.unique(np.linspace(0, len(lines) - 1, DRAWN_SHAPES).round().astype(int)):
        line = lines[row]
        if line is not None:
            shapes.append(PlannedShape(int(row), _drawn(line), line.force_N))
    return tuple(shapes)


def _drawn(line: LoadedLine) -> Array:
    """Return SHAPE_POINTS points (SHAPE_POINTS, 3) m of the line, both ends included."""
    at = np.linspace(0, len(line.points_m) - 1, SHAPE_POINTS)
    return np.column_stack([np.interp(at, np.arange(len(line.points_m)), line.points_m[:, axis]) for axis in range(3)])


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
    """Return `value` with lists of three numbers as tuples, as the strict check of points requires."""
    if isinstance(value, dict):
        return {key: with_tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        items = [with_tuples(item) for item in value]
        if len(items) == 3 and all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in items):
            return tuple(float(item) for item in items)
        return items
    return value
