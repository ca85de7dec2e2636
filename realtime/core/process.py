"""The realtime process on the wall clock: device threads fill mailboxes, the compiled loop ticks, zenoh hears of it."""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from protocol.enums import ForceSource, Phase
from protocol.rig_file import Rig
from protocol.topics import Command, CommandCounts, Log, LoopTiming, Message, Reply
from protocol.zenoh_session import Session
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from realtime.core import telemetry
from realtime.core.board_intake import axis_limits, board_message, take_status
from realtime.core.command_gate import CommandGate, for_the_record
from realtime.core.intake import Intake
from realtime.core.operator_desk import OperatorDesk
from realtime.core.supervision import Supervision
from realtime.drivers.aurora import AuroraConfig, PoseSample
from realtime.drivers.device_events import DeviceEvent
from realtime.drivers.device_events import EventKind as DeviceEventKind
from realtime.drivers.net_ft import ForceSample, NetFtConfig
from realtime.drivers.net_ft_calibration import NetFtCalibration
from realtime.drivers.sensor_threads import AuroraThread, NetFtThread
from realtime.drivers.stepper_board import EventKind, StepperBoardLink
from realtime.drivers.transport import open_serial
from realtime.loop.clock import Clock
from realtime.loop.latency import percentiles_us
from realtime.loop.loop_thread import NativeLoop, input_mailboxes
from realtime.loop.native_loop import GAP_PLACES, WORK_BIN_NS
from realtime.loop.scheduling import RealtimeSettings

_POLL_S = 0.005
_OPEN_RETRY_S = 0.2
logger = logging.getLogger("seldinger.realtime")


