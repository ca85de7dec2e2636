"""The link to the stepper board without I/O: bytes in, events out; commands as bytes to send."""

import enum
from collections.abc import Sequence
from typing import NamedTuple

from protocol.enums import BoardState
from protocol.serial_codec import AnyFrame, StreamDecoder, encode
from protocol.serial_frames import (
    AXES,
    BAUD,
    BITS_PER_BYTE,
    FIRMWARE_VERSION,
    FRAME_BY_ID,
    FRAME_BY_NAME,
    PROTOCOL_HASH,
    Fault,
    Mcu,
    ResetCause,
    Result,
    wire_bytes,
)
from realtime.drivers.mcu_clock import McuClock

RETRY_NS = 100_000_000  # a command without an answer is sent again after this time
_STATUS_LINE_NS = wire_bytes(FRAME_BY_NAME["STATUS"]) * BITS_PER_BYTE * 1_000_000_000 // BAUD

FAULT_ADVICE = {
    Fault.NONE: "no fault",
    Fault.DEADMAN: "no valid set-point for 30 ms: look for a stall of the host or a broken cable, then clear it",
    Fault.ESTOP: "the emergency stop is open: release it, then clear it",
    Fault.LIMIT: "a limit switch opened: clear it, then move away from that end",
    Fault.WATCHDOG: "the firmware hung and was reset by its watchdog: home the axes again, and report it",
    Fault.BROWNOUT: "the board's supply dipped: check the supply, home the axes again",
}


class LinkPhase(enum.Enum):
    """How far the bring-up has come."""

    HELLO = "hello"  # waits for IDENTITY
    CONFIGURE = "configure"  # waits for the limits to be accepted
    READY = "ready"  # may be armed
    MISMATCH = "mismatch"  # another protocol or firmware: nothing more is sent
    RESET = "reset"  # the processor was reset: call restart() when the operator has acknowledged it


class BoardEventKind(enum.Enum):
    """Kinds of events on the link."""

    IDENTIFIED = "identified"
    READY = "ready"
    STATUS = "status"
    ACK = "ack"  # a command was accepted
    REFUSED = "refused"  # a command was refused
    FAULT = "fault"  # the board latched a fault
    RESET = "reset"  # the processor was reset; positions are lost
    MISMATCH = "mismatch"  # another protocol or firmware version


class BoardIdentity(NamedTuple):
    """IDENTITY as the board sent it."""

    protocol_hash: int
    firmware_version: int
    boot_count: int
    reset_cause: int
    mcu: int
    timer_hz: int
    axes: int
    queue_capacity: int
    deadman_us: int
    horizon_us: int


class BoardStatus(NamedTuple):
    """STATUS as the board sent it, and the host time at which it had arrived whole."""

    arrival_ns: int
    mcu_time_us: int
    last_setpoint: int
    position_steps: tuple[int, int, int]
    encoder_counts: tuple[int, int, int]
    state: int
    fault: int
    inputs: int
    queue_depth: int
    deadman_age_ms: int
    last_reject: int
    boot_count: int
    crc_errors: int
    sequence_errors: int
    underruns: int
    rejected: int
    expired: int
    overflows: int
    late: int
    rx_overruns: int
    encoder_errors: int


class LinkEvent(NamedTuple):
    """One event: its kind, host time of arrival, a line of text, the command it answers ("" for none)."""

    kind: BoardEventKind
    stamp_ns: int
    message: str
    command: str = ""


class AxisLimits(NamedTuple):
    """Limits of one axis, as CONFIGURE sends them. The axis must be able to stop from full speed within 50 ms."""

    max_speed_steps_per_s: int
    max_accel_steps_per_s2: int
    soft_min_steps: int
    soft_max_steps: int


class _Pending(NamedTuple):
    command: str
    axis: int


