"""Runs a protocol on a rig, simulated or real: step by step, judged against its tolerances, resumable after a stop."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
import zenoh

from host.navigation.request import PlanAnswer
from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter, new_recording_path
from host.run.commander import Commander
from host.run.connection import may_run
from host.run.protocol_file import Action, ProtocolFile, ScriptedProtocol, before
from protocol.commander import Acknowledgement
from protocol.errors import Description, InputError
from protocol.messages import MessageType
from protocol.requests import plain
from protocol.rig_file import Rig
from protocol.text_files import json_of, read_text
from protocol.topics import Message, PlannedStep, Pose, RigState, decode, key
from protocol.zenoh_session import Session
from sim.board import SimulatedBoard
from sim.effects import parse
from sim.scenario import Estimator, Scenario
from sim.world import World, simulated_plant

ARM_WITHIN_S = 10.0
# A rig that runs publishes its state 100 times a second; one of this computer without a socket does not run.
STATES_WITHIN_S, NOT_RUNNING_S = 3.0, 0.2
THERE_S = 0.3
# Commands of a plan a second: half of what the rig lets through.
PLAN_HZ = 20.0
# Samples of the force a second in a result's trace.
TRACE_HZ = 20.0
GRAM_N = 9.80665e-3
OK, OUT_OF_TOLERANCE, FAILED = "ok", "out_of_tolerance", "failed"
ENDED = ("stopped", "disarmed", "retract")
Progress = Callable[[str, float], None]


class DrivenRig(Protocol):
    """Interface of a rig for a protocol, in virtual time or on the wall clock."""

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command under the lease."""
        ...

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass; return whether `until` ended it."""
        ...

    def states(self) -> list[RigState]:
        """Return the loop's states since the last call, oldest first."""
        ...

    def poses(self) -> list[Pose]:
        """Return the tracker's poses of the tip since the last call, oldest first."""
        ...

    def operator(self, message: str) -> bool:
        """Show `message` and wait for the operator; return False if the protocol is to end."""
        ...

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan, for pages and recording."""
        ...


class TouchResult(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one touch. Mean, RMS error and tip error are those after `settle_s`; the others of the whole touch.

    force_time_integral: of the measured force over the time of the touch. contact_loss: force below the rig's threshold
    of contact. tip_error_m: of the tracker's mean position of the tip from the wanted point, across the normal; None
    without poses. It is not taken from the loop's predicted tip, which the loop itself brings to the point.
    """

    force_N: float
    mean_force_N: float
    rms_error_N: float
    peak_force_N: float
    seconds: float
    force_time_integral_Ns: float
    force_time_integral_gs: float
    contact_loss_s: float
    contact_loss_share: float
    longest_loss_s: float
    tip_error_m: float | None
    contact_after_s: float
    trace_time_s: tuple[float, ...] = ()
    trace_force_N: tuple[float, ...] = ()


class ActionResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one action: verdict (ok, out_of_tolerance, failed), reason in words, and its figures."""

    id: str
    kind: str
    verdict: str
    says: str
    started_s: float
    seconds: float
    point_m: tuple[float, float, float] | None = None
    error_m: float | None = None
    touch: TouchResult | None = None


class ProtocolResult(msgspec.Struct, frozen=True, kw_only=True):
    """A run of a protocol. done: every action has a result and none failed. recording: its file, empty on a real rig."""

    protocol: str
    sha256: str
    rig: str
    simulated: bool
    actions_planned: int
    results: tuple[ActionResult, ...] = ()
    ended: str = ""
    recording: str = ""

    @property
    def done(self) -> bool:
        """Whether every action was carried out."""
        return len(self.results) == self.actions_planned and all(item.verdict != FAILED for item in self.results)

    @property
    def good(self) -> bool:
        """Whether every action was carried out within its tolerances."""
        return self.done and all(item.verdict == OK for item in self.results)

    def as_json(self) -> dict[str, Any]:
        """Return the result as one JSON object."""
        touches = [item.touch for item in self.results if item.touch is not None]
        counts = {
            verdict: sum(item.verdict == verdict for item in self.results) for verdict in (OK, OUT_OF_TOLERANCE, FAILED)
        }
        summary: dict[str, Any] = {"done": self.done, **counts, "touches": len(touches)}
        errors_m = [touch.tip_error_m for touch in touches if touch.tip_error_m is not None]
        if touches:
            summary |= {
                "mean_force_N": float(np.mean([touch.mean_force_N for touch in touches])),
                "force_time_integral_Ns": float(np.sum([touch.force_time_integral_Ns for touch in touches])),
                "contact_loss_share": float(np.mean([touch.contact_loss_share for touch in touches])),
                "tip_error_m": float(np.mean(errors_m)) if errors_m else None,
            }
        return {**msgspec.to_builtins(self), "summary": summary}


class StepFailed(RuntimeError):
    """A step that could not be carried out, with the reason."""


class _Run:
    """Carries out one action after the other."""

    def __init__(self, file: ProtocolFile, driven: DrivenRig, contact_N: float) -> None:
        self._file, self._driven, self._contact_N = file, driven, contact_N
        self._now = RigState(
            stamp_ns=0, mode="hold", safety_action="none", cause="", pose_age_ns=0, poses_rejected=0, forces_rejected=0
        )
        self._kept: list[RigState] = []
        self._poses: list[Pose] = []

    @property
    def now_s(self) -> float:
        """Return the rig's time (s) of the newest state."""
        return self._now.stamp_ns * 1e-9

    def look(self) -> RigState:
        """Process the states since the last call; return the newest."""
        states = self._driven.states()
        self._kept += states
        self._poses += [pose for pose in self._driven.poses() if pose.position_m is not None]
        if states:
            self._now = states[-1]
        return self._now

    def wait(self, seconds: float, until: Callable[[RigState], bool] = lambda state: False) -> bool:
        """Wait for `until`; raise StepFailed if the rig stops."""

        def looking() -> bool:
            state = self.look()
            return until(state) or state.mode in ENDED

        ended = self._driven.wait(seconds, looking)
        if self._now.mode in ENDED:
            raise StepFailed(f"the rig went to {self._now.mode}" + (f": {self._now.cause}" if self._now.cause else ""))
        return ended

    def ask(self, action: str, target: str = "none", **fields: Any) -> None:
        """Give a command; raise StepFailed if it is refused."""
        answer = self._driven.give(action, target, **fields)
        if not answer.accepted:
            raise StepFailed(f"{action}: {answer.reason}")

    def do(self, action: Action) -> ActionResult:
        """Carry out `action`; never raises StepFailed."""
        self.look()
        self._kept.clear()
        self._poses.clear()
        begin_s = self.now_s
        try:
            result = {"move": self._move, "touch": self._touch, "wait": self._wait, "rest": self._rest, "plan": self._plan}[
                action.kind
            ](action)
        except StepFailed as failed:
            result = ActionResult(
                id=action.id, kind=action.kind, verdict=FAILED, says=str(failed), started_s=begin_s, seconds=0.0
            )
        return msgspec.structs.replace(
            result, started_s=round(begin_s, 3), seconds=round(self.now_s - begin_s, 3), point_m=action.point_m
        )

    def _go(self, place: Sequence[float], near_m: float) -> float:
        """Bring the tip to `place`; return the error (m)."""
        self.ask("target", "position", target_m=tuple(place))
        since_ns: int | None = None

        def there(state: RigState) -> bool:
            nonlocal since_ns
            near = state.tip_m is not None and math.dist(state.tip_m, place) <= near_m
            since_ns = (since_ns if since_ns is not None else state.stamp_ns) if near else None
            return since_ns is not None and state.stamp_ns - since_ns >= THERE_S * 1e9

        reached = self.wait(self._file.stop.within_s, there)
        off_m = math.dist(self._now.tip_m, place) if self._now.tip_m is not None else math.nan
        if not reached:
            raise StepFailed(f"not reached within {self._file.stop.within_s:g} s: {1e3 * off_m:.1f} mm off")
        return self._measured_off_m(place, since_ns or 0)

    def _measured_off_m(self, place: Sequence[float], since_ns: int) -> float:
        """Return how far the tracker's mean position since then is from `place`, m. Raises StepFailed without poses."""
        measured = [pose.position_m for pose in self._poses if pose.stamp_ns >= since_ns and pose.position_m is not None]
        if not measured:
            raise StepFailed("reached by the loop's prediction, but no pose of the tip came")
        return math.dist(np.mean(np.array(measured), axis=0), place)

    def _move(self, action: Action) -> ActionResult:
        assert action.point_m is not None
        near_m = self._file.tolerance.tip_m
        off_m = self._go(action.point_m, near_m)
        verdict = OK if off_m <= near_m else OUT_OF_TOLERANCE
        return _result(action, verdict, f"{1e3 * off_m:.1f} mm off by the tracker", error_m=off_m)

    def _wait(self, action: Action) -> ActionResult:
        self.ask("hold")
        if not self._driven.operator(action.message):
            raise StepFailed("the operator ended the protocol")
        return _result(action, OK, "the operator went on")

    def _rest(self, action: Action) -> ActionResult:
        self.ask("hold")
        self.wait(action.seconds)
        return _result(action, OK, f"held for {action.seconds:g} s")

    def _plan(self, action: Action) -> ActionResult:
        assert action.path is not None
        try:
            return self._follow(action, action.path)
        finally:
            if action.path.shapes:
                self._show_step(action, len(action.path.shapes) - 1, "ended")

    def _show_step(self, action: Action, number: int, status: str) -> None:
        """Publish step `number` of the plan's drawn steps; with status loaded, the shape that presses at the goal."""
        assert action.path is not None
        shape, pressed = action.path.shapes[number], action.path.pressed if status == "loaded" else None
        points_m = shape.points_m if pressed is None else pressed.points_m
        force_N = (0.0, 0.0, 0.0) if pressed is None else tuple(float(value) for value in pressed.contact_force_N)
        self._driven.publish_step(
            PlannedStep(
                stamp_ns=self._now.stamp_ns,
                plan=action.id,
                step=number,
                steps=len(action.path.shapes),
                status=status,
                time_s=float(action.path.time_s[shape.row]),
                load_N=min(shape.load_N, 1.0),
                contact_force_N=force_N,
                shape_m=tuple(float(value) for value in points_m.ravel()),
            )
        )

    def _follow(self, action: Action, path: PlanAnswer) -> ActionResult:
        """Follow a plan; its steps are published before it begins, and the one being executed as it changes."""
        tips, times = path.tip_m, path.time_s
        for number in range(len(path.shapes)):
            self._show_step(action, number, "planned")
        if path.shapes and path.pressed is not None:
            self._show_step(action, len(path.shapes) - 1, "loaded")
        if path.shapes:
            self._show_step(action, 0, "executing")
        step, step_times = 0, np.array([times[shape.row] for shape in path.shapes])
        self._go([float(value) for value in tips[0]], self._file.tolerance.tip_m)
        for at_s in np.arange(1.0 / PLAN_HZ, float(times[-1]), 1.0 / PLAN_HZ):
            place = [float(np.interp(at_s, times, tips[:, axis])) for axis in range(3)]
            # The step that the tip is on its way to.
            ahead = min(int(np.searchsorted(step_times, at_s)), len(path.shapes) - 1)
            if ahead > step:
                step = ahead
                self._show_step(action, step, "executing")
            self.ask("target", "position", target_m=tuple(place))
            self.wait(1.0 / PLAN_HZ)
        if step < len(path.shapes) - 1:
            self._show_step(action, len(path.shapes) - 1, "executing")
        off_m = self._go([float(value) for value in tips[-1]], self._file.tolerance.tip_m)
        walked = [state.tip_m for state in self._kept if state.tip_m is not None]
        aside_m = max((float(np.min(np.linalg.norm(tips - np.array(tip), axis=1))) for tip in walked[10:]), default=0.0)
        return _result(
            action, OK, f"{1e3 * off_m:.1f} mm off at the goal, at most {1e3 * aside_m:.1f} mm on the way", error_m=off_m
        )

    def _touch(self, action: Action) -> ActionResult:
        """Go before the tissue, press, hold, and go back before it."""
        assert action.point_m is not None
        file, front = self._file, before(action, self._file.clearance_m)
        self._go(front, max(file.tolerance.tip_m, 0.25 * file.clearance_m))
        asked_s = self.now_s
        self.ask("target", "contact", target_m=action.point_m, normal=action.normal, force_N=action.force_N)
        if not self.wait(file.stop.within_s, lambda state: state.mode == "contact"):
            self._away(front)
            raise StepFailed(f"no contact within {file.stop.within_s:g} s")
        contact_s = self.now_s
        self._kept.clear()
        self._poses.clear()
        why = self._press(action)
        touch = self._figures(action, list(self._kept), contact_s - asked_s)
        self._away(front)
        if why:
            return _result(action, FAILED, why, error_m=touch.tip_error_m, touch=touch)
        missed = self._missed(touch)
        return _result(
            action,
            OUT_OF_TOLERANCE if missed else OK,
            "; ".join(missed) or f"{touch.mean_force_N:.3f} N",
            error_m=touch.tip_error_m,
            touch=touch,
        )

    def _press(self, action: Action) -> str:
        """Hold the force; return which stop condition ended it early, empty for none."""
        lost_ns, stop, why = 0, self._file.stop, ""
        seen = 0

        def ended(state: RigState) -> bool:
            nonlocal lost_ns, seen, why
            for kept in self._kept[seen:]:
                force_N = kept.force_N or 0.0
                lost_ns = 0 if force_N >= self._contact_N else (lost_ns or kept.stamp_ns)
                if lost_ns and kept.stamp_ns - lost_ns > stop.contact_loss_s * 1e9:
                    why = f"contact lost for more than {stop.contact_loss_s:g} s"
                if force_N > stop.peak_force_N:
                    why = f"force {force_N:.3f} N above stop.peak_force_N {stop.peak_force_N:g} N"
            seen = len(self._kept)
            return bool(why)

        self.wait(action.seconds, ended)
        return why

    def _away(self, front: Sequence[float]) -> None:
        """Move the tip away from the tissue, back to the point before it."""
        self.ask("target", "position", target_m=tuple(front))
        self.wait(self._file.stop.within_s, lambda state: (state.force_N or 0.0) < 0.5 * self._contact_N)

    def _missed(self, touch: TouchResult) -> list[str]:
        tolerance, missed = self._file.tolerance, []
        if abs(touch.mean_force_N - touch.force_N) > tolerance.force_N:
            missed.append(f"mean force {touch.mean_force_N:.3f} N, wanted {touch.force_N:g} within {tolerance.force_N:g} N")
        if touch.contact_loss_share > tolerance.contact_loss_share:
            missed.append(
                f"contact lost for {100 * touch.contact_loss_share:.0f} % of the time, "
                f"wanted at most {100 * tolerance.contact_loss_share:g} %"
            )
        if touch.tip_error_m is None:
            missed.append("no pose of the tip came")
        elif touch.tip_error_m > tolerance.point_m:
            missed.append(f"tip {1e3 * touch.tip_error_m:.1f} mm off, wanted at most {1e3 * tolerance.point_m:g} mm")
        return missed

    def _figures(self, action: Action, states: list[RigState], contact_after_s: float) -> TouchResult:
        """Return the figures of a touch from the loop's states (100 Hz)."""
        time_s = np.array([state.stamp_ns for state in states]) * 1e-9
        force_N = np.array([state.force_N or 0.0 for state in states])
        if len(states) < 3:
            raise StepFailed("too few states of the loop came during the touch")
        step_s = np.diff(time_s, prepend=time_s[0])
        settled = time_s - time_s[0] >= min(self._file.settle_s, 0.5 * (time_s[-1] - time_s[0]))
        lost = force_N < self._contact_N
        integral_Ns = float(np.sum(force_N * step_s))
        every = max(1, round(1.0 / (TRACE_HZ * max(float(np.median(step_s[1:])), 1e-3))))
        duration_s = float(time_s[-1] - time_s[0])
        return TouchResult(
            force_N=action.force_N,
            mean_force_N=float(np.mean(force_N[settled])),
            rms_error_N=float(np.sqrt(np.mean((force_N[settled] - action.force_N) ** 2))),
            peak_force_N=float(np.max(force_N)),
            seconds=duration_s,
            force_time_integral_Ns=integral_Ns,
            force_time_integral_gs=integral_Ns / GRAM_N,
            contact_loss_s=float(np.sum(step_s[lost])),
            contact_loss_share=float(np.sum(step_s[lost])) / max(duration_s, 1e-9),
            longest_loss_s=_longest(lost, step_s),
            tip_error_m=self._across_m(action, int(1e9 * time_s[settled][0])),
            contact_after_s=contact_after_s,
            trace_time_s=tuple(float(v) for v in np.round(time_s[::every] - time_s[0], 3)),
            trace_force_N=tuple(float(v) for v in np.round(force_N[::every], 4)),
        )

    def _across_m(self, action: Action, since_ns: int) -> float | None:
        """Return how far the tracker's mean tip since then is from the point, across the normal, m; None without poses."""
        tips = np.array([pose.position_m for pose in self._poses if pose.stamp_ns >= since_ns])
        if not len(tips):
            return None
        normal = np.array(action.normal)
        across = tips.mean(axis=0) - np.array(action.point_m)
        return float(np.linalg.norm(across - normal * float(across @ normal)))


