"""Every zenoh topic in one table: key, message class, rate, direction. The same classes are the recording's schemas."""

from __future__ import annotations

import math
import re
from typing import Annotated, ClassVar, NamedTuple

from protocol.enums import CommandKind, JogAxis, Phase, SafetyAction
from protocol.messages import (
    MAX_PAYLOAD_BYTES,
    SCHEMA_VERSION,
    Count,
    Message,
    Stamp_ns,
    Text,
    bounds,
    choice,
    columns,
    columns_of,
    decode,
    doc,
    encode,
    json_schema,
    specs,
)

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "SCHEMA_VERSION",
    "TOPICS",
    "Alarm",
    "BoardCounters",
    "BodyContact",
    "Command",
    "CommandCounts",
    "ForceEstimate",
    "ForceSensor",
    "Log",
    "LoopTiming",
    "Message",
    "PlannedStep",
    "Pose",
    "Reply",
    "RigState",
    "SimulatedTruth",
    "Stage",
    "Stiffness",
    "Topic",
    "check_name",
    "columns",
    "decode",
    "encode",
    "histogram_bucket",
    "json_schema",
    "key",
    "request_key",
    "topic_of",
]

FRAMES = ("base", "tip")
CONTACT_PLACES = ("tip", "body", "tip and body", "not observable")
ADAPTATIONS = ("learning", "frozen", "limited", "not observable")
LOG_LEVELS = ("info", "warning", "error")
ACTIONS = (
    "clock", "take", "release", "arm", "disarm", "target", "force", "hold", "jog", "zero", "home", "mark", "stop",
    "clear_fault",
)  # fmt: skip
TARGETS = tuple(kind.label for kind in CommandKind if kind not in (CommandKind.STOP, CommandKind.JOG))
JOG_AXES = ("none", *JogAxis.labels())
# A step of a plan: computed, being executed; the goal under the contact force that the request states; or the plan has
# ended, whether its goal was reached or not.
STEP_STATUS = ("planned", "executing", "loaded", "ended")
RESULTS = ("accepted", "refused", "expired", "replayed", "malformed")

_XYZ_m = ("x_m", "y_m", "z_m")
_FORCE = ("fx_N", "fy_N", "fz_N")
_LASTING = tuple(f"lasting_c{row}{column}_N2" for row in "xyz" for column in "xyz")
_BODY_FORCE, _TIP_FORCE = (tuple(f"{where}_{name}" for name in _FORCE) for where in ("body", "tip"))
_BODY_COVARIANCE, _TIP_COVARIANCE = (
    tuple(f"{where}_c{row}{column}_N2" for row in "xyz" for column in "xyz") for where in ("body", "tip")
)
_NOMINAL = tuple(f"nominal_{name}" for name in _FORCE)
_NOMINAL_COVARIANCE = tuple(f"nominal_c{row}{column}_N2" for row in "xyz" for column in "xyz")
_COVARIANCE = tuple(f"c{row}{column}_N2" for row in "xyz" for column in "xyz")

# Time histograms: bucket k holds times from 2^(k / 4) to 2^((k + 1) / 4) us; the first and the last are open.
HISTOGRAM_BUCKETS = 64
HISTOGRAM_EDGES_US = tuple(2.0 ** (edge / 4) for edge in range(HISTOGRAM_BUCKETS + 1))
# Points of a planned shape, from the sheath's exit to the tip.
SHAPE_POINTS = 12
_SHAPE = tuple(f"shape_{point:02d}_{axis}_m" for point in range(SHAPE_POINTS) for axis in "xyz")
_BUCKETS = tuple(f"tick_bucket_{bucket:02d}" for bucket in range(HISTOGRAM_BUCKETS))


def histogram_bucket(time_us: float) -> int:
    """Return the bucket of `time_us` in the loop's time histograms, 0 to HISTOGRAM_BUCKETS - 1."""
    if time_us < 1.0:
        return 0
    return min(HISTOGRAM_BUCKETS - 1, int(4 * math.log2(time_us)))


def _triple(prefix: str, unit: str = "") -> tuple[str, ...]:
    return tuple(f"{prefix}_{axis}" + (f"_{unit}" if unit else "") for axis in "xyz")


