"""The realtime core: all that the realtime process does except to tick and to move bytes.

Two shells drive it: `realtime.core.process` with threads and ports on the wall clock, `realtime.core.lockstep` in
virtual time. Samples, commands and the records of past ticks go in; input records for the next tick, frames for the
board, messages and replies come out. The core reads no clock and opens no port, so that the same inputs give the same
outputs in both shells.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from protocol.enums import ForceSource, Phase, SafetyAction
from protocol.errors import InputError
from protocol.rig_file import AXES, Rig
from protocol.topics import Command, ForceEstimate, Log, LoopTiming, Message, Reply
from realtime.control import safety
from realtime.control.configure import tick_parameters
from realtime.control.inverse_kinematics import curvature_of_knob
from realtime.control.records import POSE, new
from realtime.core import telemetry
from realtime.core.board_intake import axis_limits, board_message, take_status
from realtime.core.cause_watch import CauseWatch
from realtime.core.command_gate import CommandGate, without_secrets
from realtime.core.force_zero import ForceZero
from realtime.core.intake import Intake
from realtime.core.operator_commands import OperatorCommands, RigPosition
from realtime.core.supervision import Supervision, SupervisionFinding
from realtime.drivers.aurora import PoseSample
from realtime.drivers.device_events import DeviceEvent
from realtime.drivers.device_events import DeviceEventKind as DeviceEventKind
from realtime.drivers.net_ft import ForceSample
from realtime.drivers.stepper_board import BoardEventKind, StepperBoardLink

# A longer time between two ticks than this is logged.
LONGEST_GAP_NS = 10_000_000
# A cause that comes and goes, as a stale pose may at every frame, is logged again after this time without it.
CAUSE_QUIET_NS = 1_000_000_000
# Warnings that are logged: the loop continues, and the operator needs to see them.
_LOGGED_WARNINGS = safety.STILL_PRESSED | safety.FORCE_UNREACHED | safety.BODY_CONTACT
# Causes whose log line carries what sensor, estimate and geometry say.
_FORCE_CAUSES = safety.OVER_FORCE | safety.FORCE_UNDECIDED | safety.FORCE_DISAGREES | _LOGGED_WARNINGS
_BOARD_ERRORS = (BoardEventKind.FAULT, BoardEventKind.RESET, BoardEventKind.MISMATCH)
_DEVICE_LEVELS = {DeviceEventKind.LOST: "warning", DeviceEventKind.WARNING: "warning", DeviceEventKind.ERROR: "error"}


class CommandRequest(NamedTuple):
    """A request of commander `name`: the bytes that came on its key."""

    name: str
    payload: bytes


class Tick(NamedTuple):
    """A tick that has run: its number, counted from the start of the loop, and its OUTPUTS record."""

    number: int
    outputs: np.record


@dataclass
class Arrived:
    """Data that has arrived since the last step. Each field may be empty.

    Attributes:
        ticks: ticks that have run since the last step, in order.
        board: bytes from the stepper board.
        board_lost: why the board's port is gone; empty while it is there.
        poses, forces, device_events: what the sensor drivers handed over.
        estimates: messages of the model process.
        requests: requests of commanders.
        log_lines: log lines of the shell itself; published unchanged.
        loop_runs: whether the loop ticks; while it does not, only a stop is accepted.
    """

    ticks: Sequence[Tick] = ()
    board: bytes = b""
    board_lost: str = ""
    poses: Sequence[PoseSample] = ()
    forces: Sequence[ForceSample] = ()
    device_events: Sequence[DeviceEvent] = ()
    estimates: Sequence[ForceEstimate] = ()
    requests: Sequence[CommandRequest] = ()
    log_lines: Sequence[Log] = ()
    loop_runs: bool = True


@dataclass
class Leaving:
    """Data to be sent after a step.

    Attributes:
        changed: names of the input records that were filled, for the shell to hand to the tick.
        frames: bytes for the board, in order; the tick's set-points are not among them.
        messages: (topic, message) to publish, in order; log lines are messages of the topic `log`.
        replies: one for each request; None where the sender floods and gets none.
    """

    changed: set[str] = field(default_factory=set)
    frames: list[bytes] = field(default_factory=list)
    messages: list[tuple[str, Message]] = field(default_factory=list)
    replies: list[Reply | None] = field(default_factory=list)

    def log(self, stamp_ns: int, level: str, source: str, text: str) -> None:
        """Add a line to the topic `log`; text beyond 500 characters is cut."""
        self.messages.append(("log", Log(stamp_ns=stamp_ns, level=level, source=source, text=text[:500])))


class RigCore:
    """Turns received data into data to be sent, one `step` at a time. Only one thread may use it at a time.

    Args:
        rig: the rig file.
        records: the tick's input records by field name of INPUTS (tip, shaft, sensor, estimate, board, command); the core
            fills them, the shell hands them to the tick. The pose of a third sensor is not among them: no law uses it.
        timing: returns the loop's timing for a message with the stamp (ns) that it is given; the shell measures it.
        force_source: which force closes the loop, `sensor` or `estimate`.
        new_lease: makes the secret of a lease.
    """

    def __init__(
        self,
        rig: Rig,
        records: Mapping[str, np.record],
        timing: Callable[[int], LoopTiming],
        force_source: str = "sensor",
        new_lease: Callable[[], str] = lambda: secrets.token_hex(16),
    ) -> None:
        self.rig, self.params = rig, tick_parameters(rig, force_source)
        self.now_ns = 0
        # Of the newest tick.
        self.phase, self.force_source = Phase.DISARMED, ForceSource(int(self.params[0].force_source))
        self.action = SafetyAction.NONE
        self.board_errors: list[str] = []
        self.link = StepperBoardLink(axis_limits(rig))
        self.commands = OperatorCommands(
            rig, records["command"], self.link, self._silent_sensors, self._standing, self._zero_force
        )
        self.gate = CommandGate(
            lambda: self.now_ns, self._execute, roles=rig.access.roles if rig.access else {}, new_lease=new_lease
        )
        self.supervision = Supervision(rig)
        self._watched = 0
        self._records, self._timing, self._intake = records, timing, Intake(rig)
        self._names = {tool.handle: tool.name for tool in rig.tracker.tools}
        self._rear = new(POSE)[0]  # newest pose of a third sensor
        self._force_zero = ForceZero(rig.force_sensor.noise_N, rig.force_sensor.range_N)
        self._outputs: np.record | None = None  # of the newest tick
        self._leaving, self._loop_runs = Leaving(), True
        self._first = True
        self._tick_ns = 0
        self._cause_seen_ns: dict[int, int] = {}
        self._causes = CauseWatch()
        # Axes that were homed since the board was connected or reset.
        self._homed: set[str] = set()

    def prepare(self) -> None:
        """Compile what a step calls now and then: the readings would wait a second for it at the first such command."""
        safety.action_of(0)
        curvature_of_knob(self.params[0].kinematics, 0.0)
        self.commands.prepare()

    def step(self, now_ns: int, arrived: Arrived) -> Leaving:
        """Process the data that has arrived by `now_ns` (the rig's clock, ns) and return the data to be sent.

        Past ticks come first: everything below is judged by the phase that the loop is in now.
        """
        self.now_ns, self._loop_runs = now_ns, arrived.loop_runs
        leaving = self._leaving = Leaving()
        if self._first:  # the tick starts with the normal that stands in the command record
            leaving.changed.add("command")
            self._first = False
        leaving.messages += [("log", line) for line in arrived.log_lines]
        for tick in arrived.ticks:
            self._take_tick(tick)
        self._take_board(arrived.board, arrived.board_lost)
        self._take_poses(arrived.poses)
        self._take_forces(arrived.forces)
        for event in arrived.device_events:
            self._take_device_event(event)
        for estimate in arrived.estimates:
            self._take_estimate(estimate)
        self._report(self.supervision.host_overdue(now_ns))
        self._hand_over_causes()
        for request in arrived.requests:
            self._take_request(request)
        bring_up = self.link.advance(now_ns)
        if bring_up:
            leaving.frames.append(bring_up)
        self._advance_homing()
        return leaving

    @property
    def _homes(self) -> bool:
        return self.commands.homing is not None

    @property
    def _moves(self) -> bool:
        """Return whether the loop is armed: only then are the cross-checks of its motion made."""
        return self.phase not in (Phase.DISARMED, Phase.HOMING)

    def _advance_homing(self) -> None:
        """Move the axis that is being homed a step further, and log how it ended."""
        homing = self.commands.homing
        if homing is None:
            return
        frame = homing.advance(self.now_ns, float(np.linalg.norm(self._records["sensor"].force_N)))
        if frame:
            self._leaving.frames.append(frame)
        if homing.done:
            self.commands.homing = None
            if not homing.problem:
                self._homed.add(homing.axis)
            self._log("error" if homing.problem else "info", "home", homing.text)

    def shut_down(self) -> Leaving:
        """Disarm the loop and the board, for the end of the process."""
        self._leaving = Leaving()
        self.commands.disarm()
        self._command_changed()
        return self._leaving

    def _log(self, level: str, source: str, text: str) -> None:
        self._leaving.log(self.now_ns, level, source, text)

    def _publish(self, topic: str, message: Message) -> None:
        self._leaving.messages.append((topic, message))

    # --- ticks that have run: telemetry, gaps, causes ---

    def _take_tick(self, tick: Tick) -> None:
        outputs, number = tick.outputs, tick.number
        self._outputs = outputs
        self.phase, self.force_source = Phase(int(outputs.phase)), ForceSource(int(outputs.force_source))
        self.action = SafetyAction(int(outputs.action))
        if self._homes:
            self.phase = Phase.HOMING
        tick_ns = int(outputs.now_ns)
        self._watch_gap(tick_ns)
        self._log_new_causes(outputs, tick_ns)
        self._causes.take_tick(tick_ns, self.action, int(outputs.cause))
        if number % telemetry.STAGE_EVERY == 0:
            self._publish("stage", telemetry.stage_message(self.params[0], self._records["board"], outputs, self._located))
        if number % telemetry.STATE_EVERY == 0:
            state = telemetry.state_message(self._records["command"], outputs, self._located, self._homes)
            self._publish("state", state)
        if number % telemetry.BOARD_EVERY == 0 and self.link.status is not None:
            counters = board_message(self.link, tick_ns)
            if not self._homes:  # a homing moves onto the switch: that fault is what it looks for
                self._causes.take_board(counters)
            self._publish("board", counters)
        if self._causes.changed or number % telemetry.LOOP_EVERY == 0:
            self._publish("cause", self._causes.message(tick_ns))
        if number % telemetry.LOOP_EVERY == 0:
            self._publish("loop", self._timing(tick_ns))
            self._publish("commander", self.gate.state())

    def _watch_gap(self, tick_ns: int) -> None:
        gap_ns = tick_ns - self._tick_ns
        if self._tick_ns and not 0 < gap_ns <= LONGEST_GAP_NS:
            text = (
                f"the computer stalled, or its clock jumped: {gap_ns * 1e-6:.1f} ms between two ticks, "
                f"wanted {self.params[0].period_s * 1e3:g} ms"
            )
            self._leaving.log(tick_ns, "warning", "realtime", text)
            timing = self._timing(tick_ns)
            # Only the longest gap's place is kept, and it includes how late the second tick was.
            where = timing.longest_gap_where if abs(timing.longest_gap_ns - gap_ns) < LONGEST_GAP_NS else ""
            self._causes.take_gap(tick_ns, gap_ns, where)
        self._tick_ns = tick_ns

    def _log_new_causes(self, outputs: np.record, tick_ns: int) -> None:
        """Log a cause that makes the loop hold, retract or stop, when it appears, and a force that remains."""
        new, causes, action = 0, int(outputs.cause), int(outputs.action)
        while causes:
            bit = causes & -causes
            causes ^= bit
            seen_ns = self._cause_seen_ns.get(bit)
            self._cause_seen_ns[bit] = tick_ns
            if seen_ns is None or not 0 <= tick_ns - seen_ns <= CAUSE_QUIET_NS:
                new |= bit
        if new and (safety.action_of(new) >= SafetyAction.HOLD or new & _LOGGED_WARNINGS):
            text = "; ".join(safety.messages(new))
            if new & _FORCE_CAUSES:
                text += f" ({telemetry.witness_text(outputs.witness_N)})"
            self._leaving.log(tick_ns, "warning", "safety", f"{SafetyAction(action).label}: {text}")

    @property
    def _located(self) -> bool:
        """Return whether a pose of the tip has arrived."""
        return bool(self._records["tip"].count > 0)

    # --- devices ---

    def _take_board(self, data: bytes, lost: str) -> None:
        board = self._records["board"]
        for event in self.link.feed(data, self.now_ns):
            if event.kind is BoardEventKind.STATUS:
                take_status(board, self.link, self.now_ns)
                self._leaving.changed.add("board")
                if self.commands.take_board_status():
                    self._command_changed()
                if self._moves and board.ready and self.link.status is not None:
                    impossible = self.link.status.encoder_errors
                    steps, counts = board.position_steps, board.encoder_counts
                    self._report(self.supervision.status(steps, counts, self.now_ns, impossible))
                continue
            # A homing moves onto the switch: that fault is what it looks for.
            is_error = event.kind in _BOARD_ERRORS and not (self._homes and event.kind is BoardEventKind.FAULT)
            if is_error:
                self.board_errors.append(event.message)
            if event.kind is BoardEventKind.RESET:
                self._homed.clear()
            self._log("error" if is_error else "info", "board", event.message)
        if lost:
            self._log("error", "board", lost)
            self._disarm_after_return("board")
            self.link.unplugged()
            self._homed.clear()

    def _take_poses(self, samples: Sequence[PoseSample]) -> None:
        names = self._names
        # The tip's pose last in its frame: an estimator that answers it then has the other poses of the same time.
        for sample in sorted(samples, key=lambda one: (one.stamp_ns, names.get(one.tool) == "tip")):
            name = names.get(sample.tool)
            if sample.missing or name is None:
                continue
            record = self._records[name] if name in self._records else self._rear
            self._intake.pose(record, sample.stamp_ns, sample.arrival_ns, sample.position_m, sample.quaternion_wxyz)
            if record is not self._rear:
                self._leaving.changed.add(name)
                # A retraction from a hard contact displaces a bent tip along the wall without turning it.
                if self._moves and self.action < SafetyAction.RETRACT:
                    self._report(self.supervision.pose(name == "tip", record))
            self._publish(f"pose/{name}", telemetry.pose_message(record, sample.frame, sample.quality_m))

    def _take_forces(self, samples: Sequence[ForceSample]) -> None:
        record = self._records["sensor"]
        for sample in samples:
            self._force_zero.take(sample.force_N, sample.arrival_ns)
            self._intake.force(record, sample.stamp_ns, sample.arrival_ns, sample.force_N)
            self._leaving.changed.add("sensor")
            if record.count % telemetry.FORCE_EVERY == 0:
                self._publish("force/sensor", telemetry.force_message(record, sample.status))

    def _take_device_event(self, event: DeviceEvent) -> None:
        self._leaving.log(event.stamp_ns, _DEVICE_LEVELS.get(event.kind, "info"), event.device, event.text)
        if event.kind is DeviceEventKind.RECONNECTED:
            self._disarm_after_return(event.device)

    def _disarm_after_return(self, device: str) -> None:
        """Disarm a rig whose `device` was lost and is back."""
        text = self.commands.device_returned(device, self.force_source, self.phase)
        if text:
            self._command_changed()
            self._causes.take_return(self.now_ns, device)
            self._log("warning", device, text)

    def _standing(self) -> RigPosition:
        """Return the state of the rig after the newest tick."""
        y = self._outputs
        if y is None:
            return RigPosition()
        vectors = (np.array(values, float) for values in (y.tip_m, y.goal_m, y.stage_unit, y.force_N))
        tip_m, goal_m, stage_unit, force_N = vectors
        return RigPosition(self.phase, tip_m, goal_m, stage_unit, force_N, int(y.cause), int(y.now_ns))

    def _zero_force(self) -> str:
        """Make the force sensor's present load its zero, and log it. Return the reason if it is refused, empty otherwise."""
        try:
            zero_N = self._force_zero.measure(self.now_ns)
        except InputError as error:
            return str(error)
        before_N, self._intake.zero_N = self._intake.zero_N, zero_N
        x, y, z = zero_N
        self._log(
            "info",
            "force_zero",
            f"force sensor zeroed: {x:.4f}, {y:.4f}, {z:.4f} N (sensor frame) are subtracted from every reading; "
            f"before {before_N[0]:.4f}, {before_N[1]:.4f}, {before_N[2]:.4f} N",
        )
        return ""

    def _silent_sensors(self) -> str:
        """Return the names of the sensors that the loop needs and that sent no data for longer than the failsafe allows."""
        limit_ns = round(self.rig.safety.stop_after_s * 1e9)
        by_sensor = self.params[0].force_source == ForceSource.SENSOR
        force, name = ("sensor", "the force sensor") if by_sensor else ("estimate", "the model process")
        needed = {"tip": "the tracker (tip)", force: name}
        return ", ".join(
            description
            for field_name, description in needed.items()
            if self._records[field_name].count == 0 or self.now_ns - self._records[field_name].arrival_ns > limit_ns
        )

    # --- the model process, cross-checks ---

    def _take_estimate(self, estimate: ForceEstimate) -> None:
        self._report(self.supervision.host_answered(estimate, self.now_ns))
        if self._intake.estimate(self._records["estimate"], estimate, self.now_ns):
            self._leaving.changed.add("estimate")

    def _report(self, finding: SupervisionFinding | None) -> None:
        """Log a finding of the supervision."""
        if finding is not None:
            self._log("warning", "supervision", finding.text)

    def _hand_over_causes(self) -> None:
        """Pass the causes that the supervision has found, and those that have ended, to the tick."""
        if self.supervision.causes != self._watched:
            self._watched = self.supervision.causes
            self.commands.set_watched_causes(self._watched)
            self._leaving.changed.add("command")

    # --- commanders ---

    def _take_request(self, request: CommandRequest) -> None:
        command, reply = self.gate.answer(request.name, request.payload)
        for topic, message in zip(("command", "reply"), without_secrets(command, reply) or (), strict=False):
            self._publish(topic, message)
        line = self.gate.log_line(request.name, command, reply)
        if line:
            self._log("info" if reply is not None and reply.result == "accepted" else "warning", "commander", line)
        self._leaving.replies.append(reply)

    def _execute(self, command: Command, now_ns: int) -> Reply:
        """Carry out a command that the command gate has accepted."""
        if command.action != "stop" and not self._loop_runs:
            text = "found the loop not running yet, wanted it to: it is being compiled"
            return Reply(stamp_ns=now_ns, id=command.id, result="refused", text=text)
        reply = self.commands.execute(command, now_ns)
        if command.action == "mark" and reply.result == "accepted":
            self._log("info", "mark", command.note)
        elif reply.result == "accepted":
            if command.action in ("arm", "disarm", "clear_fault"):
                self._causes.restart()
            if command.action in ("arm", "clear_fault"):
                self.supervision.restart()
                self._hand_over_causes()
            if command.action == "arm":
                self._warn_of_unhomed()
            self._command_changed()
        return reply

    def _warn_of_unhomed(self) -> None:
        """Log the axes with a switch that were not homed. The board does not keep whether they were."""
        axes = [name for axis, name in enumerate(AXES) if self.rig.stage(axis).home_end and name not in self._homed]
        if axes:
            text = (
                f"armed, but {' and '.join(axes)} not homed since the board was connected: its travel limits count from "
                f"where the board was switched on. Disarm, then `seldinger home {axes[0]}`"
            )
            self._log("warning", "home", text)

    def _command_changed(self) -> None:
        self._leaving.changed.add("command")
        self._leaving.frames += self.commands.take_frames()
