"""What each command does: arm the board and the loop, set targets, stop, clear. Nothing arms by itself.

Whether a command may be given at all, by whom and how fresh, was checked before (`realtime.core.command_gate`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.enums import CommandKind, ForceSource, JogAxis, Phase, SafetyAction
from protocol.errors import InputError
from protocol.jog_limits import LONGEST_JOG, fastest_jog, unit_of
from protocol.rig_file import AXES, Rig
from protocol.serial_frames import Fault
from protocol.topics import Command, Reply
from realtime.control import safety
from realtime.core.home_run import HomeRun
from realtime.core.reach import TargetReach
from realtime.drivers.stepper_board import LinkPhase, StepperBoardLink

_KINDS = {kind.label: kind for kind in CommandKind}
# The loop leaves a stop, and the stop that ends a retraction, by disarming only (`realtime/control/tick.py`).
_STOPPED = "found the loop stopped, wanted it to hold or to move; disarm and arm again"
_DISARMED = "found the rig disarmed, wanted armed; arm it first"
_JOG_PHASES = (Phase.HOLD, Phase.POSITION, Phase.JOG)
# A tick this long after a clear has acted on it.
CLEARED_WITHIN_NS = 20_000_000
_ZERO_PHASES = (Phase.DISARMED, Phase.HOLD, Phase.STOPPED)


class RigPosition(NamedTuple):
    """State of the rig after the newest tick.

    phase; tip_m and goal_m (3,), predicted tip and moving goal; stage_unit (3,), the set-point; force_N (3,), on the tissue;
    causes, the bit set of `realtime.control.safety` that stands or is latched; now_ns, time of the tick.
    """

    phase: Phase = Phase.DISARMED
    tip_m: npt.NDArray[np.float64] = np.zeros(3)
    goal_m: npt.NDArray[np.float64] = np.zeros(3)
    stage_unit: npt.NDArray[np.float64] = np.zeros(3)
    force_N: npt.NDArray[np.float64] = np.zeros(3)
    causes: int = 0
    now_ns: int = 0


class OperatorCommands:
    """Turns commands into the tick's COMMAND record and into frames for the board.

    Args:
        rig: the rig file.
        record: the COMMAND record that the tick reads; its `count` rises with each command that the tick has to act on.
        link: the link to the board.
        silent_sensors: names the sensors that send nothing, empty when all do; asked before arming.
        standing: where the rig stands; asked before a jog and before the force sensor is zeroed.
        zero_force: makes the sensor's present load its zero; returns why it cannot, empty when it did.
    """

    def __init__(
        self,
        rig: Rig,
        record: np.record,
        link: StepperBoardLink,
        silent_sensors: Callable[[], str] = lambda: "",
        standing: Callable[[], RigPosition] = RigPosition,
        zero_force: Callable[[], str] = lambda: "",
    ) -> None:
        self._rig, self._record, self._link, self._silent_sensors = rig, record, link, silent_sensors
        self._standing, self._zero_force = standing, zero_force
        self._frames: list[bytes] = []
        self.homing: HomeRun | None = None
        self._clears_board = False
        self._cleared_ns = self._now_ns = 0
        self._reach = TargetReach(rig)
        record.normal[:] = (0.0, 0.0, -1.0)

    def prepare(self) -> None:
        """Compile what judges a target."""
        low, high = self._rig.safety.workspace_min_m, self._rig.safety.workspace_max_m
        self._reach.problem(tuple(0.5 * (least + most) for least, most in zip(low, high, strict=True)))

    @property
    def armed(self) -> bool:
        """Return whether the loop is to be armed."""
        return bool(self._record.armed)

    def take_frames(self) -> list[bytes]:
        """Return the frames for the board since the last call, in order."""
        frames, self._frames = self._frames, []
        return frames

    def set_watched_causes(self, causes: int) -> None:
        """Pass the causes that the supervision found to the tick: a bit set of `realtime.control.safety`."""
        self._record.watch = causes

    def take_board_status(self) -> bool:
        """Clear the loop's causes once more when the board is ready and reports no fault; return whether it was so.

        At the time of the command the fault still stood, and a cause that stands is never cleared.
        """
        status = self._link.status
        gone = self._link.phase is LinkPhase.READY and status is not None and status.fault == Fault.NONE
        if not (self._clears_board and gone):
            return False
        self._clears_board = False
        self._record.clear += 1
        return True

    def execute(self, command: Command, now_ns: int) -> Reply:
        """Carry out `command` at `now_ns` (ns) or refuse it; a refused command changes nothing."""
        self._now_ns = now_ns
        actions = {
            "arm": self._arm,
            "disarm": self._disarm,
            "stop": self._stop,
            "clear_fault": self._clear_fault,
            "target": self._target,
            "hold": self._hold,
            "force": self._force,
            "jog": self._jog,
            "zero": self._zero,
            "home": self._home,
            "mark": lambda command: "",  # it is in the log; nothing else happens
        }
        problem = actions[command.action](command)
        return Reply(stamp_ns=now_ns, id=command.id, result="refused" if problem else "accepted", text=problem)

    def device_returned(self, device: str, force_source: ForceSource, phase: Phase) -> str:
        """Disarm, because `device` was lost and is back. Return a line for the log, empty if nothing was armed.

        A force sensor that the estimate has replaced in contact does not disarm: the loop never lost the force, and uses
        the sensor again when both agree (`force_source.py`). force_source and phase are those of the newest tick.
        """
        replaced = device == self._rig.force_sensor.kind and force_source is ForceSource.ESTIMATE and phase is Phase.CONTACT
        if not self._record.armed or replaced:
            return ""
        self.disarm()
        return f"{device} is back: disarmed, to be armed again"

    def _set(self, kind: CommandKind) -> None:
        self._record.kind = kind
        self._record.count += 1

    def disarm(self) -> None:
        """Disarm the loop and the board; a homing ends."""
        self._end_homing()
        self._record.armed = 0
        self._set(CommandKind.HOLD)
        self._frames.append(self._link.disarm())

    def _arm(self, command: Command) -> str:
        if self._link.phase is not LinkPhase.READY:
            return f"found the board link in phase {self._link.phase.value}, wanted ready"
        if self._link.status is not None and self._link.status.fault != Fault.NONE:
            return f"found board fault {Fault(self._link.status.fault).name}, wanted none; clear it first"
        if self._record.armed:
            return "found the rig armed, wanted disarmed"
        if self.homing is not None:
            return f"found {self.homing.axis} being homed, wanted the rig disarmed and at rest"
        standing = self._standing()
        causes = standing.causes & ~safety.OPERATOR_STOP  # that one ends as the rig is disarmed
        seen = standing.now_ns > self._cleared_ns + CLEARED_WITHIN_NS
        if seen and safety.action_of(causes) >= SafetyAction.RETRACT:
            return f"found {', '.join(safety.names(causes))}, wanted no cause that stops the rig; clear it first"
        silent = self._silent_sensors()
        if silent:
            return f"found nothing from {silent}, wanted fresh readings"
        self._frames.append(self._link.arm())
        self._record.armed = 1
        self._set(CommandKind.HOLD)
        return ""

    def _disarm(self, command: Command) -> str:
        self.disarm()
        return ""

    def _stop(self, command: Command) -> str:
        self._end_homing()
        self._set(CommandKind.STOP)
        return ""

    def _clear_fault(self, command: Command) -> str:
        """Clear the loop's latched causes and the board's fault, and leave both disarmed."""
        self.disarm()
        self._record.clear += 1
        self._cleared_ns = self._now_ns
        self._clears_board = True
        if self._link.phase in (LinkPhase.RESET, LinkPhase.MISMATCH):
            self._link.restart()
        elif self._link.status is not None and self._link.status.fault != Fault.NONE:
            self._frames.append(self._link.clear_fault(command.fault or self._link.status.fault))
        return ""

    def _hold(self, command: Command) -> str:
        if self.homing is not None:
            self._end_homing()
            return ""
        if not self._record.armed:
            return _DISARMED
        self._set(CommandKind.HOLD)
        return ""

    def _force(self, command: Command) -> str:
        """Set another force for the present contact target; nothing else changes, so that the count stays."""
        if not self._record.armed or self._record.kind != CommandKind.CONTACT:
            return "found no touch in progress, wanted one; touch the tissue first"
        problem = self._too_much(command)
        if not problem and command.force_N is not None:
            self._record.force_N = command.force_N
        return problem

    def _target(self, command: Command) -> str:
        if not self._record.armed:
            return _DISARMED
        if self._standing().phase is Phase.STOPPED:
            return _STOPPED
        problem = self._too_much(command) or ("" if command.target_m is None else self._reach.problem(command.target_m))
        if problem:
            return problem
        if command.target_m is not None:
            self._record.target_m[:] = command.target_m
        if command.normal is not None:
            self._record.normal[:] = -np.asarray(command.normal)
        if command.force_N is not None:
            self._record.force_N = command.force_N
        self._set(_KINDS[command.target])
        return ""

    def _jog(self, command: Command) -> str:
        """Start or extend a jog, or return the limit that forbids it."""
        if not self._record.armed:
            return _DISARMED
        axis, travel, speed = JogAxis[command.axis.upper()], command.travel_unit or 0.0, command.speed_unit_per_s or 0.0
        here = self._standing()
        if here.phase is Phase.STOPPED:
            return _STOPPED
        if here.phase not in _JOG_PHASES:
            return f"found the loop in phase {here.phase.label}, wanted hold, position or jog; hold first"
        direction = np.array(command.direction if command.direction is not None else (0.0, 0.0, 0.0))
        problem = (
            self._too_far(axis, travel, speed)
            or self._pressing(axis, travel, direction, here)
            or self._beyond(axis, travel, direction, here)
        )
        if problem:
            return problem
        record = self._record
        record.jog_axis, record.jog_travel, record.jog_speed = axis, travel, speed
        record.jog_direction[:] = direction
        self._set(CommandKind.JOG)
        return ""

    def _too_far(self, axis: JogAxis, travel: float, speed: float) -> str:
        unit, fastest = unit_of(axis), fastest_jog(self._rig, axis)
        if not abs(travel) <= LONGEST_JOG[axis]:
            return f"travel: found {travel:g} {unit}, wanted at most {LONGEST_JOG[axis]:g} {unit} in one jog"
        if not 0.0 < speed <= fastest * (1.0 + 1e-9):
            return f"speed: found {speed:g} {unit}/s, wanted above 0 and at most {fastest:g} {unit}/s"
        return ""

    def _pressing(self, axis: JogAxis, travel: float, direction: npt.NDArray[np.float64], here: RigPosition) -> str:
        """Return the reason if the tip presses on something and this jog does not lead away from it; empty otherwise."""
        force_N = float(np.linalg.norm(here.force_N))
        if force_N <= self._rig.control.contact_force_N:
            return ""
        backwards = axis is JogAxis.INSERTION and travel < 0.0
        away = axis is JogAxis.TIP and travel * float(direction @ here.force_N) < 0.0
        if backwards or away:
            return ""
        return (
            f"found a force of {force_N:.3f} N on the tip, wanted a jog away from it, or less than "
            f"control.contact_force_N {self._rig.control.contact_force_N}; zero the sensor if the tip hangs free"
        )

    def _beyond(self, axis: JogAxis, travel: float, direction: npt.NDArray[np.float64], here: RigPosition) -> str:
        """Return the limit that the jog would exceed: workspace and reach for the tip, travel for an axis; empty if none."""
        if axis is JogAxis.TIP:
            start_m = here.goal_m if here.phase is Phase.JOG else here.tip_m
            return self._reach.problem(tuple(float(value) for value in start_m + travel * direction))
        slopes = (self._rig.transmission.insertion_slope, self._rig.transmission.roll_slope, 1.0)
        stage, end = self._rig.stage(int(axis)), float(here.stage_unit[axis]) + travel / slopes[axis]
        if stage.min_unit <= end <= stage.max_unit:
            return ""
        unit = unit_of(axis)
        return (
            f"found {axis.label} {end:.4f} {unit} at the end of the jog, "
            f"wanted {stage.min_unit:g} to {stage.max_unit:g} {unit} (the stage's travel)"
        )

    def _zero(self, command: Command) -> str:
        phase = self._standing().phase
        if phase not in _ZERO_PHASES:
            return f"found the loop in phase {phase.label}, wanted disarmed, hold or stopped, with the tip hanging free"
        return self._zero_force()

    def _home(self, command: Command) -> str:
        """Start to move an axis to its switch, or return the reason against it. Stop, hold and disarm end the motion."""
        axis = AXES.index(command.axis)
        if self._record.armed:
            return "found the rig armed, wanted disarmed"
        if self.homing is not None:
            return f"found {self.homing.axis} being homed, wanted one axis at a time"
        if self._link.phase is not LinkPhase.READY:
            return f"found the board link in phase {self._link.phase.value}, wanted ready"
        if self._link.status is None or self._link.status.fault != Fault.NONE:
            fault = "no status" if self._link.status is None else f"fault {Fault(self._link.status.fault).name}"
            return f"found {fault} of the board, wanted none of its faults; clear it first"
        force_N = float(np.linalg.norm(self._standing().force_N))
        if force_N > self._rig.control.contact_force_N:
            return (
                f"found a force of {force_N:.3f} N on the tip, wanted less than control.contact_force_N "
                f"{self._rig.control.contact_force_N}; zero the sensor if the tip hangs free"
            )
        try:
            self.homing = HomeRun(self._rig, self._link, axis)
        except InputError as error:
            return str(error)
        return ""

    def _end_homing(self) -> None:
        if self.homing is not None:
            self.homing.end("ended by the operator")

    def _too_much(self, command: Command) -> str:
        limit_N = self._rig.safety.over_force_N
        if command.force_N is not None and command.force_N >= limit_N:
            return f"force_N: found {command.force_N}, wanted below safety.over_force_N {limit_N}"
        return ""
