"""Navigation: free of obstacles all along, at the goal in the end, within the stages' limits, or refused in one line."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from host.cli.plan import plan as cli_plan
from host.navigation import PlanRequest, plan, planner, shape
from host.navigation.loaded_shape import aimed, pressed, through_hole
from host.navigation.obstacles import Capsule, Mesh, Sphere, Surroundings, load_mesh, to_line_m, winding_number
from host.navigation.request import DRAWN_SHAPES, joints_at, with_tuples
from host.navigation.timing import ACCELERATION_SHARE, SPEED_SHARE
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.requests import validate
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import SHAPE_POINTS

START = {"insertion_m": -0.080, "roll_rad": 0.0, "curvature_per_m": 2.0}


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(SIMULATED_RIG)


@pytest.fixture(scope="module")
def reach(rig: Rig) -> shape.Reach:
    return shape.reach_of(rig, 0.00233)


def request(goal: Any, obstacles: list[dict] | None = None, **more: Any) -> PlanRequest:
    return validate(PlanRequest, with_tuples({"goal_m": list(goal), "start": START, "obstacles": obstacles or []} | more))


def tip_at(reach: shape.Reach, *joint: float) -> np.ndarray:
    return shape.tip(reach, np.array(joint))


def behind_a_bar(reach: shape.Reach, samples: int) -> tuple[PlanRequest, Capsule]:
    """The goal is on the other side of a bar across the direct way, a turn of the roll."""
    middle = tip_at(reach, -0.060, 0.0, 22.0)
    bar = Capsule(tuple(middle + [0, 0.004, 0]), tuple(middle + [0, -0.04, 0]), 0.006)
    asked = {"type": "capsule", "from_m": list(bar.from_m), "to_m": list(bar.to_m), "radius_m": bar.radius_m}
    start = {"insertion_m": -0.060, "roll_rad": -1.2, "curvature_per_m": 22.0}
    return request(tip_at(reach, -0.060, 1.2, 22.0), [asked], samples=samples, start=start), bar


def test_a_bar_is_gone_around(rig: Rig, reach: shape.Reach) -> None:
    wanted, bar = behind_a_bar(reach, 4000)
    answer = plan(wanted, rig)
    assert answer is not None
    assert np.allclose(answer.tip_m[-1], wanted.goal_m, atol=2e-4) and answer.clearance_m > 0.5 * wanted.clearance_m
    surroundings = Surroundings([bar])
    least = min(surroundings.clearance_m(shape.centre_line(reach, joint, 40), reach.radius_m) for joint in answer.joint)
    assert least > 0.0
    straight = np.linspace([-0.060, -1.2, 22.0], [-0.060, 1.2, 22.0], 60)
    assert min(surroundings.clearance_m(shape.centre_line(reach, j, 40), reach.radius_m) for j in straight) < 0.0


def test_time_is_within_the_limits_and_nearly_all_of_them(rig: Rig, reach: shape.Reach) -> None:
    answer = plan(request(tip_at(reach, -0.03, 0.4, 12.0), period_s=0.001), rig)
    assert answer is not None
    dt = np.diff(answer.time_s)[:, None]
    speed = np.diff(answer.stage, axis=0) / dt
    accel = np.diff(speed, axis=0) / dt[:-1]
    use_v = np.max(np.abs(speed) / [rig.stage(a).max_speed_unit_per_s for a in range(3)])
    use_a = np.max(np.abs(accel) / [rig.stage(a).max_accel_unit_per_s2 for a in range(3)])
    assert use_v <= SPEED_SHARE * 1.01 and use_a <= 1.0
    assert use_v > 0.9 * SPEED_SHARE or use_a > 0.9 * ACCELERATION_SHARE
    assert np.allclose(answer.stage, shape.stages_of(rig, answer.joint), atol=1e-9)


def test_the_tip_stays_in_its_chamber(rig: Rig, reach: shape.Reach, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=60.0)
    ball.apply_translation([0, 0, 55.0])
    ball.export(tmp_path / "chamber.stl")
    chamber = {"type": "mesh", "file": "chamber.stl", "scale": 0.001, "role": "chamber"}
    answer = plan(request(tip_at(reach, -0.05, 0.8, 20.0), [chamber]), rig, tmp_path)
    assert answer is not None
    assert np.max(np.linalg.norm(answer.tip_m - [0, 0, 0.055], axis=1)) < 0.060
    with pytest.raises(InputError, match=r"^goal_m.*outside chamber 0"):
        plan(request([0.0, -0.03, 0.13], [chamber]), rig, tmp_path)


def test_the_catheter_keeps_to_the_puncture(rig: Rig, reach: shape.Reach) -> None:
    puncture = {"point_m": [0.0, 0.0, 0.010], "radius_m": 0.002}
    start = {"insertion_m": 0.012, "roll_rad": 0.0, "curvature_per_m": 3.0}
    goal = tip_at(reach, 0.015, 1.0, 12.0)
    wanted = validate(PlanRequest, with_tuples({"goal_m": goal.tolist(), "start": start, "puncture": puncture}))
    answer = plan(wanted, rig)
    assert answer is not None
    off = [np.min(np.linalg.norm(shape.centre_line(reach, joint, 400) - [0, 0, 0.010], axis=1)) for joint in answer.joint]
    assert max(off) < 0.0023
    with pytest.raises(InputError, match=r"^start.*passes the puncture"):
        plan(request(goal, puncture={"point_m": [0.0, 0.02, 0.010], "radius_m": 0.002}), rig)


@pytest.mark.parametrize(
    ("goal", "obstacles", "words"),
    [
        ([0.0, 0.2, 0.05], [], "goal that the unloaded tip can reach"),
        (
            [0.0, -0.01, 0.05],
            [{"type": "sphere", "centre_m": [0, -0.01, 0.05], "radius_m": 0.004}],
            "inside obstacle 0 (sphere)",
        ),
        (
            [0.0, -0.01, 0.05],
            [{"type": "capsule", "from_m": [-0.02, -0.01, 0.05], "to_m": [0.02, -0.01, 0.05], "radius_m": 0.004}],
            "inside obstacle 0 (capsule)",
        ),
        ([0.0, -0.01, 0.05], [{"type": "sphere", "centre_m": [0, 0, 0.02], "radius_m": 0.004}], "start.*free start"),
        ([0.0, -0.01, 0.05], [{"type": "mesh", "file": "no_such.stl"}], "triangle mesh"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(rig: Rig, goal: list[float], obstacles: list[dict], words: str) -> None:
    with pytest.raises(InputError) as caught:
        plan(request(goal, obstacles), rig)
    assert re.search(words.replace("(", r"\(").replace(")", r"\)"), str(caught.value)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "broken",
    [
        {"goal": [0, 0, 0.05]},
        {"goal_m": [0, 0]},
        {"goal_m": [0, 0, 0.05], "obstacles": [{"type": "cube"}]},
        {"goal_m": [0, 0, 0.05], "clearance_m": -1.0},
    ],
)
def test_a_request_that_is_not_one_is_refused(broken: dict) -> None:
    with pytest.raises(InputError):
        validate(PlanRequest, with_tuples({"start": START, **broken}))


def test_no_way_is_told_apart_from_bad_input(tmp_path: Path, reach: shape.Reach, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = tmp_path / "request.json"
    asked.write_text(json.dumps({"goal_m": tip_at(reach, -0.03, 0.4, 12.0).tolist(), "start": START}))
    app = typer.Typer()
    app.command()(cli_plan)
    assert CliRunner().invoke(app, [str(asked), "--json"]).exit_code == 0
    monkeypatch.setattr(planner, "connect", lambda *arguments: None)
    result = CliRunner().invoke(app, [str(asked), "--json"])
    assert result.exit_code == 1 and '{"found": false}' in result.stdout


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.07, 0.015), st.floats(-3.0, 3.0), st.floats(-40, 40))
def test_joints_of_a_tip_lead_back_to_it(rig: Rig, reach: shape.Reach, body: float, roll: float, curvature: float) -> None:
    goal = tip_at(reach, body, roll, curvature)
    found = shape.joints_of(reach, rig, goal)
    assert all(np.allclose(shape.tip(reach, joint), goal, atol=1e-5) for joint in found)
    if math.hypot(goal[0], goal[1]) > 1e-3 and abs(abs(curvature) * 0.11 - 2.331) > 0.05:
        assert any(np.allclose(joint, [body, roll, curvature], atol=1e-4) for joint in found)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.08, 0.015), st.floats(-3.0, 3.0), st.floats(-44, 44))
def test_stages_and_joints_are_one_anothers_inverse(rig: Rig, body: float, roll: float, curvature: float) -> None:
    joint = np.array([[body, roll, curvature]])
    assert np.allclose(joints_at(rig, shape.stages_of(rig, joint)), joint, atol=1e-6)


def test_distances_are_those_of_geometry(tmp_path: Path) -> None:
    line = np.array([[0, 0, 0], [0, 0, 0.05]], float)
    assert Surroundings([Sphere((0.02, 0, 0.03), 0.005)]).clearance_m(line, 0.001) == pytest.approx(0.014, abs=1e-5)
    assert Surroundings([Capsule((0.02, -1, 0.03), (0.02, 1, 0.03), 0.005)]).clearance_m(line, 0.001) == pytest.approx(
        0.014, abs=1e-5
    )
    box = trimesh.creation.box((20.0, 20.0, 20.0))
    box.export(tmp_path / "box.stl")
    mesh = load_mesh(tmp_path / "box.stl", 0.001, False)
    assert abs(winding_number(mesh, np.array([0.003, 0.002, 0.001]))) == pytest.approx(1.0, abs=1e-9)
    assert winding_number(mesh, np.array([0.03, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-9)
    moved = Mesh(mesh.vertices_m + [0.03, 0, 0.02], mesh.faces)
    assert Surroundings([moved]).clearance_m(line, 0.001) == pytest.approx(0.019, abs=1e-5)
    open_box = trimesh.Trimesh(box.vertices, box.faces[:-1], process=False)
    open_box.export(tmp_path / "open.stl")
    with pytest.raises(ValueError, match="wanted a closed mesh"):
        load_mesh(tmp_path / "open.stl", 0.001, False)


def test_the_answer_is_json(rig: Rig, reach: shape.Reach) -> None:
    from protocol.requests import plain

    answer = plan(request(tip_at(reach, -0.05, 0.2, 12.0)), rig)
    assert answer is not None
    told = json.loads(json.dumps(plain(answer.as_json()), allow_nan=False))
    assert told["found"] and len(told["time_s"]) == len(told["tip_m"]) == len(told["stage"]["knob_rad"])


# The catheter under load


HOLE: dict[str, Any] = {"point_m": [0.0, 0.0, 0.030], "radius_m": 0.0005, "largest_force_N": 0.2}
THROUGH = {"insertion_m": -0.060, "roll_rad": 0.0, "curvature_per_m": 2.0}


def test_a_hole_that_bends_the_catheter_is_passed_by_its_loaded_shape(rig: Rig, reach: shape.Reach) -> None:
    """(2.19): every point of the path has the hole on the catheter, and the tip is where the bent catheter puts it."""
    free = tip_at(reach, -0.045, 0.0, 6.0)
    answer = plan(request(free, puncture=HOLE, start=THROUGH, samples=400), rig)
    assert answer is not None and 0.005 < answer.puncture_force_N <= 0.2
    assert np.allclose(answer.tip_m[-1], free, atol=2e-4)
    # Without the hole the same joints put the tip elsewhere: the path is not that of the unloaded shape.
    assert np.linalg.norm(shape.tip(reach, answer.joint[-1]) - free) > 1e-3
    catheter = load_catheter(rig.catheter.name)
    for joint in answer.joint[:: max(len(answer.joint) // 8, 1)]:
        unloaded = to_line_m(np.array(HOLE["point_m"]), shape.centre_line(reach, joint, 60))
        if unloaded > HOLE["radius_m"]:
            line = through_hole(catheter, reach, joint, np.array(HOLE["point_m"]), HOLE["radius_m"], 120)
            assert line is not None and to_line_m(np.array(HOLE["point_m"]), line.points_m) < HOLE["radius_m"] + 2e-4
    # What is drawn of the plan: from its first to its last row, the loaded shapes with their load, each ending at the tip.
    drawn = answer.shapes
    assert (drawn[0].row, drawn[-1].row) == (0, len(answer.time_s) - 1) and len(drawn) <= DRAWN_SHAPES
    assert max(one.load_N for one in drawn) == pytest.approx(answer.puncture_force_N, rel=0.2)
    for one in drawn:
        assert one.points_m.shape == (SHAPE_POINTS, 3)
        np.testing.assert_allclose(one.points_m[-1], answer.tip_m[one.row], atol=1e-9)


def test_a_hole_that_would_have_to_press_too_hard_is_refused(rig: Rig, reach: shape.Reach) -> None:
    goal = tip_at(reach, -0.045, 0.0, 30.0)
    weak = HOLE | {"largest_force_N": 0.01}
    with pytest.raises(InputError, match=r"^goal_m.*(bends it with|travel)"):
        plan(request(goal, puncture=weak, start=THROUGH), rig)


def test_the_pressed_shape_at_the_goal_is_checked(rig: Rig, reach: shape.Reach) -> None:
    """An obstacle that the unloaded catheter clears, and the pressed one does not."""
    goal = tip_at(reach, -0.050, 0.0, 14.0)
    force = np.array([0.0, 0.0, 0.1])
    free_joint = np.array([-0.050, 0.0, 14.0])
    catheter = load_catheter(rig.catheter.name)
    unloaded = shape.centre_line(reach, free_joint, 60)

    def tip(at: np.ndarray) -> np.ndarray:
        line = pressed(catheter, reach, at, force, 16)
        return np.full(3, np.nan) if line is None else line.points_m[-1]

    at = aimed(tip, free_joint, goal, reach.scale_m)
    assert at is not None
    line = pressed(catheter, reach, at, force, 60)
    assert line is not None and np.linalg.norm(line.points_m[-1] - goal) < 1e-4
    off = [to_line_m(point, unloaded) for point in line.points_m]
    worst = int(np.argmax(off))
    assert off[worst] > 0.5e-3
    away = line.points_m[worst] - unloaded[int(np.argmin(np.linalg.norm(unloaded - line.points_m[worst], axis=1)))]
    radius = 0.002
    clear = 0.4 * off[worst]
    centre = line.points_m[worst] + away / np.linalg.norm(away) * (radius + reach.radius_m - off[worst] + clear)
    ball = {"type": "sphere", "centre_m": centre.tolist(), "radius_m": radius}
    start = {"insertion_m": -0.052, "roll_rad": 0.0, "curvature_per_m": 13.0}
    assert plan(request(goal, [ball], start=start, clearance_m=0.0), rig) is not None
    with pytest.raises(InputError, match=r"^goal_m.*presses"):
        plan(request(goal, [ball], start=start, clearance_m=0.0, contact_force_N=force.tolist()), rig)


def test_the_answer_holds_the_shape_that_presses_at_the_goal(rig: Rig, reach: shape.Reach) -> None:
    goal = tip_at(reach, -0.050, 0.0, 14.0)
    start = {"insertion_m": -0.052, "roll_rad": 0.0, "curvature_per_m": 13.0}
    free = plan(request(goal, start=start), rig)
    answer = plan(request(goal, start=start, contact_force_N=[0.0, 0.0, 0.1]), rig)
    assert free is not None and free.pressed is None and "pressed" not in free.as_json()
    assert answer is not None and answer.pressed is not None
    points, last = answer.pressed.points_m, answer.shapes[-1].points_m
    assert points.shape == (SHAPE_POINTS, 3) and np.linalg.norm(points[-1] - goal) < 1e-4
    # Same tip, another way to it: 0.1 N bends this catheter by more than half a millimetre.
    assert max(to_line_m(point, last) for point in points) > 0.5e-3
    assert answer.as_json()["pressed"]["contact_force_N"].tolist() == [0.0, 0.0, 0.1]
