"""Protocols: scripted experiments in TOML. The steps as types, a file read and checked, and a dry run against the limits."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from host.commissioning.experiment_script import FORCE_SHARE, LEAST_FORCE_N
from host.navigation.request import PlanAnswer, plan, read_plan_request
from protocol.errors import Description, InputError
from protocol.requests import Request, validate
from protocol.rig_file import AXES, Rig
from protocol.text_files import read_text, toml_of
from realtime.control import inverse_kinematics
from realtime.core.reach import TargetReach

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]
Seconds = Annotated[float, Field(ge=0.0, le=3600.0)]
Metres = Annotated[float, Field(gt=0.0, le=0.1)]
Newton = Annotated[float, Field(gt=0.0, le=1.0)]
Into = Annotated[Point, Field(description="unit vector into the tissue, base frame")]
MOST_POINTS = 200
SETTLE_S = 1.5  # of a touch, while the force rises


class GotoStep(Request):
    """Bring the tip to a point in free space."""

    do: Literal["goto"]
    point_m: Point


class TouchStep(Request):
    """Press on the tissue at a point for a time, then go back before it. What is not given is the protocol's."""

    do: Literal["touch"]
    point_m: Point
    hold_s: Seconds
    force_N: Newton | None = None
    normal: Into | None = None


class LineStep(Request):
    """Touch at evenly spaced points of a straight line on the wall, both ends included."""

    do: Literal["line"]
    from_m: Point
    to_m: Point
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)]
    hold_s: Seconds
    force_N: Newton | None = None
    normal: Into | None = None


class RoundStep(Request):
    """Bring the tip in free space to evenly spaced points of a circle, and back to the first."""

    do: Literal["round"]
    centre_m: Point
    radius_m: Metres
    points: Annotated[int, Field(ge=3, le=MOST_POINTS)] = 8
    normal: Into | None = None


class WaitStep(Request):
    """Hold until the operator confirms."""

    do: Literal["wait"]
    message: Annotated[str, Field(min_length=1, max_length=300)]


class RestStep(Request):
    """Hold for `seconds`."""

    do: Literal["rest"]
    seconds: Seconds


class FollowPlanStep(Request):
    """Follow the path that `seldinger plan` computes for a request file (path relative to the protocol)."""

    do: Literal["plan"]
    request: str


Step = Annotated[
    GotoStep | TouchStep | LineStep | RoundStep | WaitStep | RestStep | FollowPlanStep, Field(discriminator="do")
]


class Tolerance(Request):
    """Largest errors of a touch or a point that count as within tolerance."""

    tip_m: Metres = 0.0015
    point_m: Metres = 0.003
    force_N: Newton = 0.05
    contact_loss_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.05


class Stop(Request):
    """Conditions that end a step early, and those that end the protocol."""

    after: Literal["failed", "out_of_tolerance", "never"] = "failed"
    within_s: Annotated[float, Field(gt=0.0, le=120.0)] = 20.0
    peak_force_N: Newton = 0.4
    contact_loss_s: Annotated[float, Field(gt=0.0, le=60.0)] = 2.0


