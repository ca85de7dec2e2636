"""The realtime process under virtual time: the same drivers, tick and desk, fed with bytes by whoever hands out time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from protocol.enums import Phase
from protocol.rig_file import Rig
from protocol.setpoint_encoder import BUFFER_BYTES, encode_setpoint
from protocol.topics import Command, ForceEstimate, Log, Message, Reply
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from realtime.core import telemetry
from realtime.core.board_intake import axis_limits, board_message, take_status
from realtime.core.command_gate import CommandGate, for_the_record
from realtime.core.intake import Intake
from realtime.core.operator_desk import OperatorDesk
from realtime.core.supervision import Supervision
from realtime.drivers.aurora import AuroraClient, AuroraConfig
from realtime.drivers.aurora_session import LineAction
from realtime.drivers.device_events import DeviceEvent
from realtime.drivers.device_events import EventKind as DeviceEventKind
from realtime.drivers.net_ft import NetFtClient, NetFtConfig
from realtime.drivers.net_ft_calibration import NetFtCalibration
from realtime.drivers.stepper_board import EventKind, StepperBoardLink
from realtime.loop.native_loop import BINS, WORK_BIN_NS, count_in

Publish = Callable[[str, Message], None]
GAP_TOLD_NS = 10_000_000
_LEVELS = {DeviceEventKind.LOST: "warning", DeviceEventKind.WARNING: "warning", DeviceEventKind.ERROR: "error"}


@dataclass
class Arriving:
    """What has reached the computer by now: bytes of the board and the tracker, datagrams of the force sensor."""

    board: bytes = b""
    tracker: bytes = b""
    force: list[bytes] = field(default_factory=list)


@dataclass
class Leaving:
    """What the computer sends: the same lines, and what to do with the tracker's line before its bytes go."""

    board: bytes = b""
    tracker: bytes = b""
    tracker_line: list[LineAction] = field(default_factory=list)
    force: list[bytes] = field(default_factory=list)


def _nothing(topic: str, message: Message) -> None:
    """The default of `publish`."""