def _axes(prefix: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{axis}_{unit}" for axis in ("insertion", "roll", "knob"))


# Units and bounds. Each is wider than any rig of this kind reaches, and narrow enough that no reader overflows, plots a
# single dot or computes for seconds: a catheter with 1e6 m outside its sheath would be cut into 2e8 arcs.
Travel_m = Annotated[float, bounds("m", -1.0, 1.0)]
Turn_rad = Annotated[float, bounds("rad", -1000.0, 1000.0)]
Curvature_per_m = Annotated[float, bounds("1/m", -1000.0, 1000.0)]
Place_m = Annotated[float, bounds("m", -10.0, 10.0)]
Speed_m_per_s = Annotated[float, bounds("m/s", -100.0, 100.0)]
Force_N = Annotated[float, bounds("N", -1000.0, 1000.0)]
# What a command may ask for at all; the rig's own limit is lower (protocol.rig_file.HARD_MAX_FORCE_N).
AllowedForce_N = Annotated[float, bounds("N", 0.0, 1.0)]
# One jog is short; a longer way needs several jogs, or a target. The rig bounds both further (`operator_commands`).
JogTravel = Annotated[float, bounds("", -1.0, 1.0)]
JogSpeed = Annotated[float, bounds("", 0.0, 10.0)]
Torque_Nm = Annotated[float, bounds("N m", -100.0, 100.0)]
# An unobservable direction has a standard deviation of up to 1e6 N: it says that nothing is known there.
Covariance_N2 = Annotated[float, bounds("N^2", -1e12, 1e12)]
# Of a unit vector or quaternion, whose length is checked apart.
UnitPart = Annotated[float, bounds("", -2.0, 2.0)]
Number = Annotated[float, bounds("", -1e12, 1e12)]
Score = Annotated[float, bounds("", 0.0, 1e12)]
Share = Annotated[float, bounds("", 0.0, 1.0)]
Ratio = Annotated[float, bounds("", 0.0, 100.0)]
Duration_us = Annotated[float, bounds("us", 0.0, 1e12)]
Duration_ms = Annotated[float, bounds("ms", 0.0, 1e9)]
Duration_s = Annotated[float, bounds("s", 0.0, 1e6)]
Rate_hz = Annotated[float, bounds("Hz", 1.0, 1e5)]
U8 = Annotated[int, bounds("", 0, 2**8 - 1)]
U16 = Annotated[int, bounds("", 0, 2**16 - 1)]
U32 = Annotated[int, bounds("", 0, 2**32 - 1)]
Clock_us = Annotated[int, bounds("us", 0, 2**32 - 1)]
Steps = Annotated[int, bounds("steps", -(2**31), 2**31 - 1)]
EncoderCounts = Annotated[int, bounds("counts", -(2**31), 2**31 - 1)]
Ticks = Annotated[int, bounds("ticks", 0, 2**32 - 1)]


class Stage(Message, frozen=True, kw_only=True):
    """Commanded and measured stage positions at the handle, and the joints behind the transmission."""

    command_insertion_m: Annotated[Travel_m, doc("commanded insertion of the handle")]
    command_roll_rad: Annotated[Turn_rad, doc("commanded roll of the handle")]
    command_knob_rad: Annotated[Turn_rad, doc("commanded knob angle")]
    encoder_insertion_m: Annotated[Travel_m | None, doc("insertion by its encoder")] = None
    encoder_roll_rad: Annotated[Turn_rad | None, doc("roll by its encoder")] = None
    encoder_knob_rad: Annotated[Turn_rad | None, doc("knob by its encoder")] = None
    joint_insertion_m: Annotated[Travel_m | None, doc("distal insertion, estimated by the controller")] = None
    joint_roll_rad: Annotated[Turn_rad | None, doc("distal roll, estimated by the controller")] = None
    joint_curvature_per_m: Annotated[Curvature_per_m | None, doc("unloaded curvature, estimated by the controller")] = None


class Pose(Message, frozen=True, kw_only=True):
    """One reading of one tracker tool, in the base frame. `stamp_ns` is the time of measurement, latency subtracted."""

    arrival_ns: Annotated[Stamp_ns, doc("time of arrival of its last byte")]
    frame: Annotated[U32, doc("the tracker's frame number")]
    missing: Annotated[bool, doc("true if the tracker did not measure the tool; position and quaternion are then nil")]
    position_m: Annotated[tuple[Place_m, ...], columns_of("position of the sensor", _XYZ_m)] | None = None
    quaternion_wxyz: (
        Annotated[tuple[UnitPart, ...], columns_of("rotation sensor to base, scalar first", ("qw", "qx", "qy", "qz"))] | None
    ) = None
    quality_m: Annotated[Place_m | None, doc("the tracker's own error indicator")] = None

    def check(self) -> None:
        """Check that a pose has a position and a unit quaternion, and a missing one neither."""
        if self.missing:
            if self.position_m is not None or self.quaternion_wxyz is not None:
                raise ValueError("Pose: found a position or a quaternion with missing true, wanted neither")
            return
        if self.position_m is None or self.quaternion_wxyz is None:
            raise ValueError("Pose: found no position or no quaternion, wanted both, or missing true")
        length = math.hypot(*self.quaternion_wxyz)
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"Pose.quaternion_wxyz: found length {length:.6g}, wanted 1 within 1e-3")


