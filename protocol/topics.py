"""Every zenoh topic in one table: key, message class, rate, direction. The same classes are the recording's schemas."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from protocol.enums import CommandKind, Phase, SafetyAction
from protocol.messages import (
    MAX_PAYLOAD_BYTES,
    SCHEMA_VERSION,
    Message,
    Vector,
    choice,
    columns,
    decode,
    encode,
    flag,
    integer,
    integers,
    json_schema,
    message,
    number,
    specs,
    text,
    vector,
)

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "SCHEMA_VERSION",
    "TOPICS",
    "Alarm",
    "BoardCounters",
    "Command",
    "CommandCounts",
    "ForceEstimate",
    "ForceSensor",
    "Log",
    "LoopTiming",
    "Message",
    "Pose",
    "Reply",
    "RigState",
    "SimulatedTruth",
    "Stage",
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
LOG_LEVELS = ("info", "warning", "error")
ACTIONS = ("clock", "take", "release", "arm", "disarm", "target", "force", "hold", "stop", "clear_fault")
TARGETS = tuple(kind.label for kind in CommandKind if kind is not CommandKind.STOP)
RESULTS = ("accepted", "refused", "expired", "replayed", "malformed")

_XYZ_m = ("x_m", "y_m", "z_m")
_FORCE = ("fx_N", "fy_N", "fz_N")
_COVARIANCE = tuple(f"c{row}{column}_N2" for row in "xyz" for column in "xyz")

# Time histograms: bucket k holds times from 2^(k / 4) to 2^((k + 1) / 4) us; the first and the last are open.
HISTOGRAM_BUCKETS = 64
HISTOGRAM_EDGES_US = tuple(2.0 ** (edge / 4) for edge in range(HISTOGRAM_BUCKETS + 1))
_BUCKETS = tuple(f"tick_bucket_{bucket:02d}" for bucket in range(HISTOGRAM_BUCKETS))


def histogram_bucket(time_us: float) -> int:
    """The bucket of `time_us` in the loop's time histograms, 0 .. HISTOGRAM_BUCKETS - 1."""
    if time_us < 1.0:
        return 0
    return min(HISTOGRAM_BUCKETS - 1, int(4 * math.log2(time_us)))


def _triple(prefix: str, unit: str = "") -> tuple[str, ...]:
    return tuple(f"{prefix}_{axis}" + (f"_{unit}" if unit else "") for axis in "xyz")


def _axes(prefix: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{axis}_{unit}" for axis in ("insertion", "roll", "knob"))


@message
class Stage(Message):
    """The handle: what the loop commands and what the encoders say, and the catheter joints behind the transmission."""

    command_insertion_m: float = number("m", "commanded insertion of the handle")
    command_roll_rad: float = number("rad", "commanded roll of the handle")
    command_knob_rad: float = number("rad", "commanded bending knob")
    encoder_insertion_m: float | None = number("m", "insertion by its encoder", default=None)
    encoder_roll_rad: float | None = number("rad", "roll by its encoder", default=None)
    encoder_knob_rad: float | None = number("rad", "knob by its encoder", default=None)
    joint_insertion_m: float | None = number("m", "distal insertion, as the controller has it", default=None)
    joint_roll_rad: float | None = number("rad", "distal roll, as the controller has it", default=None)
    joint_curvature_per_m: float | None = number("1/m", "unloaded curvature, as the controller has it", default=None)


@message
class Pose(Message):
    """One reading of one tracker tool, in the base frame. `stamp_ns` is when it was measured, latency taken off."""

    arrival_ns: int = integer("ns", "when its last byte arrived")
    frame: int = integer("", "the tracker's frame number", bits=32)
    missing: bool = flag("the tool was not seen; position and quaternion are nil")
    position_m: Vector | None = vector("m", "position of the sensor", _XYZ_m, default=None)
    quaternion_wxyz: Vector | None = vector(
        "", "rotation sensor to base, scalar first", ("qw", "qx", "qy", "qz"), default=None
    )
    quality_m: float | None = number("m", "the tracker's own error indicator", default=None)

    def check(self) -> None:
        """A pose that is not missing has a position and a unit quaternion."""
        if self.missing:
            return
        if self.position_m is None or self.quaternion_wxyz is None:
            raise ValueError("Pose: found no position or no quaternion, wanted both, or missing true")
        length = math.hypot(*self.quaternion_wxyz)
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"Pose.quaternion_wxyz: found length {length:.6g}, wanted 1 within 1e-3")


