"""The one declaration of every frame on the serial link to the stepper board; codec and C header follow from it."""

import enum
import zlib
from dataclasses import dataclass

from protocol.enums import BoardState

AXES = ("insertion", "roll", "knob")
AXIS_COUNT = len(AXES)
BAUD = 500_000
BITS_PER_BYTE = 10  # 8N1: start, eight data bits, stop
TIMER_HZ = 20_000  # step timer of the board: at most one step an axis and tick
QUEUE_CAPACITY = 4  # set-points that wait behind the one in execution
HORIZON_US = 12_000  # a set-point further ahead is refused: with the speed limit it bounds the stopping distance
DEADMAN_US = 30_000  # no valid set-point for this long stops the axes and latches a fault
STOP_US = 50_000  # from full speed every axis must be able to come to rest in this time
FIRMWARE_VERSION = (1, 0)  # major changes break the link, minor ones do not


class Fault(enum.IntEnum):
    """Why the board stopped; latched until CLEAR_FAULT names it."""

    NONE = 0
    DEADMAN = 1  # no valid set-point for DEADMAN_US
    ESTOP = 2  # the emergency stop opened
    LIMIT = 3  # a limit switch opened while armed
    WATCHDOG = 4  # the hardware watchdog reset the board
    BROWNOUT = 5  # the supply dipped and reset the board


class Result(enum.IntEnum):
    """Answer to a command, in ACK."""

    OK = 0
    BAD_STATE = 1  # not allowed in the present state
    BAD_VALUE = 2  # a field is out of its range
    NOT_IDENTIFIED = 3  # no HELLO with this board's protocol hash yet
    BOOT_MISMATCH = 4  # ARM expected another boot count: the board was reset
    NOT_CONFIGURED = 5  # an axis has no limits since the board started
    CAUSE_PRESENT = 6  # the emergency stop is still open
    WRONG_FAULT = 7  # CLEAR_FAULT named another fault than the latched one


class Reject(enum.IntEnum):
    """Why the last set-point was refused, in STATUS."""

    NONE = 0
    STATE = 1  # neither ARMED nor RUNNING
    ORDER = 2  # number or execution time not after the last accepted one
    HORIZON = 3  # execution time more than HORIZON_US ahead
    EXPIRED = 4  # arrived after execute_us + expiry_us
    OVERFLOW = 5  # the queue was full
    SPEED = 6  # further than the axis' speed limit allows
    SOFT_LIMIT = 7  # outside soft_min_steps .. soft_max_steps
    LIMIT_SWITCH = 8  # further into an open limit switch


class Mcu(enum.IntEnum):
    """The processor the firmware runs on."""

    NATIVE = 0  # compiled for the host, for tests
    ATMEGA2560 = 1
    ATMEGA328P = 2


class ResetCause(enum.IntEnum):
    """Why the processor started."""

    POWER = 0
    EXTERNAL = 1  # the reset pin; on an Arduino also opening the port (DTR)
    BROWNOUT = 2
    WATCHDOG = 3


class InputBit(enum.IntEnum):
    """Bits of STATUS.inputs; a set bit is an open switch (hit, or a broken wire)."""

    LIMIT_0_MIN = 0
    LIMIT_0_MAX = 1
    LIMIT_1_MIN = 2
    LIMIT_1_MAX = 3
    LIMIT_2_MIN = 4
    LIMIT_2_MAX = 5
    ESTOP = 6


# By the name that the C header and the protocol's hash know.
ENUMS: dict[str, type[enum.IntEnum]] = {
    "State": BoardState,
    "Fault": Fault,
    "Result": Result,
    "Reject": Reject,
    "Mcu": Mcu,
    "ResetCause": ResetCause,
    "InputBit": InputBit,
}
WIRE_BYTES = {"u8": 1, "u16": 2, "u32": 4, "i32": 4}


@dataclass(frozen=True)
class Field:
    """One field of a frame.

    name: with its unit as suffix. wire: key of WIRE_BYTES, little endian. unit: of one count on the wire.
    scale: SI units in one count (1 where the unit is a count or a code). count: array length, 1 for a scalar.
    """

    name: str
    wire: str
    unit: str
    doc: str
    scale: float = 1.0
    count: int = 1

    @property
    def n_bytes(self) -> int:
        """Return the field's length on the wire in bytes."""
        return WIRE_BYTES[self.wire] * self.count


@dataclass(frozen=True)
class Frame:
    """One frame: name, id (u8), direction ("mcu": to the board, "host": from it), fields in wire order, doc."""

    name: str
    id: int
    to: str
    fields: tuple[Field, ...]
    doc: str

    @property
    def payload_bytes(self) -> int:
        """Bytes of all fields together."""
        return sum(f.n_bytes for f in self.fields)


def _us(name: str, doc: str, wire: str = "u32") -> Field:
    return Field(name, wire, "us", doc, 1e-6)


def _per_axis(name: str, unit: str, doc: str) -> Field:
    return Field(name, "i32", unit, doc, count=AXIS_COUNT)


def _counter(name: str, doc: str) -> Field:
    return Field(name, "u16", "count", doc + " (wraps)")


_AXIS = Field("axis", "u8", "index", "0 insertion, 1 roll, 2 knob")
_BOOT = Field("boot_count", "u16", "count", "starts of the processor, kept in EEPROM")
_HASH = Field("protocol_hash", "u32", "code", "PROTOCOL_HASH of the sender")