class ForceSensor(Message, frozen=True, kw_only=True):
    """One reading of the force sensor: the force on the tissue, in the base frame."""

    arrival_ns: Annotated[Stamp_ns, doc("time of arrival of the datagram")]
    force_N: Annotated[tuple[Force_N, ...], columns_of("force on the tissue, base frame", _FORCE)]
    torque_Nm: Annotated[tuple[Torque_Nm, ...], columns_of("torque, base frame", _triple("torque", "Nm"))] | None = None
    status: Annotated[U32, doc("the sensor's status word, 0 is healthy")] = 0


class ForceEstimate(Message, frozen=True, kw_only=True):
    """The tip force that explains a pose. `stamp_ns` is that pose's; no force without its covariance."""

    frame: Annotated[str, choice("frame of force and covariance", FRAMES)]
    converged: Annotated[bool, doc("true if a force explains the pose; if false, force and covariance may be nil")]
    force_N: Annotated[tuple[Force_N, ...], columns_of("force of the tip on the tissue", _FORCE)] | None = None
    covariance_N2: Annotated[tuple[Covariance_N2, ...], columns_of("covariance, row by row", _COVARIANCE)] | None = None
    lasting_covariance_N2: (
        Annotated[
            tuple[Covariance_N2, ...],
            columns_of("part of the covariance that is common to the poses of some seconds, row by row", _LASTING),
        ]
        | None
    ) = None
    nominal_force_N: (
        Annotated[
            tuple[Force_N, ...],
            columns_of(
                "force computed with the stiffness of the catheter's file; nil if the stiffness is not adapted", _NOMINAL
            ),
        ]
        | None
    ) = None
    nominal_covariance_N2: (
        Annotated[tuple[Covariance_N2, ...], columns_of("covariance of that force, row by row", _NOMINAL_COVARIANCE)] | None
    ) = None
    body_contact: Annotated[
        bool, doc("true if the catheter's body touches something (topic `contact`); the force is then not that of the tip")
    ] = False
    residual: Annotated[Number | None, doc("residual of the best force")] = None
    published_ns: Annotated[Stamp_ns, doc("time at which the estimate was published")]
    compute_us: Annotated[Duration_us, doc("computing time of the estimate")]

    def check(self) -> None:
        """Check that a converged estimate has a force and a covariance whose diagonal is not negative."""
        if not self.converged:
            return
        if self.force_N is None or self.covariance_N2 is None:
            raise ValueError("ForceEstimate: found converged without force or covariance, wanted both")
        if min(self.covariance_N2[0], self.covariance_N2[4], self.covariance_N2[8]) < 0:
            raise ValueError("ForceEstimate.covariance_N2: found a negative variance, wanted none")
        if (self.nominal_force_N is None) != (self.nominal_covariance_N2 is None):
            raise ValueError("ForceEstimate: found nominal_force_N or nominal_covariance_N2 alone, wanted both or neither")


class Stiffness(Message, frozen=True, kw_only=True):
    """The catheter's stiffness as adapted while the rig runs (8.1.2). `stamp_ns` is that of the newest tip pose."""

    scale: Annotated[Ratio, doc("stiffness in use, relative to the catheter's file")]
    sd: Annotated[Ratio, doc("relative standard deviation of the stiffness in use")]
    adaptation: Annotated[str, choice("state of the adaptation", ADAPTATIONS)]
    text: Annotated[Text, doc("reason in words")] = ""
    samples: Annotated[Count, doc("free poses used since the start")]
    changes: Annotated[Count, doc("sudden changes of the stiffness found since the start")]