def _longest(lost: np.ndarray, step_s: np.ndarray) -> float:
    longest = now = 0.0
    for gone, seconds in zip(lost, step_s, strict=True):
        now = now + float(seconds) if gone else 0.0
        longest = max(longest, now)
    return longest


def _result(action: Action, verdict: str, says: str, **figures: Any) -> ActionResult:
    return ActionResult(id=action.id, kind=action.kind, verdict=verdict, says=says, started_s=0.0, seconds=0.0, **figures)


class Job(NamedTuple):
    """A protocol to be run: its steps, the rig, the folder of results, and the results of an earlier run."""

    protocol: ScriptedProtocol
    rig: Rig
    target: Path
    earlier: tuple[ActionResult, ...] = ()


def carry_out(job: Job, driven: DrivenRig, blank: ProtocolResult, progress: Progress) -> ProtocolResult:
    """Run the remaining actions on an armed rig. The result is written to `job.target` (JSON) after each action."""
    file = job.protocol.file
    run = _Run(file, driven, job.rig.control.contact_force_N)
    kept = {item.id: item for item in job.earlier if item.verdict != FAILED}
    results: list[ActionResult] = []
    result = blank
    stopping = {"failed": (FAILED,), "out_of_tolerance": (FAILED, OUT_OF_TOLERANCE), "never": ()}[file.stop.after]
    for number, action in enumerate(job.protocol.actions):
        progress(f"step {action.id} {action.kind}", number / len(job.protocol.actions))
        done = kept.get(action.id)
        results.append(done if done is not None else run.do(action))
        newest = results[-1]
        ends = done is None and (newest.verdict in stopping or run.look().mode in ENDED)
        ended = f"step {newest.id}: {newest.says}" if ends else ""
        result = msgspec.structs.replace(blank, results=tuple(results), ended=ended)
        write_result(result, job.target)
        if ends:
            break
    if run.look().mode not in ENDED:
        driven.give("hold")
    progress("protocol", 1.0)
    return result