FRAMES: tuple[Frame, ...] = (
    Frame(
        "HELLO",
        0x01,
        "mcu",
        (_HASH,),
        "Opens a session: answered by IDENTITY. Commands and set-points have a sequence each; HELLO restarts both, ARM that "
        "of the set-points.",
    ),
    Frame(
        "CONFIGURE",
        0x02,
        "mcu",
        (
            _AXIS,
            Field("max_speed_steps_per_s", "u32", "steps/s", "set-points that need more are rejected"),
            Field("max_accel_steps_per_s2", "u32", "steps/s^2", "deceleration of every stop"),
            Field("soft_min_steps", "i32", "steps", "lowest position accepted"),
            Field("soft_max_steps", "i32", "steps", "highest position accepted"),
        ),
        "Sets the limits of one axis; only DISARMED.",
    ),
    Frame("ARM", 0x03, "mcu", (_BOOT,), "DISARMED to ARMED, if the boot count is the one the host knows."),
    Frame("DISARM", 0x04, "mcu", (), "Decelerates, then DISARMED."),
    Frame(
        "CLEAR_FAULT",
        0x05,
        "mcu",
        (Field("fault", "u8", "code", "the Fault to clear"),),
        "FAULT to DISARMED on an operator's word, never by a program alone.",
    ),
    Frame(
        "SETPOINT",
        0x06,
        "mcu",
        (
            Field("number", "u16", "count", "rises by one a set-point (wraps)"),
            _us("execute_us", "board time at which the position is reached"),
            _us("expiry_us", "after execute_us + expiry_us it is never executed", "u16"),
            _per_axis("position_steps", "steps", "position at execute_us"),
        ),
        "One timed target for all axes; positions in between are interpolated linearly. Not acknowledged.",
    ),
    Frame(
        "SET_POSITION",
        0x07,
        "mcu",
        (_AXIS, Field("position_steps", "i32", "steps", "new value of the counter")),
        "Renames the present position of one axis (step and encoder counter); only DISARMED.",
    ),
    Frame("PING", 0x08, "mcu", (), "Answered by ACK; measures the round trip."),
    Frame(
        "IDENTITY",
        0x81,
        "host",
        (
            _HASH,
            Field("firmware_version", "u16", "code", "major * 256 + minor"),
            _BOOT,
            Field("reset_cause", "u8", "code", "a ResetCause"),
            Field("mcu", "u8", "code", "a Mcu"),
            Field("timer_hz", "u16", "Hz", "rate of the step timer"),
            Field("axes", "u8", "count", "axes driven"),
            Field("queue_capacity", "u8", "count", "set-points the queue holds"),
            _us("deadman_us", "silence that stops the axes"),
            _us("horizon_us", "furthest execution time accepted"),
        ),
        "Answer to HELLO: who is there.",
    ),
    Frame(
        "STATUS",
        0x82,
        "host",
        (
            _us("mcu_time_us", "board time of this snapshot (wraps)"),
            Field("last_setpoint", "u16", "count", "number of the last accepted set-point"),
            _per_axis("position_steps", "steps", "steps made"),
            _per_axis("encoder_counts", "counts", "quadrature counts seen"),
            Field("state", "u8", "code", "a State"),
            Field("fault", "u8", "code", "the latched Fault"),
            Field("inputs", "u8", "bits", "an InputBit each"),
            Field("queue_depth", "u8", "count", "set-points waiting"),
            Field("deadman_age_ms", "u8", "ms", "time since the last valid set-point while RUNNING (stays at 255)", 1e-3),
            Field("last_reject", "u8", "code", "Reject of the last refused set-point"),
            _BOOT,
            _counter("crc_errors", "damaged frames received"),
            _counter("sequence_errors", "frames lost, repeated or out of order"),
            _counter("underruns", "the queue ran dry while RUNNING"),
            _counter("rejected", "set-points refused, but for those expired or overflowed"),
            _counter("expired", "set-points that came after their expiry"),
            _counter("overflows", "set-points that found the queue full"),
            _counter("late", "set-points executed after their time, before their expiry"),
            _counter("rx_overruns", "bytes lost in the receiver"),
            _counter("encoder_errors", "impossible quadrature transitions"),
        ),
        "Sent at 200 Hz.",
    ),
    Frame(
        "ACK",
        0x83,
        "host",
        (
            Field("command", "u8", "code", "frame id answered"),
            Field("command_sequence", "u8", "count", "its sequence number"),
            Field("result", "u8", "code", "a Result"),
            _us("mcu_time_us", "board time of the answer"),
        ),
        "Answer to every command but HELLO and SETPOINT.",
    ),
)

FRAME_BY_NAME = {frame.name: frame for frame in FRAMES}
FRAME_BY_ID = {frame.id: frame for frame in FRAMES}
OVERHEAD_BYTES = 4  # id, sequence, CRC-16
MAX_BODY_BYTES = max(frame.payload_bytes for frame in FRAMES) + OVERHEAD_BYTES
STATUS_PERIOD_US = 5_000


def wire_bytes(frame: Frame) -> int:
    """Bytes of a whole frame on the line: body, one COBS byte, delimiter."""
    return frame.payload_bytes + OVERHEAD_BYTES + 2


def _protocol_hash() -> int:
    lines = [
        f"{f.name} {f.id} {f.to} " + ",".join(f"{x.name}:{x.wire}:{x.unit}:{x.count}" for x in f.fields) for f in FRAMES
    ]
    lines += [f"{name} " + ",".join(f"{m.name}={m.value}" for m in e) for name, e in ENUMS.items()]
    lines.append(f"baud {BAUD} timer {TIMER_HZ} deadman {DEADMAN_US} horizon {HORIZON_US} stop {STOP_US}")
    return zlib.crc32("\n".join(lines).encode("ascii"))


PROTOCOL_HASH = _protocol_hash()  # u32; differs as soon as either side was built from another declaration