class BodyContact(Message, frozen=True, kw_only=True):
    """Where the catheter is touched, by the poses of the last half second. `stamp_ns` is that of the newest tip pose.

    Forces and places are nil where the poses do not determine them.
    """

    place: Annotated[
        str, choice("place of the force that explains the poses; tip: a force on the tip, or no force", CONTACT_PLACES)
    ]
    sensors: Annotated[U8, doc("number of poses of one frame that were used")]
    excess: Annotated[
        Score, doc("mean chi square of the best tip force, relative to its limit; above 1 no tip force explains the poses")
    ]
    body_offset_m: Annotated[Travel_m | None, doc("place of the contact of the body, back from the tip")] = None
    body_offset_sd_m: Annotated[Travel_m | None, doc("its standard deviation")] = None
    body_force_N: (
        Annotated[tuple[Force_N, ...], columns_of("force of the body on the touched object", _BODY_FORCE)] | None
    ) = None
    body_covariance_N2: (
        Annotated[tuple[Covariance_N2, ...], columns_of("its covariance, row by row", _BODY_COVARIANCE)] | None
    ) = None
    tip_force_N: (
        Annotated[
            tuple[Force_N, ...],
            columns_of("force of the tip on the tissue, estimated together with the force of the body", _TIP_FORCE),
        ]
        | None
    ) = None
    tip_covariance_N2: (
        Annotated[tuple[Covariance_N2, ...], columns_of("its covariance, row by row", _TIP_COVARIANCE)] | None
    ) = None
    text: Annotated[Text, doc("result in words, with the quantities that the poses do not determine")] = ""


class RigState(Message, frozen=True, kw_only=True):
    """State of the loop: phase, safety action and its cause in words, target, and the force that is controlled."""

    mode: Annotated[str, choice("phase of the control loop", Phase.labels())]
    safety_action: Annotated[str, choice("safety action, weakest first", SafetyAction.labels())]
    cause: Annotated[Text, doc("cause of the safety action in words; empty if there is none")] = ""
    target_m: (
        Annotated[tuple[Place_m, ...], columns_of("requested position of the tip, base frame", _triple("target", "m"))]
        | None
    ) = None
    tip_m: (
        Annotated[
            tuple[Place_m, ...], columns_of("tip predicted for the time of the message, base frame", _triple("tip", "m"))
        ]
        | None
    ) = None
    tip_velocity_m_per_s: (
        Annotated[
            tuple[Speed_m_per_s, ...],
            columns_of("tip velocity predicted for the time of the message, base frame", _triple("tip_velocity", "m_per_s")),
        ]
        | None
    ) = None
    force_direction: (
        Annotated[
            tuple[UnitPart, ...],
            columns_of(
                "unit vector along which force is controlled, base frame; nil if no force is controlled",
                _triple("force_direction"),
            ),
        ]
        | None
    ) = None
    target_force_N: Annotated[Force_N | None, doc("requested force along `force_direction`")] = None
    force_N: Annotated[Force_N | None, doc("force along `force_direction`, as the control loop uses it")] = None
    pose_age_ns: Annotated[Stamp_ns, doc("age of the newest accepted pose")] = 0
    poses_rejected: Annotated[Count, doc("poses refused since the start")] = 0
    forces_rejected: Annotated[Count, doc("force readings refused since the start")] = 0


