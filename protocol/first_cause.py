"""Which cause came first: orders what went wrong by time and by what explains what, and says what to do about it.

A starved computer shows as four faults: the loop is late, so set-points stop, so the board's dead man acts, and poses are
stale when the loop is back. Only the first has a remedy; the others are listed after it. The realtime process publishes
the result (`realtime/core/cause_watch.py`); page, report and terminal show it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import NamedTuple

# An explanation came at most so long before what it explains: a rig that was late a minute ago is not late now.
EXPLAINS_FOR_NS = 5_000_000_000
# Devices that share nothing but the computer do not fall silent within this time by chance; a silence is noticed after 50 to
# 150 ms, depending on the device.
TOGETHER_NS = 300_000_000
# The model process is not one of them: without poses it has nothing to answer.
_SILENCES = (("board_silent",), ("pose_stale", "pose_lost"), ("force_stale", "force_lost"))
# ... or was noticed after at most this time: lateness and the board's counters are reported twice a second.
NOTICED_WITHIN_NS = 600_000_000


class Rule(NamedTuple):
    """What a cause is called, what to do about it, and which causes explain it."""

    says: str
    remedy: str
    explained_by: tuple[str, ...] = ()


# Ordered as things are reached: the computer, the line to the board, the board, the sensors, the force.
RULES: dict[str, Rule] = {
    "operator_stop": Rule("The operator stopped the rig.", "Disarm and arm again when ready."),
    "loop_late": Rule(
        "The control loop was late: the computer was too busy.",
        "Close other programs, and give the loop real-time priority; `seldinger latency-check` measures its lateness. "
        "Then clear and arm again.",
    ),
    "devices_silent": Rule(
        "Several devices fell silent at the same time.",
        "Check the load of the computer (`seldinger latency-check`), then what the devices share: USB hub, network, power. "
        "Then clear and arm again.",
        ("loop_late", "operator_stop"),
    ),
    "board_reset": Rule(
        "The stepper board was reset.", "Check the board's supply and its USB cable, then home the axes.", ("operator_stop",)
    ),
    "board_silent": Rule(
        "The stepper board sent no status.",
        "Check cable and power of the board, then clear.",
        ("loop_late", "devices_silent", "board_reset"),
    ),
    "underrun": Rule(
        "The board ran out of set-points while moving.",
        "Raise [board] setpoint_lead_s, or make the computer less busy.",
        ("loop_late", "devices_silent", "board_silent", "board_reset"),
    ),
    "deadman": Rule(
        "The board received no set-points, so its dead man stopped the axes.",
        "Check the cable of the board and the load of the computer, then clear.",
        ("loop_late", "devices_silent", "underrun", "board_silent", "board_reset"),
    ),
    "estop": Rule("The emergency stop opened.", "Release the emergency stop when it is safe, then clear."),
    "limit": Rule("A limit switch opened.", "Move the stage off the switch by hand, clear, and home the axis."),
    "board_fault": Rule(
        "The stepper board latched a fault.",
        "Remove the fault (docs/devices.md), then clear.",
        ("loop_late", "deadman", "estop", "limit", "board_reset", "operator_stop"),
    ),
    "steps_lost": Rule(
        "Encoder and steps disagree.",
        "Check for a jam or a loose encoder plug, clear, and home the axes.",
        ("board_reset", "limit", "board_fault", "over_force"),
    ),
    "tracker_moved": Rule(
        "Tracker or sheath moved against the rig, or the catheter slips in its holder.",
        "Fix field generator, sheath and catheter, register the tracker again (base_from_tracker_*), then clear.",
        ("loop_late",),
    ),
    "pose_rejected": Rule(
        "A pose was not finite, out of the workspace or too fast.",
        "Check for metal or motors near the tracker's field generator.",
        ("loop_late", "tracker_moved"),
    ),
    "poses_wild": Rule(
        "Three poses in a row were rejected.", "Check the tracker and its tools.", ("loop_late", "pose_rejected")
    ),
    "pose_stale": Rule(
        "The tracker sent no recent pose.",
        "Check the tracker's cable, and that the tip is in its measurement volume.",
        ("loop_late", "devices_silent", "poses_wild"),
    ),
    "pose_lost": Rule(
        "The tracker sent no pose for longer than the limit.",
        "Check the tracker's cable, and that the tip is in its measurement volume, then clear.",
        ("loop_late", "devices_silent", "poses_wild", "pose_stale"),
    ),
    "force_rejected": Rule(
        "A force reading was not finite or out of the sensor's range.", "Check the force sensor's cable.", ("loop_late",)
    ),
    "force_stale": Rule(
        "The force source sent no recent value in contact.",
        "Check the force sensor and its network.",
        ("loop_late", "devices_silent", "force_rejected"),
    ),
    "force_lost": Rule(
        "The force source sent no value for longer than the limit in contact.",
        "Check the force sensor and its network, then clear.",
        ("loop_late", "devices_silent", "force_rejected", "force_stale"),
    ),
    "force_handover": Rule(
        "The force sensor sends no data or repeats one value. The loop uses the estimate.",
        "Check the force sensor.",
        ("force_rejected", "force_stale", "force_lost"),
    ),
    "body_contact": Rule(
        "The catheter's body touches something away from the tip.",
        "Move the catheter away from the place on the page (topic contact); do not use the estimated force until then.",
        ("steps_lost", "tracker_moved", "pose_rejected"),
    ),
    "force_disagrees": Rule(
        "Force sensor, estimate and tip deflection disagree.",
        "Check whether the catheter's body touches something; zero the force sensor in free space; if they still disagree, "
        "check its mounting and the catheter's stiffness.",
        ("force_rejected", "force_stale", "steps_lost", "tracker_moved", "body_contact"),
    ),
    "force_undecided": Rule(
        "Force sensor, estimate and tip deflection began to disagree.",
        "Wait; if they still disagree, the catheter retracts. Check whether the catheter's body touches something, and zero "
        "the force sensor in free space.",
        ("force_rejected", "force_stale", "steps_lost", "tracker_moved", "body_contact"),
    ),
    "host_silent": Rule(
        "The model process does not answer.",
        "Check whether it runs (`systemctl status seldinger-host`), or start it again.",
        (
            "loop_late",
            "devices_silent",
        ),
    ),
    "host_lost": Rule(
        "The model process did not answer for longer than the limit.",
        "Start the model process, then clear.",
        ("loop_late", "host_silent"),
    ),
    "force_unreached": Rule(
        "The requested force is not reached, because the catheter bends too far.",
        "Request less force, or insert the catheter less far.",
    ),
    "still_pressed": Rule(
        "A force remains on the tip after the retraction.",
        "Pull the catheter back by hand until the force is gone.",
        ("over_force", "force_disagrees", "board_silent", "board_fault", "operator_stop"),
    ),
    "device_returned": Rule(
        "A device was lost and is back, so the rig was disarmed.",
        "Check the cable of the device, then arm again.",
        ("loop_late", "board_reset", "board_silent", "pose_lost", "force_lost"),
    ),
    "over_force": Rule(
        "The contact force went above the limit.",
        "Take the catheter off the tissue, then clear.",
        ("loop_late", "steps_lost", "tracker_moved", "force_disagrees", "force_handover"),
    ),
}
_UNKNOWN = Rule("", "Check the log lines before it.")
_RANK = {cause: rank for rank, cause in enumerate(RULES)}


class Observation(NamedTuple):
    """A cause when it was first noticed; `text` describes it where the rule does not, or adds a detail."""

    cause: str
    at_ns: int
    text: str = ""


class FirstCause(NamedTuple):
    """The first cause and its remedy; then all other observed causes in the order of time."""

    cause: str
    at_ns: int
    says: str
    remedy: str
    followed: tuple[Observation, ...]


def first_cause(observed: Iterable[Observation]) -> FirstCause | None:
    """Return the first cause of all that was observed, None where nothing was.

    Args:
        observed: In any order; of a cause that is there twice the earlier counts.

    Returns:
        Of the causes that no other observed cause explains the earliest; at the same time, the one nearer to the start
        of RULES. If each is explained by another, the earliest.
    """
    earliest: dict[str, Observation] = {}
    for item in observed:
        if item.cause not in earliest or item.at_ns < earliest[item.cause].at_ns:
            earliest[item.cause] = item
    together_ns = _together_ns(earliest)
    if together_ns is not None:
        earliest.setdefault("devices_silent", Observation("devices_silent", together_ns))
    ordered = sorted(earliest.values(), key=lambda item: (item.at_ns, _RANK.get(item.cause, len(_RANK))))
    if not ordered:
        return None
    roots = [item for item in ordered if not any(_explains(earliest[by], item) for by in _explanations(item, earliest))]
    first = (roots or ordered)[0]
    rule = RULES.get(first.cause, _UNKNOWN)
    says = rule.says or first.text
    if rule.says and first.text and first.text != rule.says:
        says = f"{rule.says.removesuffix('.')} ({first.text})."
    # That several fell silent is a conclusion, not an observation: it is a headline or nothing.
    followed = tuple(item for item in ordered if item not in (first, earliest.get("devices_silent")))
    return FirstCause(first.cause, first.at_ns, says, rule.remedy, followed)


def _together_ns(earliest: dict[str, Observation]) -> int | None:
    """When the first of several devices fell silent that did so at the same time; None where at most one did."""
    times = sorted(
        min(earliest[name].at_ns for name in names if name in earliest) for names in _SILENCES if earliest.keys() & {*names}
    )
    pairs = itertools.pairwise(times)
    return next((before for before, after in pairs if after - before <= TOGETHER_NS), None)


def _explanations(item: Observation, earliest: dict[str, Observation]) -> list[str]:
    return [cause for cause in RULES.get(item.cause, _UNKNOWN).explained_by if cause in earliest]


def _explains(by: Observation, item: Observation) -> bool:
    return -NOTICED_WITHIN_NS <= item.at_ns - by.at_ns <= EXPLAINS_FOR_NS


def describe(item: Observation) -> str:
    """Return an observed cause as one sentence."""
    return RULES.get(item.cause, _UNKNOWN).says or item.text