class LockstepLoop:
    """One period a `step`. Estimates handed to `estimate_at` are used from their arrival time on, not before."""

    def __init__(self, rig: Rig, force_source: str = "sensor", publish: Publish = _nothing) -> None:
        self.rig, self.publish = rig, publish
        self.period_ns = round(1e9 / rig.control.loop_hz)
        self.params = tick_parameters(rig, force_source)
        self.state, self.inputs, self.outputs = new(STATE), new(INPUTS), new(OUTPUTS)
        self.link = StepperBoardLink(axis_limits(rig))
        self.tracker = AuroraClient(
            AuroraConfig(
                tools=(rig.tracker.tip_handle, rig.tracker.shaft_handle),
                rate_hz=rig.tracker.rate_hz,
                latency_s=rig.tracker.latency_s,
            )
        )
        self.force_sensor = NetFtClient(
            NetFtConfig(
                NetFtCalibration(
                    counts_per_N=rig.force_sensor.counts_per_newton,
                    counts_per_Nm=rig.force_sensor.counts_per_newton_metre,
                    rdt_rate_hz=rig.force_sensor.rate_hz,
                )
            )
        )
        self.intake = Intake(rig)
        self.desk = OperatorDesk(rig, self.inputs[0].command, self.link)
        self._leases = 0
        self.gate = CommandGate(
            lambda: self._last_ns, self._obey, new_lease=self._next_lease, roles=rig.access.roles if rig.access else {}
        )
        self.work = np.zeros(BINS + 2, np.int64)
        self.faults: list[str] = []
        self.supervision = Supervision(tuple(rig.stage(axis).encoder_counts_per_step for axis in range(3)))  # type: ignore[arg-type]
        self.missed_ticks = 0
        self._last_ns = 0
        self._buffer = np.zeros(BUFFER_BYTES, np.uint8)
        self._estimates: deque[ForceEstimate] = deque()
        tick(self.params, self.state.copy(), self.inputs.copy(), self.outputs.copy())  # compiles; changes nothing

    def request(self, name: str, payload: bytes) -> Reply | None:
        """What comes from commander `name`; a command and its reply are published."""
        command, reply = self.gate.answer(name, payload)
        for topic, message in zip(("command", "reply"), for_the_record(command, reply) or (), strict=False):
            self.publish(topic, message)
        words = self.gate.in_words(name, command, reply)
        if words and (reply is None or reply.result != "accepted"):
            self.log(self._last_ns, "warning", "commander", words)
        return reply

    def _obey(self, command: Command, now_ns: int) -> Reply:
        if command.action in ("arm", "clear_fault"):
            self._supervised("", now_ns, restart=True)
        return self.desk.obey(command, now_ns)

    def _next_lease(self) -> str:
        self._leases += 1
        return f"lease-{self._leases}"

    @property
    def now_ns(self) -> int:
        """The computer's clock at the newest period."""
        return self._last_ns

    def estimate_at(self, estimate: ForceEstimate) -> None:
        """A force estimate that arrives at its `published_ns`."""
        self._estimates.append(estimate)

    def step(self, now_ns: int, arriving: Arriving) -> Leaving:
        """One period: what arrived goes in, the tick runs, what is to be sent comes out."""
        self._watch_time(now_ns)
        self._take_board(arriving.board, now_ns)
        self._take_poses(arriving.tracker, now_ns)
        self._take_forces(arriving.force, now_ns)
        self._take_estimates(now_ns)
        self.inputs[0].now_ns = now_ns
        started = time.perf_counter_ns()
        tick(self.params, self.state, self.inputs, self.outputs)
        frame = self._setpoint()
        count_in(self.work, WORK_BIN_NS, time.perf_counter_ns() - started)
        self._tell(now_ns)
        commands = b"".join([self.link.advance(now_ns), *self.desk.take_frames()])
        request = self.force_sensor.outgoing(now_ns)
        return Leaving(
            frame + commands, self.tracker.outgoing(now_ns), self.tracker.line_actions(), [request] if request else []
        )

    def _watch_time(self, now_ns: int) -> None:
        """Ticks that were due and did not come are counted; a gap longer than a few of them is told."""
        gap_ns = now_ns - self._last_ns if self._last_ns else self.period_ns
        self._last_ns = now_ns
        missed = round(gap_ns / self.period_ns) - 1
        if missed > 0:
            self.missed_ticks += missed
        if not 0 < gap_ns <= GAP_TOLD_NS:
            self.log(
                now_ns,
                "warning",
                "realtime",
                f"the computer stood still, or its clock jumped: {gap_ns * 1e-6:.1f} ms "
                f"between two ticks, wanted {self.period_ns * 1e-6:g} ms",
            )

    def _setpoint(self) -> bytes:
        y = self.outputs[0]
        if not y.valid:
            return b""
        n = encode_setpoint(self._buffer, y.number & 0xFF, y.number, y.execute_us, y.expiry_us, y.position_steps)
        return self._buffer[:n].tobytes()

    def _take_board(self, data: bytes, now_ns: int) -> None:
        for event in self.link.feed(data, now_ns):
            if event.kind is EventKind.STATUS:
                take_status(self.inputs[0].board, self.link, now_ns)
                self._check_steps(now_ns)
            else:
                level = "error" if event.kind in (EventKind.FAULT, EventKind.RESET, EventKind.MISMATCH) else "info"
                if level == "error":
                    self.faults.append(event.message)
                self.log(now_ns, level, "board", event.message)

    def _check_steps(self, now_ns: int) -> None:
        board = self.inputs[0].board
        if self.outputs[0].phase != Phase.DISARMED and board.ready:
            self._supervised(self.supervision.status(board.position_steps, board.encoder_counts, now_ns), now_ns)

    def _supervised(self, words: str, now_ns: int, restart: bool = False) -> None:
        """Tell the tick and the people what the supervision has found."""
        if restart:
            self.supervision.restart()
        self.desk.watch(self.supervision.flags)
        if words:
            self.log(now_ns, "warning", "supervision", words)

    def _take_poses(self, data: bytes, now_ns: int) -> None:
        tracker = self.rig.tracker
        handles = {tracker.tip_handle: ("tip", "pose/tip"), tracker.shaft_handle: ("shaft", "pose/shaft")}
        for sample in self.tracker.feed(data, now_ns):
            if sample.missing or sample.tool not in handles:
                continue
            name, topic = handles[sample.tool]
            record = self.inputs[0][name]
            self.intake.pose(record, sample.stamp_ns, sample.arrival_ns, sample.position_m, sample.quaternion_wxyz)
            self.publish(topic, telemetry.pose_message(record, sample.frame, sample.quality_m))
        for event in self.tracker.take_events():
            self._log_device(event)

    def _take_forces(self, datagrams: list[bytes], now_ns: int) -> None:
        record = self.inputs[0].sensor
        for datagram in datagrams:
            sample = self.force_sensor.feed(datagram, now_ns)
            if sample is not None:
                self.intake.force(record, sample.stamp_ns, sample.arrival_ns, sample.force_N)
        for event in self.force_sensor.take_events():
            self._log_device(event)

    def _take_estimates(self, now_ns: int) -> None:
        while self._estimates and self._estimates[0].published_ns <= now_ns:
            estimate = self._estimates.popleft()
            self.publish("force/estimate", estimate)
            self._supervised(self.supervision.host.heard(estimate.stamp_ns, now_ns), now_ns)
            if estimate.converged and estimate.force_N is not None and estimate.covariance_N2 is not None:
                self.intake.estimate(
                    self.inputs[0].estimate,
                    estimate.stamp_ns,
                    now_ns,
                    np.array(estimate.force_N),
                    np.array(estimate.covariance_N2).reshape(3, 3),
                )
                if self.outputs[0].phase == Phase.CONTACT:
                    sensor_N, estimate_N = self.inputs[0].sensor.force_N, self.inputs[0].estimate.force_N
                    self._supervised(self.supervision.estimate(sensor_N, estimate_N, now_ns), now_ns)
        words = self.supervision.host.silent(now_ns)
        if words:
            self._supervised(words, now_ns)

    def _tell(self, now_ns: int) -> None:
        """Publish what is due at this tick."""
        u, y, number = self.inputs[0], self.outputs[0], int(self.state[0].ticks)
        if number % telemetry.STAGE_EVERY == 0:
            self.publish("stage", telemetry.stage_message(self.params[0], u, y))
        if number % telemetry.FORCE_EVERY == 0 and u.sensor.count:
            self.publish("force/sensor", telemetry.force_message(u.sensor))
        if number % telemetry.STATE_EVERY == 0:
            self.publish("state", telemetry.state_message(u, y))
        if number % telemetry.BOARD_EVERY == 0 and self.link.status is not None:
            self.publish("board", board_message(self.link, now_ns))
        if number % telemetry.LOOP_EVERY == 0:
            self.publish("loop", telemetry.loop_message(now_ns, self.rig.control.loop_hz, self.missed_ticks, self.work))
            self.publish("commander", self.gate.state())

    def _log_device(self, event: DeviceEvent) -> None:
        level = _LEVELS.get(event.kind, "info")
        self.log(event.stamp_ns, level, event.device, event.text)
        y, words = self.outputs[0], ""
        if event.kind is DeviceEventKind.RECONNECTED:
            words = self.desk.back(event.device, int(y.force_source), int(y.phase))
        if words:
            self.log(event.stamp_ns, "warning", event.device, words)

    def log(self, now_ns: int, level: str, source: str, text: str) -> None:
        """A line for people, published as it is."""
        self.publish("log", Log(stamp_ns=now_ns, level=level, source=source, text=text[:500]))
