"""What each command does: arm the board and the loop, set targets, stop, clear. Nothing arms by itself.

Whether a command may be given at all, by whom and how fresh, was checked before (`realtime.core.command_gate`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from protocol.enums import CommandKind, ForceSource, Phase
from protocol.messages import Vector
from protocol.rig_file import Rig
from protocol.serial_frames import Fault
from protocol.topics import Command, Reply
from realtime.control import inverse_kinematics
from realtime.control.configure import tick_parameters
from realtime.drivers.stepper_board import LinkPhase, StepperBoardLink

# A target may be out of reach by no more than this: the calibration is not better known.
REACH_m = 0.001
FORCE_BOX = "net_ft"  # as the driver names it in its events
_KINDS = {kind.label: kind for kind in CommandKind}


class OperatorCommands:
    """Turns commands into the tick's COMMAND record and into frames for the board.

    Args:
        rig: the rig file.
        record: the COMMAND record that the tick reads; its `count` rises with each command that the tick has to act on.
        link: the link to the board.
        silent_sensors: names the sensors that send nothing, empty when all do; asked before arming.
    """

    def __init__(
        self, rig: Rig, record: np.record, link: StepperBoardLink, silent_sensors: Callable[[], str] = lambda: ""
    ) -> None:
        self._rig, self._record, self._link, self._silent_sensors = rig, record, link, silent_sensors
        self._frames: list[bytes] = []
        self._kinematics = tick_parameters(rig)[0].kinematics
        record.normal[:] = (0.0, 0.0, -1.0)

    @property
    def armed(self) -> bool:
        """Whether the loop is to be armed."""
        return bool(self._record.armed)

    def take_frames(self) -> list[bytes]:
        """Return the frames for the board since the last call, in order."""
        frames, self._frames = self._frames, []
        return frames

    def set_watched_causes(self, causes: int) -> None:
        """Hand the causes that the supervision found to the tick: a bit set of `realtime.control.safety`."""
        self._record.watch = causes

    def execute(self, command: Command, now_ns: int) -> Reply:
        """Carry out `command` at `now_ns` (ns) or refuse it; a refused command changes nothing."""
        actions = {
            "arm": self._arm,
            "disarm": self._disarm,
            "stop": self._stop,
            "clear_fault": self._clear_fault,
            "target": self._target,
            "hold": self._hold,
            "force": self._force,
        }
        problem = actions[command.action](command)
        return Reply(stamp_ns=now_ns, id=command.id, result="refused" if problem else "accepted", text=problem)

    def device_returned(self, device: str, force_source: ForceSource, phase: Phase) -> str:
        """Disarm, because `device` was lost and is back. Return a line for the log, empty where nothing was armed.

        A force sensor that the estimate has replaced in contact does not disarm: the loop never lost the force, and uses
        the sensor again when both agree (`force_source.py`). force_source and phase are those of the newest tick.
        """
        replaced = device == FORCE_BOX and force_source is ForceSource.ESTIMATE and phase is Phase.CONTACT
        if not self._record.armed or replaced:
            return ""
        self.disarm()
        return f"{device} is back: disarmed, to be armed again"

    def _set(self, kind: CommandKind) -> None:
        self._record.kind = kind
        self._record.count += 1

    def disarm(self) -> None:
        """Disarm the loop and the board."""
        self._record.armed = 0
        self._set(CommandKind.HOLD)
        self._frames.append(self._link.disarm())

    def _arm(self, command: Command) -> str:
        if self._link.phase is not LinkPhase.READY:
            return f"arm: found the board link in phase {self._link.phase.value}, wanted ready"
        if self._link.status is not None and self._link.status.fault != Fault.NONE:
            return f"arm: found board fault {Fault(self._link.status.fault).name}, wanted none; clear it first"
        if self._record.armed:
            return "arm: found the rig armed, wanted disarmed"
        silent = self._silent_sensors()
        if silent:
            return f"arm: found nothing from {silent}, wanted fresh readings"
        self._frames.append(self._link.arm())
        self._record.armed = 1
        self._set(CommandKind.HOLD)
        return ""

    def _disarm(self, command: Command) -> str:
        self.disarm()
        return ""

    def _stop(self, command: Command) -> str:
        self._set(CommandKind.STOP)
        return ""

    def _clear_fault(self, command: Command) -> str:
        """Clear the loop's latched causes and the board's fault, and leave both disarmed."""
        self.disarm()
        self._record.clear += 1
        if self._link.phase in (LinkPhase.RESET, LinkPhase.MISMATCH):
            self._link.restart()
        elif self._link.status is not None and self._link.status.fault != Fault.NONE:
            self._frames.append(self._link.clear_fault(command.fault or self._link.status.fault))
        return ""

    def _hold(self, command: Command) -> str:
        if not self._record.armed:
            return "hold: found the rig disarmed, wanted armed"
        self._set(CommandKind.HOLD)
        return ""

    def _force(self, command: Command) -> str:
        """Set another force for the present contact target; nothing else changes, so that the count stays."""
        if not self._record.armed or self._record.kind != CommandKind.CONTACT:
            return "force: found no contact target, wanted the command target contact before"
        problem = self._too_much(command)
        if not problem and command.force_N is not None:
            self._record.force_N = command.force_N
        return problem

    def _target(self, command: Command) -> str:
        if not self._record.armed:
            return "target: found the rig disarmed, wanted armed"
        problem = self._too_much(command) or ("" if command.target_m is None else self._outside(command.target_m))
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

    def _too_much(self, command: Command) -> str:
        limit_N = self._rig.safety.over_force_N
        if command.force_N is not None and command.force_N >= limit_N:
            return f"force_N: found {command.force_N}, wanted below safety.over_force_N {limit_N}"
        return ""

    def _outside(self, target_m: Vector) -> str:
        low, high = self._rig.safety.workspace_min_m, self._rig.safety.workspace_max_m
        for axis, value, least, most in zip("xyz", target_m, low, high, strict=True):
            if not least <= value <= most:
                return f"target_m: found {axis} = {value}, wanted {least} to {most} (safety.workspace)"
        insertion, transmission = self._rig.stages.insertion, self._rig.transmission
        # Half the backlash on either side: the body may stand anywhere in it.
        half_m = 0.5 * transmission.insertion_backlash_m
        least_m, most_m = (
            transmission.insertion_at_home_m + transmission.insertion_slope * unit + side * half_m
            for unit, side in ((insertion.min_unit, -1.0), (insertion.max_unit, 1.0))
        )
        off_m = inverse_kinematics.out_of_reach_m(
            self._kinematics, np.asarray(target_m, float), least_m, most_m, self._rig.stages.knob.max_unit
        )
        if not off_m <= REACH_m:
            return (
                f"target_m: found {tuple(target_m)}, wanted a point that the unloaded tip can reach: "
                f"it comes no nearer than {off_m * 1e3:.1f} mm"
            )
        return ""