@message
class ForceSensor(Message):
    """One reading of the force sensor: the force on the tissue, in the base frame."""

    arrival_ns: int = integer("ns", "when the datagram arrived")
    force_N: Vector = vector("N", "force on the tissue, base frame", _FORCE)
    torque_Nm: Vector | None = vector("N m", "torque, base frame", _triple("torque", "Nm"), default=None)
    status: int = integer("", "the sensor's status word, 0 is healthy", bits=32, default=0)


@message
class ForceEstimate(Message):
    """The tip force that explains a pose. `stamp_ns` is that pose's; no force without its covariance."""

    frame: str = choice("frame of force and covariance", FRAMES)
    converged: bool = flag("a force explains the pose; if false, force and covariance may be nil")
    force_N: Vector | None = vector("N", "force of the tip on the tissue", _FORCE, default=None)
    covariance_N2: Vector | None = vector("N^2", "covariance, row by row", _COVARIANCE, default=None)
    residual: float | None = number("", "what the best force leaves unexplained", default=None)
    published_ns: int = integer("ns", "when the estimate left the estimator")
    compute_us: float = number("us", "time the estimator took", minimum=0)

    def check(self) -> None:
        """A converged estimate has a force and a covariance whose diagonal is not negative."""
        if not self.converged:
            return
        if self.force_N is None or self.covariance_N2 is None:
            raise ValueError("ForceEstimate: found converged without force or covariance, wanted both")
        if min(self.covariance_N2[0], self.covariance_N2[4], self.covariance_N2[8]) < 0:
            raise ValueError("ForceEstimate.covariance_N2: found a negative variance, wanted none")


@message
class RigState(Message):
    """What the loop does and why: mode, safety action and its cause in words, target, and what it steers by."""

    mode: str = choice("phase of the control loop", Phase.labels())
    safety_action: str = choice("what safety asks for, weakest first", SafetyAction.labels())
    cause: str = text("why, in words; empty when nothing is wrong", default="")
    target_m: Vector | None = vector("m", "tip wanted, base frame", _triple("target", "m"), default=None)
    tip_m: Vector | None = vector("m", "tip predicted for now, base frame", _triple("tip", "m"), default=None)
    tip_velocity_m_per_s: Vector | None = vector(
        "m/s", "tip velocity predicted for now", _triple("tip_velocity", "m_per_s"), default=None
    )
    force_direction: Vector | None = vector(
        "", "unit vector along which force is controlled, nil if none is", _triple("force_direction"), default=None
    )
    target_force_N: float | None = number("N", "force wanted along that direction", default=None)
    force_N: float | None = number("N", "force along that direction that the loop steers by", default=None)
    pose_age_ns: int = integer("ns", "age of the newest accepted pose", default=0)
    poses_rejected: int = integer("", "poses refused since the start", default=0)
    forces_rejected: int = integer("", "force readings refused since the start", default=0)


@message
class BoardCounters(Message):
    """The stepper board's own account of itself, from its status frame, and the host's count of damaged frames."""

    mcu_time_us: int = integer("us", "the board's clock", bits=32)
    state: int = integer("", "0 disarmed, 1 armed, 2 running, 3 stopping, 4 fault", bits=8)
    fault: int = integer("", "fault code, 0 is none", bits=8)
    fault_name: str = text("the fault in words, empty when none", default="")
    inputs: int = integer("", "limit switches and emergency stop, bit by bit", bits=8)
    queue_depth: int = integer("", "setpoints waiting", bits=8)
    last_setpoint: int = integer("", "number of the newest executed setpoint", bits=16)
    position_steps: tuple[int, ...] = integers("steps", "position of each axis", _axes("position", "steps"))
    encoder_counts: tuple[int, ...] = integers("counts", "encoder of each axis", _axes("encoder", "counts"))
    crc_errors: int = integer("", "damaged frames that the board saw", bits=32)
    host_crc_errors: int = integer("", "damaged frames that the host saw", bits=32, default=0)
    underruns: int = integer("", "times the queue ran dry while moving", bits=32)
    rejected: int = integer("", "setpoints refused", bits=32)
    last_reject: str = text("why the last one was refused, empty when none was", default="")
    boot_count: int = integer("", "resets of the board", bits=32)
    deadman_age_ms: float = number("ms", "time since the newest valid setpoint", minimum=0)