class BoardCounters(Message, frozen=True, kw_only=True):
    """Counters of the stepper board from its status frame, and the host's count of damaged frames."""

    mcu_time_us: Annotated[Clock_us, doc("the board's clock")]
    state: Annotated[U8, doc("0 disarmed, 1 armed, 2 running, 3 stopping, 4 fault")]
    fault: Annotated[U8, doc("fault code, 0 is none")]
    fault_name: Annotated[Text, doc("fault in words, empty if there is none")] = ""
    inputs: Annotated[U8, doc("limit switches and emergency stop, bit by bit")]
    queue_depth: Annotated[U8, doc("set-points in the queue")]
    last_setpoint: Annotated[U16, doc("number of the newest executed set-point")]
    position_steps: Annotated[tuple[Steps, ...], columns_of("position of each axis", _axes("position", "steps"))]
    encoder_counts: Annotated[tuple[EncoderCounts, ...], columns_of("encoder of each axis", _axes("encoder", "counts"))]
    crc_errors: Annotated[U32, doc("damaged frames that the board received")]
    host_crc_errors: Annotated[U32, doc("damaged frames that the host received")] = 0
    underruns: Annotated[U32, doc("number of times that the queue was empty during a motion")]
    rejected: Annotated[U32, doc("set-points refused")]
    last_reject: Annotated[Text, doc("reason of the last refusal, empty if there was none")] = ""
    boot_count: Annotated[U32, doc("number of resets of the board")]
    deadman_age_ms: Annotated[Duration_ms, doc("time since the newest valid set-point")]


class RigCause(Message, frozen=True, kw_only=True):
    """First cause of what holds the rig back, with its remedy; empty if nothing does."""

    name: Annotated[Text, doc("name of the first cause; empty if there is none")] = ""
    since_ns: Annotated[Stamp_ns, doc("time at which it was noticed")] = 0
    says: Annotated[Text, doc("the first cause in words")] = ""
    remedy: Annotated[Text, doc("what to do about it")] = ""
    followed: Annotated[Text, doc("all other causes, one in a line, with the time since the first")] = ""


class LoopTiming(Message, frozen=True, kw_only=True):
    """The control loop's timing since its start: exact percentiles, and histograms over HISTOGRAM_EDGES_US."""

    loop_hz: Annotated[Rate_hz, doc("configured rate")]
    ticks: Annotated[Count, doc("ticks since the start")]
    missed_ticks: Annotated[Count, doc("ticks that began after their period was over")]
    tick_p50_us: Annotated[Duration_us, doc("time of the tick's work, median")]
    tick_p99_us: Annotated[Duration_us, doc("time of the tick's work, 99th percentile")]
    tick_p999_us: Annotated[Duration_us, doc("time of the tick's work, 99.9th percentile")]
    tick_max_us: Annotated[Duration_us, doc("time of the tick's work, longest")]
    lateness_p50_us: Annotated[Duration_us | None, doc("lateness of the wake-up, median; nil in virtual time")] = None
    lateness_p99_us: Annotated[Duration_us | None, doc("lateness of the wake-up, 99th percentile")] = None
    lateness_p999_us: Annotated[Duration_us | None, doc("lateness of the wake-up, 99.9th percentile")] = None
    lateness_max_us: Annotated[Duration_us | None, doc("lateness of the wake-up, longest")] = None
    longest_gap_ns: Annotated[Stamp_ns, doc("longest time between two set-points sent")] = 0
    longest_gap_where: Annotated[Text, doc("part of the loop that caused this gap, empty if not known")] = ""
    tick_histogram: Annotated[tuple[Ticks, ...], columns_of("number of ticks by the time of their work", _BUCKETS)]


class Log(Message, frozen=True, kw_only=True):
    """One line of a log."""

    level: Annotated[str, choice("how serious", LOG_LEVELS)]
    source: Annotated[Text, doc("process or part that wrote the line")]
    text: Annotated[Text, doc("text")]