class ProtocolFile(Request):
    """Content of a protocol's TOML file."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    force_N: Newton = 0.2
    normal: Into = (0.0, 0.0, 1.0)
    clearance_m: Metres = 0.004
    settle_s: Seconds = SETTLE_S
    tolerance: Tolerance = Tolerance()
    stop: Stop = Stop()
    steps: Annotated[list[Step], Field(min_length=1, max_length=MOST_POINTS)]


class Action(NamedTuple):
    """One action of a protocol: a step, or one point of a line or a round.

    id: as in results, "3" or "3.2" (step and point, from 1). kind: move, touch, wait, rest or plan.
    """

    id: str
    kind: str
    point_m: Point | None = None
    normal: Point = (0.0, 0.0, 1.0)
    force_N: float = 0.0
    seconds: float = 0.0
    message: str = ""
    path: PlanAnswer | None = None


class ScriptedProtocol(NamedTuple):
    """A checked protocol: the content and the hash of its file, and all actions in order."""

    file: ProtocolFile
    sha256: str
    actions: tuple[Action, ...]


class DryRun(NamedTuple):
    """Motion of a protocol on a rig: estimated time (s), box of the tip (m), travel of each stage (its unit), forces (N)."""

    seconds: float
    low_m: Array
    high_m: Array
    travel: dict[str, tuple[float, float]]
    forces_N: tuple[float, ...]


def read_protocol(path: Path, rig: Rig) -> ScriptedProtocol:
    """Read the protocol in TOML file `path` and expand it for `rig`; plans are computed. Raises InputError with the key."""
    text = read_text(path, "protocol", "a readable TOML file")
    content = toml_of(text, path, "protocol")
    try:
        file = validate(ProtocolFile, _with_floats(content))
    except InputError as error:
        # Lists count from 0, steps in results and reports from 1.
        numbered = re.sub(r"^steps\.(\d+)", lambda step: f"steps.{int(step[1]) + 1}", str(error))
        raise InputError.from_sentence(numbered).in_file(path) from None
    actions = list(
        itertools.chain.from_iterable(
            _actions_of(str(number), step, file, rig, path.parent) for number, step in enumerate(file.steps, 1)
        )
    )
    return ScriptedProtocol(file, hashlib.sha256(text.encode()).hexdigest(), tuple(actions))


def _with_floats(value: Any, key: str = "") -> Any:
    """Return points as tuples and whole numbers as floats, as the strict check requires; `points` stay whole."""
    if isinstance(value, dict):
        return {name: _with_floats(item, name) for name, item in value.items()}
    if isinstance(value, list):
        items = [_with_floats(item) for item in value]
        return tuple(items) if len(items) == 3 and all(isinstance(item, float) for item in items) else items
    if type(value) is int and key != "points":
        return float(value)
    return value


def _actions_of(number: str, step: Any, file: ProtocolFile, rig: Rig, folder: Path) -> list[Action]:
    """Return the actions of `step`, one for each point."""
    normal = _unit(f"steps.{number}.normal", getattr(step, "normal", None) or file.normal)
    if isinstance(step, GotoStep):
        return [Action(number, "move", step.point_m)]
    if isinstance(step, TouchStep):
        return [Action(number, "touch", step.point_m, normal, step.force_N or file.force_N, step.hold_s)]
    if isinstance(step, LineStep):
        places = np.linspace(step.from_m, step.to_m, step.points)
        force_N = step.force_N or file.force_N
        return [
            Action(f"{number}.{index}", "touch", _point(place), normal, force_N, step.hold_s)
            for index, place in enumerate(places, 1)
        ]
    if isinstance(step, RoundStep):
        return [
            Action(f"{number}.{index}", "move", _point(place))
            for index, place in enumerate(_circle(np.array(step.centre_m), np.array(normal), step.radius_m, step.points), 1)
        ]
    if isinstance(step, WaitStep):
        return [Action(number, "wait", message=step.message)]
    if isinstance(step, RestStep):
        return [Action(number, "rest", seconds=step.seconds)]
    return [Action(number, "plan", path=_plan(number, folder / step.request, rig))]


def _plan(number: str, request: Path, rig: Rig) -> PlanAnswer:
    answer = plan(read_plan_request(str(request)), rig, request.parent)
    if answer is None:
        found = Description(f"no path for {request.name}")
        raise InputError(f"steps.{number}.request", found, "a request that `seldinger plan` finds a path for")
    return answer


def _unit(key: str, vector: Point) -> Point:
    size = math.hypot(*vector)
    if abs(size - 1.0) > 1e-3:
        raise InputError(key, list(vector), "a unit vector into the tissue")
    return vector


def _point(values: Array) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _circle(centre_m: Array, normal: Array, radius_m: float, count: int) -> Array:
    """Return the points (count + 1, 3) of a circle, m, the first one again at the end."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    angles = np.linspace(0.0, 2.0 * math.pi, count + 1)[:, None]
    circle: Array = centre_m + radius_m * (np.cos(angles) * first + np.sin(angles) * second)
    return circle