def new_result_path(directory: Path) -> Path:
    """Return a file name for a result in `directory` that is not taken."""
    return new_recording_path(directory, "protocol-result").with_suffix(".json")


def write_result(result: ProtocolResult, target: Path) -> None:
    """Write the result as JSON, so that a crash leaves the one before it."""
    part = target.with_suffix(".part")
    part.write_text(json.dumps(plain(result.as_json()), allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, target)


def read_result(path: Path, protocol: ScriptedProtocol) -> tuple[ActionResult, ...]:
    """Return the results of an earlier run of the same protocol. Raises InputError where it is none, or of another."""
    wanted = "the JSON file of an earlier run of this protocol"
    data = json_of(read_text(path, "--resume", wanted), path, "--resume", wanted)
    try:
        data.pop("summary", None)
        result = msgspec.convert(data, ProtocolResult)
    except (ValueError, TypeError):
        raise InputError("--resume", str(path), wanted) from None
    if result.sha256 != protocol.sha256:
        raise InputError("--resume", Description(f"{path}, of another protocol or another version of it"), wanted)
    return result.results


def blank_result(job: Job, simulated: bool, recording: str = "") -> ProtocolResult:
    """Return the result before the first action."""
    return ProtocolResult(
        protocol=job.protocol.file.name,
        sha256=job.protocol.sha256,
        rig=job.rig.name,
        simulated=simulated,
        actions_planned=len(job.protocol.actions),
        recording=recording,
    )


# --- the two kinds of rig ---


class SimulatedDrive:
    """A simulated rig in lock step (`sim.scenario.Scenario`). The operator of a simulation always confirms."""

    def __init__(self, scenario: Scenario, publish: Callable[[str, Message], None]) -> None:
        self._scenario, self._publish = scenario, publish
        self._states: list[RigState] = []
        self._poses: list[Pose] = []

    def take(self, message: Message) -> None:
        """Keep a state, or a pose of the tip, that the loop published."""
        if isinstance(message, RigState):
            self._states.append(message)
        elif isinstance(message, Pose):
            self._poses.append(message)

    def poses(self) -> list[Pose]:
        """Return the tracker's poses of the tip since the last call; see DrivenRig.poses."""
        taken, self._poses = self._poses, []
        return taken

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command; see DrivenRig.give."""
        return self._scenario.command(action, target, **fields)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let virtual time pass, with a check at each new state; see DrivenRig.wait."""
        return self._scenario.run(seconds, lambda: bool(self._states) and until())

    def states(self) -> list[RigState]:
        """Return the loop's states since the last call; see DrivenRig.states."""
        taken, self._states = self._states, []
        return taken

    def operator(self, message: str) -> bool:
        """Confirm at once; see DrivenRig.operator."""
        self._scenario.commander.mark(f"operator: {message}"[:500])
        return True

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan; see DrivenRig.publish_step."""
        self._publish("plan", step)


def run_simulated(
    job: Job,
    directory: Path,
    board: str,
    seed: int,
    effects: tuple[str, ...] = (),
    estimator: Estimator | None = None,
    progress: Progress = lambda step, share: None,
) -> ProtocolResult:
    """Run the protocol on the simulated rig in virtual time, recorded into `directory`. Raises InputError, RuntimeError."""
    try:
        plant = simulated_plant(job.rig, seed, effects=tuple(map(parse, effects)))
    except ValueError as error:
        raise InputError.from_sentence(f"--effect: {str(error).partition(': ')[2]}") from None
    path = new_recording_path(directory, "protocol")
    header = header_of(job.rig, "virtual", seed, {"job": job.protocol.file.name})
    with SimulatedBoard(board) as made, RecordingWriter(path, header) as recording:
        world = World(job.rig, plant, made, seed)
        listeners: list[Callable[[Message], None]] = []

        def publish(topic: str, message: Message) -> None:
            recording.write(topic, message, world.now_ns)
            if topic in ("state", "pose/tip"):
                for listener in listeners:
                    listener(message)

        scenario = Scenario(job.rig, world, publish, estimator=estimator)
        driven = SimulatedDrive(scenario, publish)
        listeners.append(driven.take)
        if not scenario.arm():
            raise RuntimeError("devices not ready")
        result = carry_out(job, driven, blank_result(job, True, str(path)), progress)
        scenario.command("disarm")
        scenario.run(0.1)
    return result


class LiveDrive:
    """The running rig over zenoh. ask_operator: shows a message and returns whether to continue."""

    def __init__(self, session: Session, commander: Commander, ask_operator: Callable[[str], bool]) -> None:
        self._commander, self._ask = commander, ask_operator
        self._steps = session.publisher("plan")
        self._subscriber = session.zenoh.declare_subscriber(key(session.rig, "state"), zenoh.handlers.RingChannel(1024))
        self._pose_subscriber = session.zenoh.declare_subscriber(
            key(session.rig, "pose/tip"), zenoh.handlers.RingChannel(512)
        )

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """Give one command over zenoh; see DrivenRig.give."""
        return self._commander.give(action, target, **fields)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait, with a check every 10 ms; see DrivenRig.wait. Raises StepFailed if the lease was lost."""
        end_s = time.monotonic() + seconds
        while True:
            if until():
                return True
            if time.monotonic() >= end_s:
                return False
            if self._commander.lost:
                raise StepFailed(f"lease lost: {self._commander.lost}")
            time.sleep(0.01)

    def states(self) -> list[RigState]:
        """Return the loop's states since the last call; see DrivenRig.states. Malformed ones are omitted."""
        return _taken(self._subscriber, RigState)

    def poses(self) -> list[Pose]:
        """Return the tracker's poses since the last call; see DrivenRig.poses. Malformed ones are omitted."""
        return _taken(self._pose_subscriber, Pose)

    def operator(self, message: str) -> bool:
        """Ask the operator; see DrivenRig.operator."""
        return self._ask(message)

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan; see DrivenRig.publish_step."""
        self._steps.put(step)


def _taken(subscriber: Any, kind: type[MessageType]) -> list[MessageType]:
    taken: list[MessageType] = []
    while (sample := subscriber.try_recv()) is not None:
        try:
            taken.append(decode(kind, bytes(sample.payload)))
        except ValueError:
            continue
    return taken


def run_live(job: Job, ask_operator: Callable[[str], bool], progress: Progress = lambda step, share: None) -> ProtocolResult:
    """Run the protocol on the running rig of the rig file; its services record. Raises RuntimeError.

    The rig is armed where it is disarmed. At the end, and on Ctrl-C, it holds and is left armed.
    """
    with Session.of_rig(job.rig) as session, Commander(session, "protocol") as commander:
        driven = LiveDrive(session, commander, ask_operator)
        newest: list[RigState] = []

        def came() -> bool:
            newest.extend(driven.states())
            return bool(newest)

        patience_s = STATES_WITHIN_S if may_run(job.rig) else NOT_RUNNING_S
        if not driven.wait(patience_s, came):
            raise RuntimeError(f"no message of the topic state from the rig within {patience_s:g} s; check that it runs")
        taken = commander.take()
        if not taken.accepted:
            raise RuntimeError(f"lease: {taken.reason}")
        if newest[-1].mode == "disarmed":
            armed = commander.arm()
            if not armed.accepted or not driven.wait(ARM_WITHIN_S, lambda: came() and newest[-1].mode == "hold"):
                raise RuntimeError(f"not armed: {armed.reason or 'the loop does not hold'}")
        try:
            return carry_out(job, driven, blank_result(job, False), progress)
        except BaseException:
            commander.hold()
            raise


__all__ = ["Job", "ProtocolResult", "carry_out", "read_result", "run_live", "run_simulated", "write_result"]
