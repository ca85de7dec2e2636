"""The codes of `protocol.enums` as plain integers: compiled kernels compare these, everything else uses the enums."""

from __future__ import annotations

from protocol.enums import BoardState, CommandKind, ControlLaw, ForceSource, JogAxis, Phase, SafetyAction

(
    PHASE_DISARMED,
    PHASE_HOLD,
    PHASE_POSITION,
    PHASE_APPROACH,
    PHASE_CONTACT,
    PHASE_RETRACT,
    PHASE_STOPPED,
    PHASE_JOG,
) = (int(phase) for phase in Phase if phase is not Phase.HOMING)  # in a homing the loop is disarmed
ACTION_NONE, ACTION_WARN, ACTION_HOLD, ACTION_RETRACT, ACTION_STOP = (int(action) for action in SafetyAction)
(
    COMMAND_NONE,
    COMMAND_HOLD,
    COMMAND_POSITION,
    COMMAND_CONTACT,
    COMMAND_RETRACT,
    COMMAND_STOP,
    COMMAND_JOG,
) = (int(kind) for kind in CommandKind)
JOG_INSERTION, JOG_TIP = int(JogAxis.INSERTION), int(JogAxis.TIP)
SOURCE_SENSOR, SOURCE_ESTIMATE = (int(source) for source in ForceSource)
LAW_THESIS, LAW_PREDICTIVE = (int(law) for law in ControlLaw)
BOARD_FAULT = int(BoardState.FAULT)
