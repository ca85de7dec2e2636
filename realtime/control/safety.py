"""The failsafe decision: a pure function from the causes that stand to the safety action."""

from __future__ import annotations

from numba import njit

from realtime.control.codes import ACTION_HOLD, ACTION_NONE, ACTION_RETRACT, ACTION_STOP, ACTION_WARN

# (name, action, whether it latches until the operator clears it, message for the operator)
CAUSES: tuple[tuple[str, int, bool, str], ...] = (
    ("pose_rejected", ACTION_WARN, False, "a pose was not finite, out of the workspace or too fast; it was not used"),
    ("force_rejected", ACTION_WARN, False, "a force reading was not finite or out of the sensor's range; it was not used"),
    ("pose_stale", ACTION_HOLD, False, "no fresh pose from the tracker: holding"),
    ("poses_wild", ACTION_HOLD, False, "three poses in a row rejected: holding; check the tracker"),
    ("force_stale", ACTION_HOLD, False, "no fresh force while in contact: holding; check the force sensor"),
    ("over_force", ACTION_RETRACT, True, "contact force above the limit: retracting"),
    ("pose_lost", ACTION_STOP, True, "no pose for longer than the limit: stopped; check the tracker, then clear"),
    ("force_lost", ACTION_RETRACT, True, "no force for longer than the limit while in contact: retracting"),
    ("board_silent", ACTION_STOP, True, "no status from the stepper board: stopped; check cable and power, then clear"),
    ("board_fault", ACTION_STOP, True, "the stepper board latched a fault: stopped; see its fault code, then clear"),
    ("operator_stop", ACTION_STOP, True, "stopped by the operator"),
    (
        "steps_lost",
        ACTION_RETRACT,
        True,
        "encoder and steps disagree: retracting; look for a jam or a loose encoder plug, clear, and home the axes",
    ),
    (
        "force_disagrees",
        ACTION_RETRACT,
        True,
        "force sensor, estimate and tip deflection disagree: retracting; check and zero the sensor",
    ),
    (
        "force_handover",
        ACTION_WARN,
        False,
        "the force sensor sends nothing or is frozen: the estimate closes the loop",
    ),
    (
        "force_undecided",
        ACTION_HOLD,
        False,
        "force sensor, estimate and tip deflection disagree: holding until it is clear which is wrong",
    ),
    ("host_silent", ACTION_HOLD, False, "the model process does not answer: holding; see that it runs"),
    ("host_lost", ACTION_RETRACT, True, "the model process did not come back in time: retracting; start it, then clear"),
    (
        "force_unreached",
        ACTION_WARN,
        False,
        "the requested force is not reached, because the catheter gives way: request less, or expose less of the catheter",
    ),
    ("still_pressed", ACTION_WARN, False, "a force remains on the stopped tip: pull the catheter back by hand"),
    (
        "body_contact",
        ACTION_WARN,
        False,
        "the catheter's body touches something: the estimated force is not that of the tip; see the topic contact for where",
    ),
    (
        "tracker_moved",
        ACTION_RETRACT,
        True,
        "tracker or sheath moved against the rig, or the catheter slips in its holder: retracting; fix it, register the "
        "tracker again, then clear",
    ),
)
CAUSE_BIT = {name: 1 << index for index, (name, _, _, _) in enumerate(CAUSES)}
(
    POSE_REJECTED,
    FORCE_REJECTED,
    POSE_STALE,
    POSES_WILD,
    FORCE_STALE,
    OVER_FORCE,
    POSE_LOST,
    FORCE_LOST,
    BOARD_SILENT,
    BOARD_FAULT,
    OPERATOR_STOP,
    STEPS_LOST,
    FORCE_DISAGREES,
    FORCE_HANDOVER,
    FORCE_UNDECIDED,
    HOST_SILENT,
    HOST_LOST,
    FORCE_UNREACHED,
    STILL_PRESSED,
    BODY_CONTACT,
    TRACKER_MOVED,
) = (1 << index for index in range(len(CAUSES)))
LATCHING = sum(1 << index for index, cause in enumerate(CAUSES) if cause[2])

_HOLD_BITS = POSE_STALE | POSES_WILD | FORCE_STALE | FORCE_UNDECIDED | HOST_SILENT
_RETRACT_BITS = OVER_FORCE | FORCE_LOST | FORCE_DISAGREES | STEPS_LOST | HOST_LOST | TRACKER_MOVED
# With these the board does not move the stages, whatever is sent.
BOARD_BITS = BOARD_SILENT | BOARD_FAULT
# These may be followed by a force within milliseconds: the catheter is taken away at full speed.
URGENT_BITS = OVER_FORCE | STEPS_LOST | TRACKER_MOVED
_STOP_BITS = POSE_LOST | BOARD_SILENT | BOARD_FAULT | OPERATOR_STOP


@njit(cache=True)
def action_of(flags: int) -> int:
    """Return the strongest action of the causes in the bit set `flags`."""
    if flags & _STOP_BITS:
        return ACTION_STOP
    if flags & _RETRACT_BITS:
        return ACTION_RETRACT
    if flags & _HOLD_BITS:
        return ACTION_HOLD
    if flags != 0:
        return ACTION_WARN
    return ACTION_NONE


@njit(cache=True)
def decide(flags: int, latched: int, clear: bool) -> tuple[int, int]:
    """Return the safety action and the latched causes.

    flags: causes that stand at this tick (bit set of CAUSES); latched: those kept from earlier ticks;
    clear: the operator clears. Returns (action, latched). A cause that still stands is never cleared,
    so an action never weakens while its cause stands.
    """
    if clear:
        latched = 0
    latched |= flags & LATCHING
    return action_of(flags | latched), latched


def messages(flags: int) -> list[str]:
    """Return the messages of all causes in the bit set `flags`, strongest first."""
    standing = [cause for index, cause in enumerate(CAUSES) if flags & (1 << index)]
    return [cause[3] for cause in sorted(standing, key=lambda cause: -cause[1])]


def names(flags: int) -> list[str]:
    """Return the names of all causes in the bit set `flags`."""
    return [cause[0] for index, cause in enumerate(CAUSES) if flags & (1 << index)]