class RealtimeProcess:
    """Everything of the process, from `start` to `stop`. Ports as in the rig file, or given here.

    Raises OSError where the board's port does not open within `open_timeout_s`, or zenoh cannot connect as asked.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        board_port: str | None = None,
        tracker_port: str | None = None,
        force_port: int = 49152,
        force_source: str = "sensor",
        open_timeout_s: float = 10.0,
    ) -> None:
        self.rig, self.clock = rig, Clock.monotonic()
        self._stopping = threading.Event()
        self._mailboxes = input_mailboxes(INPUTS)
        self._intake = Intake(rig)
        self._link = StepperBoardLink(axis_limits(rig))
        self._link_lock = threading.Lock()
        self._desk = OperatorDesk(rig, self._mailboxes["command"].record[0], self._link, self._missing)
        self._gate = CommandGate(self.clock.now_ns, self._obey, roles=rig.access.roles if rig.access else {})
        self._supervision = Supervision(tuple(rig.stage(axis).encoder_counts_per_step for axis in range(3)))  # type: ignore[arg-type]
        self._phase, self._force_source = int(Phase.DISARMED), int(ForceSource.SENSOR)
        self._params = tick_parameters(rig, force_source)
        self._told_board_ns = 0
        self._port = _opened(board_port or rig.board.port, rig.board.baud, open_timeout_s)
        os.set_blocking(self._port.fileno(), False)
        self._session = Session(rig.name, [], rig.zenoh.connect)
        self._publishers = {
            name: self._session.publisher(name)
            for name in (
                "stage",
                "pose/tip",
                "pose/shaft",
                "force/sensor",
                "state",
                "board",
                "loop",
                "log",
                "command",
                "reply",
                "commander",
            )
        }
        self._publish_lock = threading.Lock()
        self._estimates = self._session.latest("force/estimate")
        self.loop = NativeLoop(
            tick,
            self._params,
            new(STATE),
            INPUTS,
            OUTPUTS,
            self._mailboxes,
            clock=self.clock,
            period_ns=round(1e9 / rig.control.loop_hz),
            fd=self._port.fileno(),
            realtime=RealtimeSettings(),
        )
        tracker, sensor = rig.tracker, rig.force_sensor
        self._tracker = AuroraThread(
            lambda: open_serial(tracker_port or tracker.port, 9600),
            self._on_pose,
            AuroraConfig(
                tools=(tracker.tip_handle, tracker.shaft_handle), rate_hz=tracker.rate_hz, latency_s=tracker.latency_s
            ),
            self._on_device,
        )
        calibration = NetFtCalibration(
            counts_per_N=sensor.counts_per_newton, counts_per_Nm=sensor.counts_per_newton_metre, rdt_rate_hz=sensor.rate_hz
        )
        self._force = NetFtThread(sensor.address, self._on_force, NetFtConfig(calibration), self._on_device, force_port)
        self._threads = [
            threading.Thread(target=self._guard, args=(work,), name=work.__name__, daemon=True)
            for work in (self._serve_board, self._serve_telemetry)
        ]
        self.failure: BaseException | None = None

    def start(self) -> None:
        """Answer commands, compile, start the loop and all threads."""
        # Compiling takes a minute and more where no cache is and others use the machine: who asks meanwhile is told so.
        self._requests = self._session.serve_requests(self._request)
        self._log("info", "realtime", "starting: the loop is being compiled")
        self.loop.prepare()
        self.loop.start()
        if self.loop.granted.warning:
            self._log("warning", "realtime", self.loop.granted.warning)
        for thread in self._threads:
            thread.start()
        self._tracker.start()
        self._force.start()
        self._log("info", "realtime", f"loop at {self.rig.control.loop_hz} Hz, disarmed")

    def stop(self) -> None:
        """Disarm, let the stages come to rest, end the loop and the threads, close the ports."""
        with self._link_lock:
            self._mailboxes["command"].record[0].armed = 0
            self._mailboxes["command"].publish()
            if self._link.status is not None:
                self.loop.send(self._link.disarm())
        time.sleep(0.1)
        self._stopping.set()
        for thread in self._threads:
            thread.join(1.0)
        self._tracker.stop()
        self._force.stop()
        self.loop.stop()
        self.loop.join(1.0)
        self._session.close()
        self._port.close()

    @property
    def alive(self) -> bool:
        """Whether the loop runs and no thread has failed."""
        return self.loop.alive and self.failure is None

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as failure:  # the thread's last words; `alive` turns false and the process ends
            self.failure = failure
            logger.exception("%s failed", work.__name__)

    # Devices.

    def _missing(self) -> str:
        """Sensors that have been silent for longer than the failsafe allows."""
        now_ns, limit_ns = self.clock.now_ns(), self.rig.safety.stop_after_s * 1e9
        ages = {
            "the tracker (tip)": now_ns - self._mailboxes["tip"].record[0].arrival_ns,
            "the force sensor": now_ns - self._mailboxes["sensor"].record[0].arrival_ns,
        }
        return ", ".join(name for name, age_ns in ages.items() if age_ns > limit_ns)

    def _on_pose(self, sample: PoseSample) -> None:
        tracker = self.rig.tracker
        name = {tracker.tip_handle: "tip", tracker.shaft_handle: "shaft"}.get(sample.tool)
        if sample.missing or name is None:
            return
        box = self._mailboxes[name]
        self._intake.pose(box.record[0], sample.stamp_ns, sample.arrival_ns, sample.position_m, sample.quaternion_wxyz)
        box.publish()
        self._publish(f"pose/{name}", telemetry.pose_message(box.record[0], sample.frame, sample.quality_m))

    def _on_force(self, sample: ForceSample) -> None:
        box = self._mailboxes["sensor"]
        self._intake.force(box.record[0], sample.stamp_ns, sample.arrival_ns, sample.force_N)
        if box.publish() % telemetry.FORCE_EVERY == 0:
            self._publish("force/sensor", telemetry.force_message(box.record[0], sample.status))

    def _on_device(self, event: DeviceEvent) -> None:
        bad = event.kind in (DeviceEventKind.LOST, DeviceEventKind.WARNING, DeviceEventKind.ERROR)
        self._log("warning" if bad else "info", event.device, event.text)
        if event.kind is DeviceEventKind.RECONNECTED:
            with self._link_lock:
                self._back(event.device)

    def _back(self, device: str) -> None:
        """A device is there again; the link's lock is held."""
        words = self._desk.back(device, self._force_source, self._phase)
        if words:
            self._mailboxes["command"].publish()
            self._send(self._desk.take_frames())
            self._log("warning", device, words)

    def _serve_board(self) -> None:
        """Read the board; keep the link's bring-up going; all that is sent goes through the loop's one writer."""
        while not self._stopping.is_set():
            try:
                self._board_turn()
            except OSError as gone:
                self._find_board_again(str(gone))

    def _board_turn(self) -> None:
        ready = select.select([self._port.fileno()], [], [], _POLL_S)[0]
        data = self._port.read() if ready else b""
        if ready and not data:
            raise OSError("serial port hung up (unplugged?)")
        now_ns = self.clock.now_ns()
        with self._link_lock:
            for event in self._link.feed(data, now_ns):
                if event.kind is EventKind.STATUS:
                    take_status(self._mailboxes["board"].record[0], self._link, now_ns)
                    self._mailboxes["board"].publish()
                    self._check_steps(now_ns)
                else:
                    bad = event.kind in (EventKind.FAULT, EventKind.RESET, EventKind.MISMATCH)
                    self._log("error" if bad else "info", "board", event.message)
            self._send([self._link.advance(now_ns)])
            if self._link.status is not None and now_ns - self._told_board_ns > 50_000_000:
                self._told_board_ns = now_ns
                self._publish("board", board_message(self._link, now_ns))
        self._take_estimate(now_ns)
        self._tell_host(self._supervision.host.silent(now_ns))

    def _find_board_again(self, why: str) -> None:
        """Disarm, and wait for the port; the loop goes on at the same descriptor, which leads nowhere meanwhile."""
        fd = self._port.fileno()
        with open(os.devnull, "r+b", buffering=0) as nowhere:
            os.dup2(nowhere.fileno(), fd)
        with self._link_lock:
            self._log("error", "board", why)
            self._back("board")
            self._link.unplugged()
        while not self._stopping.wait(_OPEN_RETRY_S):
            try:
                found = open_serial(self._port.path, self.rig.board.baud)
            except OSError:
                continue
            os.set_blocking(found.fileno(), False)
            os.dup2(found.fileno(), fd)
            found.close()
            self._log("warning", "board", "its port is there again")
            return

    def _check_steps(self, now_ns: int) -> None:
        board = self._mailboxes["board"].record[0]
        if self._phase != Phase.DISARMED and board.ready:
            self._supervised(self._supervision.status(board.position_steps, board.encoder_counts, now_ns))

    def _supervised(self, words: str) -> None:
        """Hand what the supervision has found to the tick, and tell it; the link's lock is held."""
        self._desk.watch(self._supervision.flags)
        if words:
            self._mailboxes["command"].publish()
            self._log("warning", "supervision", words)

    def _tell_host(self, words: str) -> None:
        if words:
            self._log("warning", "supervision", words)

    def _send(self, frames: list[bytes]) -> None:
        for frame in b"".join(frames).split(b"\0"):
            if frame:
                self.loop.send(frame + b"\0")

    def _take_estimate(self, now_ns: int) -> None:
        estimate: Any = self._estimates.take()
        if estimate is None:
            return
        self._tell_host(self._supervision.host.heard(estimate.stamp_ns, now_ns))
        if not estimate.converged:
            return
        box = self._mailboxes["estimate"]
        self._intake.estimate(
            box.record[0],
            estimate.stamp_ns,
            now_ns,
            np.array(estimate.force_N),
            np.array(estimate.covariance_N2).reshape(3, 3),
        )
        box.publish()
        if self._phase == Phase.CONTACT:
            sensor_N = self._mailboxes["sensor"].record[0].force_N
            with self._link_lock:
                self._supervised(self._supervision.estimate(sensor_N, box.record[0].force_N, now_ns))

    def _request(self, name: str, payload: bytes) -> Reply | None:
        """What a commander asks; on a thread of zenoh's. The command and its reply are published and logged."""
        command, reply = self._gate.answer(name, payload)
        for topic, message in zip(("command", "reply"), for_the_record(command, reply) or (), strict=False):
            self._publish(topic, message)
        words = self._gate.in_words(name, command, reply)
        if words:
            self._log("info" if reply is not None and reply.result == "accepted" else "warning", "commander", words)
        return reply

    def _obey(self, command: Command, now_ns: int) -> Reply:
        if command.action != "stop" and not self.loop.alive:
            return Reply(
                stamp_ns=now_ns,
                id=command.id,
                result="refused",
                text=f"{command.action}: found the loop not running yet, wanted it to: it is being compiled",
            )
        with self._link_lock:
            if command.action in ("arm", "clear_fault"):
                self._supervision.restart()
                self._desk.watch(0)
            reply = self._desk.obey(command, now_ns)
            self._mailboxes["command"].publish()
            self._send(self._desk.take_frames())
        return reply

    # Telling.

    def _publish(self, topic: str, message: Message) -> None:
        with self._publish_lock:
            self._publishers[topic].put(message)

    def _log(self, level: str, source: str, text: str) -> None:
        logger.log(getattr(logging, level.upper()), "%s: %s", source, text)
        self._publish("log", Log(stamp_ns=self.clock.now_ns(), level=level, source=source, text=text[:500]))

    def _serve_telemetry(self) -> None:
        due_ns, inputs, last_cause = 0, new(INPUTS), ""
        while not self._stopping.wait(0.02):
            records = self.loop.telemetry.drain()
            for box in ("board", "command", "sensor"):
                self._mailboxes[box].read(inputs[box])
            for record in records:
                outputs, number = record["outputs"], int(record["loop"]["tick"])
                view = outputs.reshape(1).view(np.recarray)[0]
                self._phase, self._force_source = int(view.phase), int(view.force_source)
                if number % telemetry.STAGE_EVERY == 0:
                    self._publish("stage", telemetry.stage_message(self._params[0], inputs[0], view))
                if number % telemetry.STATE_EVERY == 0:
                    state = telemetry.state_message(inputs[0], view)
                    self._publish("state", state)
                    if state.cause != last_cause and state.safety_action not in ("none", "warn"):
                        self._log("warning", "safety", f"{state.safety_action}: {state.cause}")
                    last_cause = state.cause
            if self.clock.now_ns() > due_ns:
                due_ns = self.clock.now_ns() + 500_000_000
                self._publish("loop", self.timing())
                self._publish("commander", self.counts())

    def counts(self) -> CommandCounts:
        """Who holds the lease, and what became of the commands so far."""
        return self._gate.state()

    def timing(self) -> LoopTiming:
        """Tick time, lateness, missed ticks and the longest gap since the start."""
        loop, gap = self.loop.snapshot(), self.loop
        work = percentiles_us(gap.work, WORK_BIN_NS)
        late = percentiles_us(gap.lateness, 1000)
        return LoopTiming(
            stamp_ns=self.clock.now_ns(),
            loop_hz=float(self.rig.control.loop_hz),
            ticks=loop["tick"],
            missed_ticks=loop["missed"],
            tick_p50_us=work["p50"],
            tick_p99_us=work["p99"],
            tick_p999_us=work["p999"],
            tick_max_us=work["max"],
            lateness_p50_us=late["p50"],
            lateness_p99_us=late["p99"],
            lateness_p999_us=late["p999"],
            lateness_max_us=late["max"],
            longest_gap_ns=loop["longest_gap_ns"],
            longest_gap_where=GAP_PLACES[loop["longest_gap_place"]],
            tick_histogram=telemetry.tick_buckets(gap.work),
        )


def _opened(path: str, baud: int, timeout_s: float) -> Any:
    """The board's port, waited for. Raises OSError."""
    give_up = time.monotonic() + timeout_s
    while True:
        try:
            return open_serial(path, baud)
        except OSError:
            if time.monotonic() > give_up:
                raise
            time.sleep(_OPEN_RETRY_S)