@message
class LoopTiming(Message):
    """The control loop's timing since its start: exact percentiles, and histograms over HISTOGRAM_EDGES_US."""

    loop_hz: float = number("Hz", "rate wanted", minimum=0)
    ticks: int = integer("", "ticks since the start")
    missed_ticks: int = integer("", "ticks that began after their period was over")
    tick_p50_us: float = number("us", "time of the tick's work, median", minimum=0)
    tick_p99_us: float = number("us", "time of the tick's work, 99th percentile", minimum=0)
    tick_p999_us: float = number("us", "time of the tick's work, 99.9th percentile", minimum=0)
    tick_max_us: float = number("us", "time of the tick's work, longest", minimum=0)
    lateness_p50_us: float | None = number("us", "wake-up after due time, median; nil in virtual time", default=None)
    lateness_p99_us: float | None = number("us", "the same, 99th percentile", default=None)
    lateness_p999_us: float | None = number("us", "the same, 99.9th percentile", default=None)
    lateness_max_us: float | None = number("us", "the same, longest", default=None)
    longest_gap_ns: int = integer("ns", "longest time between two setpoints sent", default=0)
    longest_gap_where: str = text("where that gap arose, empty where not known", default="")
    tick_histogram: tuple[int, ...] = integers("ticks", "ticks by the time of their work", _BUCKETS, bits=32)


@message
class Log(Message):
    """One line of a log."""

    level: str = choice("how serious", LOG_LEVELS)
    source: str = text("process or part that says it")
    text: str = text("what it says")


@message
class Command(Message):
    """What a commander asks of the rig, always answered. Judged by who gives it, under which lease, and how fresh it is.

    `stamp_ns` is when it was issued, on the rig's clock; `sequence` grows with each command of one lease.
    """

    id: str = text("unique to this command; the same id twice is refused")
    commander: str = text("who gives it; must be the name in the key that it came on")
    lease: str = text("the lease under which it is given; clock, take, hold and stop need none", default="")
    expires_ns: int = integer("ns", "not to be executed after this time, on the rig's clock")
    action: str = choice("what to do", ACTIONS)
    target: str = choice(
        "kind of the target; none unless action is target",
        TARGETS,
    )
    target_m: Vector | None = vector("m", "tip position, base frame", _triple("target", "m"), default=None)
    normal: Vector | None = vector(
        "", "unit vector into the tissue, base frame, along which to press", _triple("normal"), default=None
    )
    force_N: float | None = number("N", "force to hold along the normal", default=None, minimum=0, maximum=1)
    fault: int = integer("", "fault code that clear_fault clears, 0 for all", bits=8, default=0)

    def check(self) -> None:
        """Each action carries what it needs; expiry comes after issue."""
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


@message
class Reply(Message):
    """The answer to a command. `stamp_ns` is the rig's clock when it was answered."""

    id: str = text("id of the command that it answers")
    result: str = choice("what became of it", RESULTS)
    lease: str = text("the lease that a take has given, empty otherwise", default="")
    lease_expires_ns: int = integer("ns", "when that lease ends if it is not renewed", default=0)
    text: str = text("why, in words", default="")


@message
class CommandCounts(Message):
    """Who holds the lease, and what became of all commands since the start."""

    holder: str = text("commander that holds the lease, empty when nobody does", default="")
    lease_expires_ns: int = integer("ns", "when the lease ends if it is not renewed", default=0)
    accepted: int = integer("", "commands carried out")
    refused: int = integer("", "refused: no lease, wrong role, or not possible now")
    expired: int = integer("", "came after their expiry")
    replayed: int = integer("", "came a second time, or out of sequence")
    malformed: int = integer("", "no command at all, or larger than a command may be")
    flooded: int = integer("", "not even read, because their sender sends too many")


@message
class Alarm(Message):
    """Rig and twin have parted: where, and what is probably missing from the twin."""

    subsystem: str = text("link of the chain, as in a diagnosis")
    effect: str = text("probable cause: an id of the vocabulary, or unlisted")
    channel: str = text("output that is furthest off")
    score: float = number("", "how far it is beyond what is allowed; above 1 is an alarm", minimum=0)
    explained: float = number("", "share of the mismatch that the cause explains", minimum=0, maximum=1)
    since_ns: int = integer("ns", "when it was first seen, on the rig's clock")
    words: str = text("the same in one sentence")


