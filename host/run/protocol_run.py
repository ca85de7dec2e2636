"""Carries out a protocol on a rig that is armed: step by step, judged against its tolerances, resumable after a stop."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from host.navigation.request import PlanAnswer
from host.run.protocol_file import Action, ProtocolFile, ScriptedProtocol, before
from host.run.protocol_result import FAILED, OK, OUT_OF_TOLERANCE, ActionResult, ProtocolResult, TouchResult, write_result
from protocol.commander import Acknowledgement
from protocol.rig_file import Rig
from protocol.topics import PlannedStep, Pose, RigState

THERE_S = 0.3
# Commands of a plan a second: half of what the rig lets through.
PLAN_HZ = 20.0
# After a stop its causes come in within this time; then the first of them is known.
CAUSES_S = 0.3
# Samples of the force a second in a result's trace.
TRACE_HZ = 20.0
GRAM_N = 9.80665e-3
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

    def first_cause(self) -> str:
        """Return the first cause of what holds the rig back, with its remedy; empty if nothing does."""
        ...

    def operator(self, message: str) -> bool:
        """Show `message` and wait for the operator; return False if the protocol is to end."""
        ...

    def publish_step(self, step: PlannedStep) -> None:
        """Publish a step of a plan, for pages and recording."""
        ...


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
            raise StepFailed(self._why_ended())
        return ended

    def _why_ended(self) -> str:
        """Return the phase in which the rig has ended, and the first cause. What followed from it is in the rig's log."""
        mode, causes = self._now.mode, self._now.cause
        with contextlib.suppress(StepFailed):  # a lease that is lost as well
            self._driven.wait(CAUSES_S)
        cause = self._driven.first_cause() or causes
        return f"the rig went to {mode}" + (f": {cause}" if cause else "")

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
    """Run the remaining actions on an armed rig. The result is written to `job.target` (JSON) after each action.

    What interrupts an action, Ctrl-C too, is written as the end of the result and passed on.
    """
    file = job.protocol.file
    run = _Run(file, driven, job.rig.control.contact_force_N)
    kept = {item.id: item for item in job.earlier if item.verdict != FAILED}
    results: list[ActionResult] = []
    result = blank
    stopping = {"failed": (FAILED,), "out_of_tolerance": (FAILED, OUT_OF_TOLERANCE), "never": ()}[file.stop.after]
    for number, action in enumerate(job.protocol.actions):
        progress(f"step {action.id} {action.kind}", number / len(job.protocol.actions))
        done = kept.get(action.id)
        try:
            made = done or msgspec.structs.replace(run.do(action), recording=blank.recording)
        except BaseException as error:
            why = "interrupted" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
            broken_off = msgspec.structs.replace(blank, results=tuple(results), ended=f"step {action.id}: {why}")
            with contextlib.suppress(OSError):
                write_result(broken_off, job.target)
            raise
        results.append(made)
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