class StepperBoardLink:
    """State of the link to one board.

    axes: limits in the order of protocol.serial_frames.AXES. Call feed() with whatever arrives, send what
    advance() and the commands return. The bring-up is: advance() until phase is READY, then arm().
    Set-points have their own sequence count, so a compiled loop may send them independently of the commands from here.
    """

    def __init__(self, axes: Sequence[AxisLimits]) -> None:
        if len(axes) != len(AXES):
            raise ValueError(f"axes: found {len(axes)}, wanted {len(AXES)} ({', '.join(AXES)})")
        self.axes = tuple(axes)
        self.phase = LinkPhase.HELLO
        self.identity: BoardIdentity | None = None
        self.status: BoardStatus | None = None
        self.decoder = StreamDecoder()
        self.clock = McuClock()
        self._sequence = 0
        self._setpoint_sequence = 0
        self._pending: dict[int, _Pending] = {}
        self._configured: set[int] = set()
        self._sent_ns: int | None = None
        self._fault = Fault.NONE

    # --- to the board ---------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> bytes:
        """Return the next bytes of the bring-up: HELLO, then the limits; repeated every 100 ms until they are answered.

        A board that holds a fault takes no limits: the operator clears it first.
        """
        if self.phase not in (LinkPhase.HELLO, LinkPhase.CONFIGURE):
            return b""
        if self.phase is LinkPhase.CONFIGURE and self.status is not None and self.status.state != BoardState.DISARMED:
            return b""
        if self._sent_ns is not None and now_ns - self._sent_ns < RETRY_NS:
            return b""
        self._sent_ns = now_ns
        if self.phase is LinkPhase.HELLO:
            return self.hello()
        return b"".join(self.configure(axis) for axis in range(len(AXES)) if axis not in self._configured)

    def restart(self) -> None:
        """Start the bring-up again, after RESET or MISMATCH or when another board was plugged in."""
        self.phase = LinkPhase.HELLO
        self.identity = None
        self.status = None
        self._configured.clear()
        self._pending.clear()
        self._sent_ns = None
        self._fault = Fault.NONE
        self.clock.restart()

    def reconfigure(self, axes: Sequence[AxisLimits]) -> None:
        """Use other limits from now on: `advance` sends them as soon as the board is disarmed, then phase is READY again."""
        self.axes = tuple(axes)
        self._configured.clear()
        self._sent_ns = None
        if self.phase is LinkPhase.READY:
            self.phase = LinkPhase.CONFIGURE

    def unplugged(self) -> None:
        """Start the bring-up again after the cable was unplugged; the boot count is kept, so that a reset is detected."""
        if self.phase not in (LinkPhase.RESET, LinkPhase.MISMATCH):
            self.phase = LinkPhase.HELLO
        self.status = None
        self._configured.clear()
        self._pending.clear()
        self._sent_ns = None
        self.clock.restart()

    def hello(self) -> bytes:
        """Return HELLO, after a delimiter that ends earlier bytes on the line."""
        return b"\0" + self._command("HELLO", protocol_hash=PROTOCOL_HASH)

    def configure(self, axis: int) -> bytes:
        """Return CONFIGURE with the limits of `axis`."""
        return self._command("CONFIGURE", axis=axis, **self.axes[axis]._asdict())

    def set_position(self, axis: int, position_steps: int) -> bytes:
        """Return SET_POSITION, which makes `position_steps` the present position of `axis`."""
        return self._command("SET_POSITION", axis=axis, position_steps=position_steps)

    def arm(self) -> bytes:
        """Return ARM with the boot count of the last IDENTITY. Raises ValueError unless phase is READY."""
        if self.phase is not LinkPhase.READY or self.identity is None:
            raise ValueError(f"board link: found phase {self.phase.value}, wanted ready before arm")
        return self._command("ARM", boot_count=self.identity.boot_count)

    def disarm(self) -> bytes:
        """Return DISARM: the board decelerates and then refuses set-points."""
        return self._command("DISARM")

    def clear_fault(self, fault: int) -> bytes:
        """Return CLEAR_FAULT for an operator who has seen `fault`; no program calls it by itself."""
        return self._command("CLEAR_FAULT", fault=fault)

    def ping(self) -> bytes:
        """Return PING, which the board answers with an ACK event."""
        return self._command("PING")

    def setpoint(self, number: int, execute_us: int, expiry_us: int, position_steps: Sequence[int]) -> bytes:
        """Return SETPOINT, for callers without protocol.setpoint_encoder; number and times are wrapped to the wire."""
        self._setpoint_sequence = self._setpoint_sequence + 1 & 0xFF
        return encode(
            "SETPOINT",
            self._setpoint_sequence,
            number=number & 0xFFFF,
            execute_us=execute_us & 0xFFFFFFFF,
            expiry_us=expiry_us,
            position_steps=[int(s) for s in position_steps],
        )

    def _command(self, name: str, **fields: int) -> bytes:
        self._sequence = self._sequence + 1 & 0xFF
        self._pending[self._sequence] = _Pending(name, fields.get("axis", -1))
        return encode(name, self._sequence, **fields)

    # --- from the board -------------------------------------------------------------------------------------------

    def feed(self, data: bytes, now_ns: int) -> list[LinkEvent]:
        """Return the events in `data`, any portion of the stream. now_ns: host time at which it was read."""
        events: list[LinkEvent] = []
        for message in self.decoder.feed(data):
            if message.name == "STATUS":
                events += self._on_status(message, now_ns)
            elif message.name == "IDENTITY":
                events += self._on_identity(message, now_ns)
            elif message.name == "ACK":
                events += self._on_ack(message, now_ns)
        return events

    def mcu_offset_ns(self, now_ns: int) -> int:
        """Return host time minus board time (ns). Raises ValueError before the first STATUS."""
        return self.clock.offset_ns(now_ns)

    @property
    def armed(self) -> bool:
        """Return whether the board accepts set-points, by its last STATUS."""
        return self.status is not None and self.status.state in (BoardState.ARMED, BoardState.RUNNING)

    def _on_identity(self, message: AnyFrame, now_ns: int) -> list[LinkEvent]:
        identity = BoardIdentity(**message.fields)
        major, minor = divmod(identity.firmware_version, 256)
        if identity.protocol_hash != PROTOCOL_HASH or major != FIRMWARE_VERSION[0]:
            self.phase = LinkPhase.MISMATCH
            return [
                LinkEvent(
                    BoardEventKind.MISMATCH,
                    now_ns,
                    (
                        f"board: found protocol {identity.protocol_hash:#010x}, firmware {major}.{minor}; wanted "
                        f"{PROTOCOL_HASH:#010x}, {FIRMWARE_VERSION[0]}.x: build and flash this version's firmware"
                    ),
                )
            ]
        events = self._check_boot(identity.boot_count, now_ns)
        if self.phase is LinkPhase.HELLO:
            self.identity = identity
            self.phase = LinkPhase.CONFIGURE
            self._sent_ns = None
            events.append(
                LinkEvent(
                    BoardEventKind.IDENTIFIED,
                    now_ns,
                    (
                        f"board: {Mcu(identity.mcu).name.lower()}, firmware {major}.{minor}, "
                        f"start {identity.boot_count} by {ResetCause(identity.reset_cause).name.lower()}"
                    ),
                )
            )
        return events

    def _on_status(self, message: AnyFrame, now_ns: int) -> list[LinkEvent]:
        status = BoardStatus(arrival_ns=now_ns, **message.fields)
        events = self._check_boot(status.boot_count, now_ns)
        if self.status is None and self.phase is LinkPhase.HELLO:
            self._sent_ns = None  # the board has just started to send: an earlier HELLO was lost
        self.clock.update(status.mcu_time_us, now_ns - _STATUS_LINE_NS)
        self.status = status
        fault = Fault(status.fault)
        if fault != self._fault and fault != Fault.NONE:
            events.append(LinkEvent(BoardEventKind.FAULT, now_ns, f"board fault {fault.name}: {FAULT_ADVICE[fault]}"))
        self._fault = fault
        events.append(LinkEvent(BoardEventKind.STATUS, now_ns, ""))
        return events

    def _check_boot(self, boot_count: int, now_ns: int) -> list[LinkEvent]:
        if self.identity is None or boot_count == self.identity.boot_count or self.phase is LinkPhase.RESET:
            return []
        known = self.identity.boot_count
        self.phase = LinkPhase.RESET
        self.clock.restart()
        return [
            LinkEvent(
                BoardEventKind.RESET,
                now_ns,
                (f"board was reset: found start {boot_count}, wanted {known}; its positions are lost, home the axes again"),
            )
        ]

    def _on_ack(self, message: AnyFrame, now_ns: int) -> list[LinkEvent]:
        result = Result(message.fields["result"])
        frame = FRAME_BY_ID.get(message.fields["command"])
        pending = self._pending.pop(message.fields["command_sequence"], None)
        if frame is None or pending is None or pending.command != frame.name:
            return []
        if result != Result.OK:
            message_text = f"board refused {frame.name}: {result.name}"
            if self.status is not None:
                message_text += f" (it is {BoardState(self.status.state).name}, fault {Fault(self.status.fault).name})"
            return [LinkEvent(BoardEventKind.REFUSED, now_ns, message_text, frame.name)]
        events = [LinkEvent(BoardEventKind.ACK, now_ns, f"board accepted {frame.name}", frame.name)]
        if frame.name == "CONFIGURE":
            self._configured.add(pending.axis)
            if self.phase is LinkPhase.CONFIGURE and len(self._configured) == len(AXES):
                self.phase = LinkPhase.READY
                events.append(LinkEvent(BoardEventKind.READY, now_ns, "board ready"))
        return events