@message
class SimulatedTruth(Message):
    """What only a simulator can know. Drawn into reports; no controller, estimator or verdict reads it."""

    tip_m: Vector = vector("m", "true tip, base frame", _triple("tip", "m"))
    wall_m: Vector | None = vector("m", "a point of the wall now, base", _triple("wall", "m"), default=None)
    contact_force_N: Vector = vector("N", "true force on the tissue, base frame", _FORCE)
    distal_insertion_m: float | None = number("m", "true insertion of the distal end", default=None)
    distal_roll_rad: float | None = number("rad", "true roll of the distal end", default=None)
    distal_curvature_per_m: float | None = number("1/m", "true unloaded curvature", default=None)


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
    Topic("force/sensor", ForceSensor, 500, "state", "realtime -> host, tools", "measured force"),
    Topic("force/estimate", ForceEstimate, 40, "state", "host -> realtime, tools", "force estimated from poses"),
    Topic("state", RigState, 100, "state", "realtime -> host, tools", "mode, safety action and cause, target"),
    Topic("board", BoardCounters, 20, "state", "realtime -> host, tools", "counters of the stepper board"),
    Topic("loop", LoopTiming, 2, "state", "realtime -> host, tools", "timing of the control loop"),
    Topic("log", Log, 0, "event", "all -> host, tools", "log lines"),
    Topic("request", Command, 0, "query", "commander -> realtime", "commands, on request/NAME; each is answered by a Reply"),
    Topic("command", Command, 0, "event", "realtime -> host, tools", "commands as they came, for the record"),
    Topic("reply", Reply, 0, "event", "realtime -> host, tools", "what became of them"),
    Topic("commander", CommandCounts, 2, "state", "realtime -> host, tools", "who holds the lease; counts of commands"),
    Topic("alarm", Alarm, 0, "event", "diagnosis -> host, tools", "rig and twin have parted: subsystem and probable cause"),
    Topic("sim/truth", SimulatedTruth, 100, "state", "sim -> host", "the simulator's truth, for reports only"),
)
TOPICS: dict[str, Topic] = {topic.name: topic for topic in _TABLE}

_RIG = re.compile(r"[a-z0-9_]{1,32}")
_NAME = re.compile(r"[a-z0-9_-]{1,32}")
_KEY = re.compile(r"seldinger/v(\d+)/([a-z0-9_]{1,32})/(.+)")


def key(rig: str, name: str) -> str:
    """The zenoh key of topic `name` on rig `rig`. Raises ValueError for an unknown topic or a bad rig name."""
    if name not in TOPICS:
        raise ValueError(f"topic: found {name!r}, wanted one of {', '.join(TOPICS)}")
    if not _RIG.fullmatch(rig):
        raise ValueError(f"rig: found {rig!r}, wanted 1 to 32 of a-z, 0-9 and _")
    return f"seldinger/v{SCHEMA_VERSION}/{rig}/{name}"


def check_name(name: str) -> str:
    """`name` if a commander or reader may bear it. Raises ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"commander: found {name[:40]!r}, wanted 1 to 32 of a-z, 0-9, - and _")
    return name


def request_key(rig: str, name: str) -> str:
    """The zenoh key on which commander `name` of rig `rig` asks; `*` for all of them. Raises ValueError."""
    return f"{key(rig, 'request')}/{name if name == '*' else check_name(name)}"


def topic_of(key_expression: str) -> tuple[str, Topic]:
    """(rig, topic) of a key. Raises ValueError for a key of another version, an unknown topic or anything else."""
    match = _KEY.fullmatch(key_expression)
    if not match or match[1] != str(SCHEMA_VERSION) or match[3] not in TOPICS:
        raise ValueError(f"key: found {key_expression[:80]!r}, wanted seldinger/v{SCHEMA_VERSION}/<rig>/<topic>")
    return match[2], TOPICS[match[3]]


def as_markdown() -> str:
    """The table as a page for people: every topic, then every message with its fields and units."""
    lines = ["| topic | message | rate | direction | what |", "|---|---|---|---|---|"]
    for topic in _TABLE:
        rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "when it happens"
        lines.append(f"| `{topic.name}` | {topic.message.__name__} | {rate} | {topic.direction} | {topic.doc} |")
    for declared in dict.fromkeys(topic.message for topic in _TABLE):
        lines += [
            "",
            f"### {declared.__name__}",
            "",
            (declared.__doc__ or "").strip(),
            "",
            "| field | type | unit | what |",
            "|---|---|---|---|",
        ]
        for name, spec in specs(declared).items():
            kind = f"{spec.kind}[{len(spec.columns)}]" if spec.columns else spec.kind
            lines.append(f"| `{name}` | {kind}{' or nil' if spec.optional else ''} | {spec.unit or '-'} | {spec.doc} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(as_markdown(), end="")