def before(action: Action, clearance_m: float) -> Point:
    """Return the point `clearance_m` before the tissue at a touch, m."""
    assert action.point_m is not None
    return _point(np.array(action.point_m) - clearance_m * np.array(action.normal))


def dry_run(protocol: ScriptedProtocol, rig: Rig) -> DryRun:
    """Check the whole motion of `protocol` against the limits of `rig`. Nothing moves.

    Raises:
        InputError: a point, force or stage travel is beyond a limit; the key names the step.
    """
    file, reach = protocol.file, TargetReach(rig)
    most_N = FORCE_SHARE * rig.safety.over_force_N
    if file.stop.peak_force_N > rig.safety.over_force_N:
        raise InputError(
            "stop.peak_force_N", file.stop.peak_force_N, f"at most safety.over_force_N {rig.safety.over_force_N}"
        )
    points: list[Point] = []
    seconds, forces = 0.0, []
    for action in protocol.actions:
        key = f"steps.{action.id}"
        way = _way(action, file.clearance_m)
        for place in way:
            problem = reach.problem(place)
            if problem:
                raise InputError.from_sentence(f"{key}.{problem.replace('target_m', 'point_m', 1)}")
        if action.kind == "touch":
            forces.append(action.force_N)
            if not LEAST_FORCE_N <= action.force_N <= most_N:
                raise InputError(f"{key}.force_N", action.force_N, f"{LEAST_FORCE_N} to {most_N:.3g} N")
        seconds += (
            action.seconds + _travel_s(points[-1:] + way, rig) + (float(action.path.time_s[-1]) if action.path else 0.0)
        )
        points += way
    if not points:
        return DryRun(seconds, np.zeros(3), np.zeros(3), {}, ())
    table = np.array(points)
    return DryRun(seconds, table.min(axis=0), table.max(axis=0), _travel(table, protocol, rig), tuple(forces))


def _way(action: Action, clearance_m: float) -> list[Point]:
    """Return the points of the tip (n, 3), m, in order."""
    if action.kind == "touch":
        assert action.point_m is not None
        front = before(action, clearance_m)
        return [front, action.point_m, front]
    if action.path is not None:
        return [_point(row) for row in action.path.tip_m]
    return [] if action.point_m is None else [action.point_m]


def _travel_s(way: list[Point], rig: Rig) -> float:
    legs = sum(math.dist(a, b) for a, b in itertools.pairwise(way))
    return legs / rig.control.approach_speed_m_per_s


def _travel(points: Array, protocol: ScriptedProtocol, rig: Rig) -> dict[str, tuple[float, float]]:
    """Return the range of each stage over the tip's points. Raises InputError beyond a stage's travel."""
    config, known = inverse_kinematics_of(rig), rig.transmission
    joint, rows = np.array([known.insertion_at_home_m, 0.0, 0.0]), []
    for point in points:
        joint[:] = inverse_kinematics.apply_nearest(config, np.ascontiguousarray(point), joint)
        rows.append(((joint[0] - known.insertion_at_home_m) / known.insertion_slope, joint[1] / known.roll_slope, joint[2]))
    table, out = np.array(rows), {}
    for axis, name in enumerate(AXES):
        spare = 0.5 * known.insertion_backlash_m if axis == 0 else 0.0
        low, high = float(table[:, axis].min()) - spare, float(table[:, axis].max()) + spare
        stage = rig.stage(axis)
        if not (stage.min_unit <= low and high <= stage.max_unit):
            raise InputError(
                f"steps ({name})", f"{low:.4g} to {high:.4g}", f"travel of {stage.min_unit} to {stage.max_unit}"
            )
        out[name] = (low, high)
    return out


def inverse_kinematics_of(rig: Rig) -> Any:
    """Return the parameters of the rig's inverse kinematics."""
    from realtime.control.configure import tick_parameters

    return tick_parameters(rig)[0].kinematics