class Command(Message, frozen=True, kw_only=True):
    """Command of a commander; each is answered. It is checked by commander, lease and age.

    `stamp_ns` is when it was issued, on the rig's clock; `sequence` grows with each command of one lease.
    """

    measured: ClassVar[bool] = False

    id: Annotated[Text, doc("unique to this command; the same id twice is refused")]
    commander: Annotated[Text, doc("name of the commander; must be the name in the key of the message")]
    lease: Annotated[Text, doc("lease of the commander; clock, take, hold, mark and stop need none")] = ""
    expires_ns: Annotated[Stamp_ns, doc("time after which the command is not executed, on the rig's clock")]
    action: Annotated[str, choice("requested action", ACTIONS)]
    target: Annotated[str, choice("kind of the target; none unless action is target", TARGETS)]
    target_m: Annotated[tuple[Place_m, ...], columns_of("tip position, base frame", _triple("target", "m"))] | None = None
    normal: (
        Annotated[
            tuple[UnitPart, ...],
            columns_of("unit vector into the tissue, base frame, along which to press", _triple("normal")),
        ]
        | None
    ) = None
    force_N: Annotated[AllowedForce_N | None, doc("force to hold along the normal")] = None
    fault: Annotated[U8, doc("fault code that clear_fault clears, 0 for all")] = 0
    axis: Annotated[str, choice("axis of a jog, or the axis to be homed; none for other actions", JOG_AXES)] = "none"
    direction: (
        Annotated[
            tuple[UnitPart, ...], columns_of("unit vector along which a jog moves the tip, base frame", _triple("along"))
        ]
        | None
    ) = None
    travel_unit: Annotated[JogTravel | None, doc("length of a jog; m for the tip and insertion, rad for roll and knob")] = (
        None
    )
    speed_unit_per_s: Annotated[JogSpeed | None, doc("speed of a jog, in that unit per second")] = None
    note: Annotated[Text, doc("text of a mark")] = ""

    def check(self) -> None:
        """Check that each action carries what it needs, and that expiry comes after issue."""
        if not 0 < len(self.id) <= 64:
            raise ValueError(f"Command.id: found {len(self.id)} characters, wanted 1 to 64")
        check_name(self.commander)
        if self.expires_ns < self.stamp_ns:
            raise ValueError("Command.expires_ns: found a time before stamp_ns, wanted a later one")
        if (self.action == "target") == (self.target == "none"):
            raise ValueError(
                f"Command.target: found {self.target} with action {self.action}, "
                "wanted a kind with action target, none without"
            )
        if self.action == "force" and self.force_N is None:
            raise ValueError("Command.force_N: found nil, wanted a force for action force")
        if self.target in ("position", "contact") and self.target_m is None:
            raise ValueError(f"Command.target_m: found nil, wanted a position for {self.target}")
        if self.target == "contact" and (
            self.force_N is None or self.normal is None or abs(math.hypot(*self.normal) - 1) > 1e-3
        ):
            raise ValueError("Command: found no force_N or no unit normal, wanted both for contact")
        if (self.action in ("jog", "home")) == (self.axis == "none"):
            raise ValueError(
                f"Command.axis: found {self.axis} with action {self.action}, "
                "wanted an axis with actions jog and home, none with others"
            )
        if self.action == "home" and self.axis == "tip":
            raise ValueError("Command.axis: found tip with action home, wanted insertion, roll or knob")
        if self.action == "jog" and (self.travel_unit is None or self.speed_unit_per_s is None):
            raise ValueError("Command: found no travel_unit or no speed_unit_per_s, wanted both for jog")
        if (
            self.action == "jog"
            and self.axis == "tip"
            and (self.direction is None or abs(math.hypot(*self.direction) - 1) > 1e-3)
        ):
            raise ValueError("Command.direction: found no unit vector, wanted one for a jog of the tip")
        if self.action == "mark" and not self.note.strip():
            raise ValueError("Command.note: found an empty text, wanted a note for mark")


class Reply(Message, frozen=True, kw_only=True):
    """The answer to a command. `stamp_ns` is the rig's clock when it was answered."""

    measured: ClassVar[bool] = False

    id: Annotated[Text, doc("id of the command that it answers")]
    result: Annotated[str, choice("result of the command", RESULTS)]
    lease: Annotated[Text, doc("lease that the action take gave, empty for other actions")] = ""
    lease_expires_ns: Annotated[Stamp_ns, doc("end of that lease if it is not renewed")] = 0
    text: Annotated[Text, doc("reason in words")] = ""


class CommandCounts(Message, frozen=True, kw_only=True):
    """Holder of the lease, and the results of all commands since the start."""

    holder: Annotated[Text, doc("commander that holds the lease, empty when there is none")] = ""
    lease_expires_ns: Annotated[Stamp_ns, doc("end of the lease if it is not renewed")] = 0
    accepted: Annotated[Count, doc("number of commands carried out")]
    refused: Annotated[Count, doc("number of commands refused: no lease, wrong role, or not possible in the present phase")]
    expired: Annotated[Count, doc("number of commands that came after their expiry")]
    replayed: Annotated[Count, doc("number of commands that came a second time or out of sequence")]
    malformed: Annotated[Count, doc("number of messages that are not a command, or too large")]
    flooded: Annotated[Count, doc("number of commands that were not read, because the sender sent too many")]


