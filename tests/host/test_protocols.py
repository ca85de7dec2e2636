"""Protocols: what is refused, what a touch is judged by, what ends a run and what resumes it; and six points."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from host.recordings.rig_picture import Picture
from host.report.protocol_report import write_protocol_report
from host.run import protocol_rigs
from host.run.protocol_file import ScriptedProtocol, dry_run, read_protocol
from host.run.protocol_result import ProtocolResult, read_result, write_result
from host.run.protocol_rigs import run_simulated
from host.run.protocol_run import Job, blank_result, carry_out
from protocol.commander import Acknowledgement
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import STEP_STATUS, PlannedStep, Pose, RigState
from sim.sensor_faults import SensorFault
from sim.world import World

ROOT = Path(__file__).parents[2]
SIX_POINTS = ROOT / "docs" / "examples" / "six_points.toml"
RIG = load_rig(SIMULATED_RIG)
HEAD = 'name = "test"\nsettle_s = 0.5\n'
TOUCH = '[[steps]]\ndo = "touch"\npoint_m = [0.0, -0.0107, 0.025]\nhold_s = 2\n'
GOTO = '[[steps]]\ndo = "goto"\npoint_m = [0.0, -0.0107, 0.020]\n'


def written(folder: Path, text: str) -> ScriptedProtocol:
    path = folder / "protocol.toml"
    path.write_text(text, encoding="utf-8")
    return read_protocol(path, RIG)


def test_the_shipped_line_is_six_touches_within_the_limits_of_the_simulated_rig() -> None:
    steps = read_protocol(SIX_POINTS, RIG)
    touches = [action for action in steps.actions if action.kind == "touch"]
    assert [action.id for action in touches] == [f"2.{number}" for number in range(1, 7)]
    places = [action.point_m for action in touches]
    assert [round(1e3 * place[0]) for place in places if place] == [-5, -3, -1, 1, 3, 5]
    planned = dry_run(steps, RIG)
    assert planned.seconds > 30.0 and set(planned.forces_N) == {0.2} and set(planned.travel) == {"insertion", "roll", "knob"}


def test_a_round_ends_where_it_began(tmp_path: Path) -> None:
    text = HEAD + '[[steps]]\ndo = "round"\ncentre_m = [0.0, -0.0107, 0.02]\nradius_m = 0.003\npoints = 6\n'
    places = [action.point_m for action in written(tmp_path, text).actions]
    assert len(places) == 7 and places[0] == pytest.approx(places[-1])
    assert all(math.dist(place, (0.0, -0.0107, 0.02)) == pytest.approx(0.003) for place in places if place)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("", "name"),
        (HEAD, "steps"),
        (HEAD + "steps = []\n", "steps"),
        (HEAD + '[[steps]]\ndo = "fly"\n', "steps.1"),
        (HEAD + '[[steps]]\ndo = "goto"\npoint_m = [0.0, 1.0]\n', "steps.1.goto.point_m"),
        (HEAD + GOTO + "pont_m = 3\n", "steps.1.goto.pont_m"),
        (HEAD + TOUCH.replace("hold_s = 2", "hold_s = -2"), "steps.1.touch.hold_s"),
        (HEAD + TOUCH.replace("hold_s = 2", "hold_s = nan"), "steps.1.touch.hold_s"),
        (HEAD + TOUCH + "force_N = 2.0\n", "steps.1.touch.force_N"),
        (HEAD + TOUCH + "normal = [0.0, 0.0, 2.0]\n", "steps.1.normal"),
        (HEAD + "[stop]\nafter = 'later'\n" + GOTO, "stop.after"),
        (HEAD + "[tolerance]\ntip_mm = 2\n" + GOTO, "tolerance.tip_mm"),
        (HEAD + '[[steps]]\ndo = "plan"\nrequest = "nowhere.json"\n', "nowhere.json"),
        ("steps = [", "protocol"),
    ],
)
def test_what_is_no_protocol_is_refused_and_the_key_is_named(tmp_path: Path, text: str, key: str) -> None:
    with pytest.raises(InputError) as refused:
        written(tmp_path, text)
    assert key in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (HEAD + GOTO.replace("0.020", "0.5"), "steps.1.point_m"),
        (HEAD + GOTO.replace("-0.0107, 0.020", "-0.1, 0.0"), "steps.1.point_m"),
        (HEAD + TOUCH + "force_N = 0.45\n", "steps.1.force_N"),
        (HEAD + TOUCH + "force_N = 0.001\n", "steps.1.force_N"),
        (HEAD + "[stop]\npeak_force_N = 0.9\n" + TOUCH, "stop.peak_force_N"),
    ],
)
def test_what_the_rig_cannot_do_is_refused_by_the_dry_run(tmp_path: Path, text: str, key: str) -> None:
    with pytest.raises(InputError) as refused:
        dry_run(written(tmp_path, text), RIG)
    assert str(refused.value).startswith(key)


def test_a_point_in_mm_is_recognized(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        dry_run(written(tmp_path, HEAD + GOTO.replace("-0.0107", "-10.7")), RIG)
    assert str(refused.value).endswith("; in m: -10.7 mm is -0.0107")


class ScriptedRig:
    """A rig without physics: goes where it is told at once, and in contact has the force of `force_N(seconds)`."""

    def __init__(self, force_N: Callable[[float], float] = lambda seconds: 0.2) -> None:
        self.force_N, self.now_s, self.mode, self.tip_m = force_N, 10.0, "hold", (0.0, 0.0, 0.02)
        self.given: list[tuple[str, dict[str, Any]]] = []
        self.refuse, self.goes_on, self.touched_s = "", True, 0.0
        self._states: list[RigState] = []
        self._poses: list[Pose] = []
        self.published: list[PlannedStep] = []
        self.cause = ""
        self.off_m, self.tracked = 0.0, True  # of the tracker's tip from the predicted one, along e1

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        self.given.append((target if action == "target" else action, fields))
        if self.refuse and self.refuse in (action, target):
            return Acknowledgement(False, "refused: the rig says why", "refused")
        if action == "target":
            self.mode, self.tip_m, self.touched_s = target, fields["target_m"], self.now_s
        elif action == "hold":
            self.mode = "hold"
        return Acknowledgement(True, "", "accepted")

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.01
            force = self.force_N(self.now_s - self.touched_s) if self.mode == "contact" else 0.0
            self._states.append(
                RigState(
                    stamp_ns=round(self.now_s * 1e9),
                    mode=self.mode,
                    safety_action="none",
                    cause="",
                    tip_m=self.tip_m,
                    force_N=force,
                    pose_age_ns=0,
                    poses_rejected=0,
                    forces_rejected=0,
                )
            )
            if self.tracked:
                x, y, z = self.tip_m
                self._poses.append(
                    Pose(
                        stamp_ns=round(self.now_s * 1e9),
                        arrival_ns=round(self.now_s * 1e9),
                        frame=1,
                        missing=False,
                        position_m=(x + self.off_m, y, z),
                        quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
                    )
                )
            if until():
                return True
        return False

    def poses(self) -> list[Pose]:
        taken, self._poses = self._poses, []
        return taken

    def states(self) -> list[RigState]:
        taken, self._states = self._states, []
        return taken

    def first_cause(self) -> str:
        return self.cause

    def operator(self, message: str) -> bool:
        return self.goes_on

    def publish_step(self, step: PlannedStep) -> None:
        self.published.append(step)


def performed(folder: Path, text: str, rig: ScriptedRig, earlier: Any = ()) -> ProtocolResult:
    job = Job(written(folder, text), RIG, folder / "result.json", tuple(earlier))
    return carry_out(job, rig, blank_result(job, True), lambda step, share: None)


PLAN = '[[steps]]\ndo = "plan"\nrequest = "way.json"\n'
WAY = {"goal_m": [0.0, -0.0107, 0.020], "start": {"insertion_m": -0.070, "roll_rad": 0.0, "curvature_per_m": 8.0}}


def test_the_steps_of_a_plan_are_published_and_the_one_being_executed_is_named(tmp_path: Path) -> None:
    (tmp_path / "way.json").write_text(json.dumps(WAY), encoding="utf-8")
    rig = ScriptedRig()
    result = performed(tmp_path, HEAD + PLAN, rig)
    assert result.good, result.results
    count = rig.published[0].steps
    by_status = {status: [step for step in rig.published if step.status == status] for status in STEP_STATUS}
    assert 8 < count <= 16 and [step.step for step in by_status["planned"]] == list(range(count))
    executed = [step.step for step in by_status["executing"]]
    assert executed == sorted(set(executed)) and executed[0] == 0 and executed[-1] == count - 1
    assert [step.status for step in rig.published][-1] == "ended" and len(by_status["ended"]) == 1
    # Each drawn shape ends where the tip is told to be at the step's time.
    assert by_status["planned"][-1].shape_m[-3:] == pytest.approx(WAY["goal_m"], abs=2e-4)
    # The page shows them, marks the step, and forgets them at the end.
    picture = Picture({}, {})
    for step in rig.published[:-1]:
        picture.take("plan", msgspec.to_builtins(step))
    shown = picture.frame()["plan"]
    assert shown["id"] == "1" and shown["step"] == count - 1 and all(len(shape) == 12 for shape in shown["shapes"])
    picture.take("plan", msgspec.to_builtins(rig.published[-1]))
    assert picture.frame()["plan"] is None


def test_the_loaded_goal_of_a_plan_is_published_with_its_force(tmp_path: Path) -> None:
    (tmp_path / "way.json").write_text(json.dumps({**WAY, "contact_force_N": [0.0, 0.0, 0.1]}), encoding="utf-8")
    rig = ScriptedRig()
    assert performed(tmp_path, HEAD + PLAN, rig).good
    loaded = [step for step in rig.published if step.status == "loaded"]
    assert len(loaded) == 1 and loaded[0].contact_force_N == (0.0, 0.0, 0.1)
    assert loaded[0].shape_m[-3:] == pytest.approx(WAY["goal_m"], abs=2e-4)
    last = next(step for step in rig.published if step.step == loaded[0].step and step.status == "planned")
    assert loaded[0].shape_m != last.shape_m
    picture = Picture({}, {})
    for step in rig.published[:-1]:
        picture.take("plan", msgspec.to_builtins(step))
    pressed = picture.frame()["plan"]["pressed"]
    assert pressed["force"] == [0.0, 0.0, 0.1] and len(pressed["shape"]) == 12


def test_a_plan_that_fails_on_the_way_is_closed_too(tmp_path: Path) -> None:
    (tmp_path / "way.json").write_text(json.dumps(WAY), encoding="utf-8")
    rig = ScriptedRig()
    rig.refuse = "position"
    assert not performed(tmp_path, HEAD + PLAN, rig).good
    assert rig.published[-1].status == "ended"


def test_a_touch_has_the_figures_of_its_force(tmp_path: Path) -> None:
    # 0.2 N with a swing of 0.02 N at 2 Hz; no contact from 1.0 to 1.2 s.
    rig = ScriptedRig(lambda s: 0.0 if 1.0 <= s < 1.2 else 0.2 + 0.02 * math.sin(4 * math.pi * s))
    result = performed(tmp_path, HEAD + "[tolerance]\ncontact_loss_share = 0.2\n" + TOUCH, rig)
    touch = result.results[0].touch
    assert touch is not None and touch.seconds == pytest.approx(2.0, abs=0.05)
    assert touch.force_time_integral_Ns == pytest.approx(0.2 * 1.8, abs=0.02)
    assert touch.force_time_integral_gs == pytest.approx(touch.force_time_integral_Ns / 9.80665e-3)
    assert touch.contact_loss_s == pytest.approx(0.2, abs=0.02) and touch.longest_loss_s == pytest.approx(0.2, abs=0.02)
    assert touch.peak_force_N == pytest.approx(0.22, abs=0.002) and touch.tip_error_m == pytest.approx(0.0, abs=1e-9)
    assert result.done and result.results[0].verdict == "ok"


def test_what_is_off_is_out_of_tolerance_and_says_by_how_much(tmp_path: Path) -> None:
    result = performed(tmp_path, HEAD + TOUCH + GOTO, ScriptedRig(lambda s: 0.12))
    assert [item.verdict for item in result.results] == ["out_of_tolerance", "ok"] and result.done and not result.good
    assert "mean force 0.120 N, wanted 0.2 within 0.05 N" in result.results[0].says
    ended = performed(tmp_path, HEAD + '[stop]\nafter = "out_of_tolerance"\n' + TOUCH + GOTO, ScriptedRig(lambda s: 0.12))
    assert len(ended.results) == 1 and ended.ended.startswith("step 1: mean force")


def test_the_tip_error_is_the_trackers_not_that_of_the_loops_own_prediction(tmp_path: Path) -> None:
    rig = ScriptedRig()
    rig.off_m = 0.0045
    result = performed(tmp_path, HEAD + "[tolerance]\ntip_m = 0.005\n" + TOUCH, rig)
    touch = result.results[0].touch
    assert touch is not None and touch.tip_error_m == pytest.approx(0.0045, abs=1e-6)
    assert result.results[0].verdict == "out_of_tolerance" and "tip 4.5 mm off" in result.results[0].says
    moved = performed(tmp_path, HEAD + GOTO, rig)
    assert moved.results[0].verdict == "out_of_tolerance" and moved.results[0].error_m == pytest.approx(0.0045, abs=1e-6)
    rig.tracked = False
    assert "no pose of the tip" in performed(tmp_path, HEAD + GOTO, rig).ended


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (lambda s: 0.2 if s < 0.5 else 0.45, "above stop.peak_force_N"),
        (lambda s: 0.2 if s < 0.1 else 0.0, "contact lost for more than 1 s"),
    ],
)
def test_a_stop_condition_ends_the_touch_and_leaves_the_tissue(
    tmp_path: Path, force: Callable[[float], float], words: str
) -> None:
    rig = ScriptedRig(force)
    result = performed(tmp_path, HEAD + "[stop]\ncontact_loss_s = 1.0\n" + TOUCH + GOTO, rig)
    assert len(result.results) == 1 and result.results[0].verdict == "failed" and words in result.ended
    assert rig.given[-2][0] == "position" and rig.given[-1][0] == "hold"


def test_a_refused_command_fails_the_step_with_the_reason_of_the_rig(tmp_path: Path) -> None:
    rig = ScriptedRig()
    rig.refuse = "contact"
    result = performed(tmp_path, HEAD + GOTO + TOUCH, rig)
    assert not result.done and "the rig says why" in result.ended


def test_a_rig_that_stops_ends_the_protocol_whatever_it_says(tmp_path: Path) -> None:
    rig = ScriptedRig()

    def stopping(seconds: float) -> float:
        rig.mode = "stopped" if seconds > 1.0 else rig.mode
        return 0.2

    rig.force_N = stopping
    result = performed(tmp_path, HEAD + '[stop]\nafter = "never"\n' + TOUCH + GOTO, rig)
    assert len(result.results) == 1 and "the rig went to stopped" in result.ended
    rig = ScriptedRig(stopping)
    rig.cause = "The control loop was late. Close other programs."

    def stopping_again(seconds: float) -> float:
        rig.mode = "stopped" if seconds > 1.0 else rig.mode
        return 0.2

    rig.force_N = stopping_again
    assert performed(tmp_path, HEAD + TOUCH, rig).ended == (
        "step 1: the rig went to stopped: The control loop was late. Close other programs."
    )


def test_a_protocol_goes_on_where_it_ended(tmp_path: Path) -> None:
    text = HEAD + GOTO + '[[steps]]\ndo = "wait"\nmessage = "swap the sheath"\n' + TOUCH
    rig = ScriptedRig()
    rig.goes_on = False
    first = performed(tmp_path, text, rig)
    assert [item.verdict for item in first.results] == ["ok", "failed"]
    earlier = read_result(tmp_path / "result.json", written(tmp_path, text), RIG.name, True)
    again = ScriptedRig()
    second = performed(tmp_path, text, again, earlier)
    assert second.good and len(second.results) == 3 and second.results[0] == first.results[0]
    assert [name for name, _ in again.given][:2] == ["hold", "position"], "the first step is not done again"


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"sha256": 3}', "null"])
def test_what_is_no_result_is_not_resumed(tmp_path: Path, content: str) -> None:
    (tmp_path / "old.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=r"^--resume: "):
        read_result(tmp_path / "old.json", written(tmp_path, HEAD + GOTO), RIG.name, True)


def test_a_result_of_another_protocol_is_not_resumed(tmp_path: Path) -> None:
    performed(tmp_path, HEAD + GOTO, ScriptedRig())
    with pytest.raises(InputError, match=r"of another protocol"):
        read_result(tmp_path / "result.json", written(tmp_path, HEAD + GOTO + GOTO), RIG.name, True)


@pytest.mark.parametrize(("rig", "simulated"), [("simulated", False), ("lab", True), ("lab", False)])
def test_a_result_of_another_rig_is_not_resumed(tmp_path: Path, rig: str, simulated: bool) -> None:
    """Touches of the simulator would otherwise pass for touches of the rig."""
    performed(tmp_path, HEAD + GOTO, ScriptedRig())
    with pytest.raises(InputError, match=r"^--resume: found .*in the simulation of rig simulated, wanted .* rig " + rig):
        read_result(tmp_path / "result.json", written(tmp_path, HEAD + GOTO), rig, simulated)


@pytest.mark.parametrize(
    ("stops", "says"), [(KeyboardInterrupt(), "interrupted"), (OSError("the disk is full"), "OSError: the disk is full")]
)
def test_what_interrupts_a_step_is_written_and_the_run_can_be_continued(
    tmp_path: Path, stops: BaseException, says: str
) -> None:
    text = HEAD + GOTO + TOUCH
    rig = ScriptedRig()

    def interrupted(seconds: float) -> float:
        raise stops

    rig.force_N = interrupted
    with pytest.raises(type(stops)):
        performed(tmp_path, text, rig)
    assert json.loads((tmp_path / "result.json").read_text())["ended"] == f"step 2: {says}"
    earlier = read_result(tmp_path / "result.json", written(tmp_path, text), RIG.name, True)
    assert [item.verdict for item in earlier] == ["ok"]
    assert performed(tmp_path, text, ScriptedRig(), earlier).good


def test_a_result_that_the_disk_does_not_take_leaves_the_one_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = HEAD + GOTO + GOTO
    target = tmp_path / "result.json"
    performed(tmp_path, text, ScriptedRig())
    before = target.read_text()

    def full(path: Path, content: str, **options: Any) -> int:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left on device") as failed:
        write_result(blank_result(Job(read_protocol(tmp_path / "protocol.toml", RIG), RIG, target), True), target)
    assert failed.value.filename == str(target) and target.read_text() == before
    assert not list(tmp_path.glob("*.part"))


def test_a_result_names_the_recording_of_each_step(tmp_path: Path) -> None:
    """The times of a step that is kept are those of the earlier recording."""
    text, rig = HEAD + GOTO + TOUCH, _refusing("contact")
    steps = written(tmp_path, text)
    first = Job(steps, RIG, tmp_path / "result.json")
    carry_out(first, rig, blank_result(first, True, "first.mcap"), lambda step, share: None)
    second = first._replace(earlier=read_result(first.target, steps, RIG.name, True))
    result = carry_out(second, ScriptedRig(), blank_result(second, True, "second.mcap"), lambda step, share: None)
    assert [item.recording for item in result.results] == ["first.mcap", "second.mcap"]
    assert result.as_json()["recordings"] == ["first.mcap", "second.mcap"]
    page = write_protocol_report(result.as_json(), tmp_path / "report.html").read_text(encoding="utf-8")
    assert "first.mcap, second.mcap" in page


def test_the_report_has_a_row_for_each_touch_and_says_why_it_ended(tmp_path: Path) -> None:
    result = performed(tmp_path, HEAD + GOTO + TOUCH, ScriptedRig(lambda s: 0.1))
    page = write_protocol_report(result.as_json(), tmp_path / "report.html").read_text(encoding="utf-8")
    assert (
        "mean force 0.100 N" in page
        and "out of tolerance" in page
        and "http://" not in page.replace("http://www.w3.org", "")
    )
    failed = performed(tmp_path, HEAD + TOUCH.replace("0.025]", "0.025]"), _refusing())
    page = write_protocol_report(failed.as_json(), tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Ended early" in page and json.loads((tmp_path / "result.json").read_text())["summary"]["done"] is False


def _refusing(command: str = "position") -> ScriptedRig:
    rig = ScriptedRig()
    rig.refuse = command
    return rig


def _shorter(rig: Rig) -> ScriptedProtocol:
    """The shipped line with touches of 3 s."""
    steps = read_protocol(SIX_POINTS, rig)
    return steps._replace(actions=tuple(action._replace(seconds=min(action.seconds, 3.0)) for action in steps.actions))


@pytest.mark.slow
def test_a_device_that_fails_in_a_touch_ends_it_with_its_first_cause_and_the_run_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tracker falls silent in the first touch; the line that ends the run names it, not all that followed."""
    steps = _shorter(RIG)
    steps = steps._replace(actions=steps.actions[:2])
    made = protocol_rigs.World

    def failing(*arguments: Any) -> World:
        world = made(*arguments)
        world.tracker.faults.append(SensorFault("silent", 4_000_000_000, 1_000_000_000_000))
        return world

    monkeypatch.setattr(protocol_rigs, "World", failing)
    job = Job(steps, RIG, tmp_path / "result.json")
    ended = run_simulated(job, tmp_path, "native", 1)
    assert [item.verdict for item in ended.results] == ["ok", "failed"]
    assert ended.ended.startswith("step 2.1: the rig went to ") and "racker" in ended.ended.partition(": ")[2]
    assert ";" not in ended.ended, ended.ended
    monkeypatch.undo()
    earlier = read_result(job.target, steps, RIG.name, True)
    done = run_simulated(job._replace(earlier=earlier), tmp_path, "native", 1)
    assert done.good and len(done.recordings) == 2


@pytest.mark.slow
def test_six_points_of_a_line_on_the_beating_wall(tmp_path: Path) -> None:
    steps = _shorter(RIG)
    result = run_simulated(Job(steps, RIG, tmp_path / "result.json"), tmp_path, "native", 1)
    assert result.done and not result.ended and Path(result.recording).exists()
    touches = [item.touch for item in result.results if item.touch is not None]
    assert len(touches) == 6
    assert all(abs(touch.mean_force_N - 0.2) < 0.05 and touch.peak_force_N < 0.4 for touch in touches)
    assert all(touch.contact_loss_share < 0.05 and touch.force_time_integral_Ns > 0.4 for touch in touches)
    assert read_result(tmp_path / "result.json", steps, RIG.name, True) == result.results
