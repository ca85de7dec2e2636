"""The codes that all parts share: phase, safety action, kind of command, force source, control law, board state."""

from __future__ import annotations

import enum


class Code(enum.IntEnum):
    """An integer code with a name for messages and logs."""

    @property
    def label(self) -> str:
        """Return the name as messages, logs and recordings carry it."""
        return self.name.lower()

    @classmethod
    def labels(cls) -> tuple[str, ...]:
        """Return the labels of all members, in the order of their values."""
        return tuple(member.label for member in cls)

    @classmethod
    def label_of(cls, code: int) -> str:
        """Return the label of `code`; a code that has no member is named by its number."""
        return cls(code).label if code in cls._value2member_map_ else f"{cls.__name__} {code}"


class Phase(Code):
    """State of the rig: the control loop's phase, or homing, in which the loop takes no part."""

    DISARMED = 0
    HOLD = 1
    POSITION = 2
    APPROACH = 3
    CONTACT = 4
    RETRACT = 5
    STOPPED = 6
    JOG = 7
    # The loop is disarmed and the realtime core moves one axis to its switch.
    HOMING = 8


class SafetyAction(Code):
    """Action that the failsafe demands, weakest first."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETRACT = 3
    STOP = 4


class CommandKind(Code):
    """Command of the operator to the armed loop. The first five are also the kinds of a target."""

    NONE = 0
    HOLD = 1
    POSITION = 2
    CONTACT = 3
    RETRACT = 4
    STOP = 5
    JOG = 6


class JogAxis(Code):
    """Object of a jog: the tip along a direction, or one axis. The axes are in the order of the rig file."""

    INSERTION = 0
    ROLL = 1
    KNOB = 2
    TIP = 3


class ForceSource(Code):
    """Source of the force that the loop controls."""

    SENSOR = 0
    ESTIMATE = 1


class ControlLaw(Code):
    """Control law: the thesis' PI loops, or the predictive law."""

    THESIS = 0
    PREDICTIVE = 1


class BoardState(Code):
    """What the board is doing."""

    DISARMED = 0  # holds; set-points are refused; the only state that takes a configuration
    ARMED = 1  # holds and waits for the first set-point
    RUNNING = 2  # follows set-points; the deadman runs
    STOPPING = 3  # decelerates to rest, then FAULT or DISARMED
    FAULT = 4  # holds until CLEAR_FAULT names the fault