class PlannedStep(Message, frozen=True, kw_only=True):
    """One step of a plan that is carried out: the shape that the model gives the catheter there, as loaded on the way."""

    plan: Annotated[Text, doc("number of the protocol's step that carries out the plan")]
    step: Annotated[U8, doc("number of the step, from 0")]
    steps: Annotated[U8, doc("number of drawn steps of the plan")]
    status: Annotated[
        str, choice("state of the step; loaded is the goal under the contact force; ended closes the plan", STEP_STATUS)
    ]
    time_s: Annotated[Duration_s, doc("planned time of the step, from the start of the plan")]
    load_N: Annotated[AllowedForce_N, doc("force of the puncture on the catheter in this step")] = 0.0
    contact_force_N: Annotated[
        tuple[Force_N, ...], columns_of("planned force on the tissue, with status loaded", _FORCE)
    ] = (
        0.0,
        0.0,
        0.0,
    )
    shape_m: Annotated[
        tuple[Place_m, ...], columns_of("planned centre line from the sheath's exit to the tip, base frame", _SHAPE)
    ]

    def check(self) -> None:
        """Check that the step is one of the plan's."""
        if not self.step < self.steps:
            raise ValueError(f"PlannedStep.step: found {self.step}, wanted below steps {self.steps}")


class Alarm(Message, frozen=True, kw_only=True):
    """Rig and twin disagree: subsystem and probable cause."""

    subsystem: Annotated[Text, doc("subsystem, as in a diagnosis")]
    effect: Annotated[Text, doc("probable cause: an id of the vocabulary, or unlisted")]
    channel: Annotated[Text, doc("output with the largest mismatch")]
    score: Annotated[Score, doc("mismatch relative to its limit; above 1 is an alarm")]
    explained: Annotated[Share, doc("share of the mismatch that the cause explains")]
    probability: Annotated[Share, doc("probability of the cause among those that were fitted; 0: not known")] = 0.0
    since_ns: Annotated[Stamp_ns, doc("estimated begin of the mismatch, on the rig's clock")]
    words: Annotated[Text, doc("alarm in one sentence")]


class SimulatedTruth(Message, frozen=True, kw_only=True):
    """True values of the simulator. For reports only; no controller, estimator or verdict reads them."""

    tip_m: Annotated[tuple[Place_m, ...], columns_of("true tip, base frame", _triple("tip", "m"))]
    wall_m: Annotated[tuple[Place_m, ...], columns_of("point of the wall, base frame", _triple("wall", "m"))] | None = None
    contact_force_N: Annotated[tuple[Force_N, ...], columns_of("true force on the tissue, base frame", _FORCE)]
    distal_insertion_m: Annotated[Travel_m | None, doc("true insertion of the distal end")] = None
    distal_roll_rad: Annotated[Turn_rad | None, doc("true roll of the distal end")] = None
    distal_curvature_per_m: Annotated[Curvature_per_m | None, doc("true unloaded curvature")] = None


class Topic(NamedTuple):
    """One row of the table. `rate_hz` 0: when something happens. `kind`: state (the latest counts), event, query."""

    name: str
    message: type[Message]
    rate_hz: float
    kind: str
    direction: str
    doc: str


_TABLE = (
    Topic("stage", Stage, 250, "state", "realtime -> host, tools", "handle: commands, encoders, catheter joints"),
    Topic("pose/tip", Pose, 40, "state", "realtime -> host, tools", "tracker tool at the tip"),
    Topic("pose/shaft", Pose, 40, "state", "realtime -> host, tools", "tracker tool down the shaft"),
    Topic("pose/rear", Pose, 40, "state", "realtime -> host, tools", "third tracker tool, if the rig has one"),
    Topic("force/sensor", ForceSensor, 500, "state", "realtime -> host, tools", "measured force"),
    Topic("force/estimate", ForceEstimate, 40, "state", "host -> realtime, tools", "force estimated from poses"),
    Topic("stiffness", Stiffness, 4, "state", "host -> tools", "adapted stiffness of the catheter"),
    Topic("contact", BodyContact, 4, "state", "host -> tools", "contact away from the tip: place and force"),
    Topic("state", RigState, 100, "state", "realtime -> host, tools", "mode, safety action and cause, target"),
    Topic("cause", RigCause, 2, "state", "realtime -> host, tools", "first cause of a stop or hold, with its remedy"),
    Topic("board", BoardCounters, 20, "state", "realtime -> host, tools", "counters of the stepper board"),
    Topic("loop", LoopTiming, 2, "state", "realtime -> host, tools", "timing of the control loop"),
    Topic("log", Log, 0, "event", "all -> host, tools", "log lines"),
    Topic(
        "request", Command, 0, "query", "commander -> realtime", "commands, on request/NAME; the answer to each is a Reply"
    ),
    Topic("command", Command, 0, "event", "realtime -> host, tools", "commands as received, for the recording"),
    Topic("reply", Reply, 0, "event", "realtime -> host, tools", "results of the commands"),
    Topic("commander", CommandCounts, 2, "state", "realtime -> host, tools", "holder of the lease; counts of commands"),
    Topic("plan", PlannedStep, 0, "event", "protocol -> host, tools", "steps of a plan that is carried out"),
    Topic("alarm", Alarm, 0, "event", "diagnosis -> host, tools", "rig and twin disagree: subsystem and probable cause"),
    Topic("sim/truth", SimulatedTruth, 100, "state", "sim -> host", "true values of the simulator, for reports only"),
)
TOPICS: dict[str, Topic] = {topic.name: topic for topic in _TABLE}

_RIG = re.compile(r"[a-z0-9_]{1,32}")
_NAME = re.compile(r"[a-z0-9_-]{1,32}")
_KEY = re.compile(r"seldinger/v(\d+)/([a-z0-9_]{1,32})/(.+)")


def key(rig: str, name: str) -> str:
    """Return the zenoh key of topic `name` on rig `rig`. Raises ValueError for an unknown topic or a bad rig name."""
    if name not in TOPICS:
        raise ValueError(f"topic: found {name!r}, wanted one of {', '.join(TOPICS)}")
    if not _RIG.fullmatch(rig):
        raise ValueError(f"rig: found {rig!r}, wanted 1 to 32 of a-z, 0-9 and _")
    return f"seldinger/v{SCHEMA_VERSION}/{rig}/{name}"


def check_name(name: str) -> str:
    """Return `name` if it is allowed for a commander or reader. Raises ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"commander: found {name[:40]!r}, wanted 1 to 32 of a-z, 0-9, - and _")
    return name


def request_key(rig: str, name: str) -> str:
    """Return the zenoh key of the requests of commander `name` of rig `rig`; `*` for all of them. Raises ValueError."""
    return f"{key(rig, 'request')}/{name if name == '*' else check_name(name)}"


def topic_of(key_expression: str) -> tuple[str, Topic]:
    """Return (rig, topic) of a key. Raises ValueError for a key of another version, an unknown topic or anything else."""
    match = _KEY.fullmatch(key_expression)
    if not match or match[1] != str(SCHEMA_VERSION) or match[3] not in TOPICS:
        raise ValueError(f"key: found {key_expression[:80]!r}, wanted seldinger/v{SCHEMA_VERSION}/<rig>/<topic>")
    return match[2], TOPICS[match[3]]


def as_markdown() -> str:
    """Return the table as Markdown: every topic, then every message with its fields, units and bounds."""
    lines = ["| topic | message | rate | direction | what |", "|---|---|---|---|---|"]
    for topic in _TABLE:
        rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "at each event"
        lines.append(f"| `{topic.name}` | {topic.message.__name__} | {rate} | {topic.direction} | {topic.doc} |")
    for declared in dict.fromkeys(topic.message for topic in _TABLE):
        lines += [
            "",
            f"### {declared.__name__}",
            "",
            (declared.__doc__ or "").strip(),
            "",
            "| field | type | unit | bounds | what |",
            "|---|---|---|---|---|",
        ]
        for name, spec in specs(declared).items():
            kind = f"{spec.kind}[{len(spec.columns)}]" if spec.columns else spec.kind
            allowed = "-" if spec.minimum is None else f"{spec.minimum:.4g} to {spec.maximum:.4g}"
            allowed = ", ".join(spec.choices) or allowed
            nil = " or nil" if spec.optional else ""
            lines.append(f"| `{name}` | {kind}{nil} | {spec.unit or '-'} | {allowed} | {spec.doc} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(as_markdown(), end="")
