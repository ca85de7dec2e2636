"""The realtime core on the wall clock: device threads and ports, the compiled loop that ticks, and zenoh."""

from __future__ import annotations

import logging
import time
from typing import Any

from protocol.reply_seal import ReplySeal
from protocol.rig_file import Rig
from protocol.topics import TOPICS, CommandCounts, Log, LoopTiming, Reply
from protocol.zenoh_session import Session
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from realtime.core import control_loop, telemetry
from realtime.core.device_sources import force_thread, tracker_thread
from realtime.core.rig_core import Arrived, CommandRequest, RigCore
from realtime.core.shared_core import SharedCore
from realtime.core.stop_listener import StopListener
from realtime.core.stop_path import StopPath
from realtime.drivers.board_port import BoardPort
from realtime.drivers.board_thread import BoardThread
from realtime.drivers.device_events import DeviceEvent
from realtime.loop.clock import Clock
from realtime.loop.loop_thread import NativeLoop, input_mailboxes
from realtime.loop.scheduling import RealtimeSettings

logger = logging.getLogger("seldinger.realtime")
PUBLISHED = tuple(topic.name for topic in TOPICS.values() if topic.direction.startswith(("realtime ->", "all ->")))


class RealtimeProcess:
    """The realtime process from `start` to `stop`. Ports are those of the rig file, or given here.

    Each thread hands what arrived to the core, one thread at a time; the compiled loop reads the core's records from
    mailboxes and is the only one that writes to the board.

    Raises OSError where the board's port does not open within `open_timeout_s`, zenoh cannot connect as asked, or another
    realtime process of this rig runs.
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
        # A kind that no package offers is refused before anything is opened.
        tracker = tracker_thread(
            rig, tracker_port, lambda sample: self.shared.step(Arrived(poses=[sample])), self._take_event
        )
        force = force_thread(rig, force_port, lambda sample: self.shared.step(Arrived(forces=[sample])), self._take_event)
        mailboxes = input_mailboxes(INPUTS, numbered=False)
        records = {name: box.record[0] for name, box in mailboxes.items()}
        self.core = RigCore(rig, records, self._timing, force_source)
        paths = rig.local.prepare()
        self._port = BoardPort(board_port or rig.board.port, rig.board.baud, open_timeout_s, logger.warning)
        self._session = Session.of_rig(rig)
        self._seal = ReplySeal(paths.reply_key)
        publishers = {name: self._session.publisher(name) for name in PUBLISHED}
        self._estimates = self._session.latest("force/estimate")
        self.loop = NativeLoop(
            tick,
            self.core.params,
            new(STATE),
            INPUTS,
            OUTPUTS,
            mailboxes,
            clock=self.clock,
            period_ns=round(1e9 / rig.control.loop_hz),
            fd=self._port.fileno(),
            realtime=RealtimeSettings(),
            run=control_loop.run,
        )
        self.shared = SharedCore(
            self.core, self.loop, mailboxes, self.clock.now_ns, lambda topic, message: publishers[topic].put(message)
        )
        self._tracker, self._force = tracker, force
        self._board = BoardThread(
            self._port,
            self._read_board,
            lambda why: self.shared.step(Arrived(board_lost=why)),
            lambda: self.log("warning", "the board's port is there again"),
        )
        self.stop_path = StopPath(self.core, self.loop, self.shared.take, self.clock.now_ns)
        self._stops = StopListener(paths.stop_socket, self.stop_path.stop, self.stop_path.status)

    def start(self) -> None:
        """Answer commands, compile, start the loop and all threads."""
        # Without a cache, compiling takes more than a minute on a busy machine. Until then commands are refused and say so.
        self._stops.start()
        self._requests = self._session.serve_requests(self.request, self._seal.prove)
        self.log("info", "starting: the loop is being compiled")
        self.loop.prepare()
        self.core.prepare()
        self.loop.start()
        if self.loop.granted.warning:
            self.log("warning", self.loop.granted.warning)
        for thread in (self._board, self._tracker, self._force):
            thread.start()
        self.log("info", f"loop at {self.rig.control.loop_hz} Hz, disarmed")

    def stop(self) -> None:
        """Disarm, let the stages come to rest, end the loop and the threads, close the ports."""
        self._stops.close()
        # A core that does not come back must not keep the loop from being ended: without set-points the board stops.
        self.shared.shut_down(wait_s=1.0)
        time.sleep(0.1)
        self._board.stop()
        self._tracker.stop()
        self._force.stop()
        self.loop.stop()
        self.loop.join(1.0)
        self._session.close()
        self._port.close()

    @property
    def alive(self) -> bool:
        """Return whether the loop runs and no thread has failed."""
        return self.loop.alive and self._board.failure is None

    @property
    def error(self) -> BaseException | None:
        """Return the exception that ended the loop or the board's thread, None if none did."""
        return self.loop.error or self._board.failure

    def request(self, name: str, payload: bytes) -> Reply | None:
        """Answer a request of commander `name`; called on a thread of zenoh."""
        return self.shared.step(Arrived(requests=[CommandRequest(name, payload)])).replies[0]

    def counts(self) -> CommandCounts:
        """Return the holder of the lease, and the counts of commands by result."""
        return self.core.gate.state()

    def log(self, level: str, text: str) -> None:
        """Publish a log line of the process itself."""
        self.shared.step(Arrived(log_lines=[Log(stamp_ns=self.clock.now_ns(), level=level, source="realtime", text=text)]))

    def _take_event(self, event: DeviceEvent) -> None:
        self.shared.step(Arrived(device_events=[event]))

    def _read_board(self, data: bytes) -> None:
        estimate: Any = self._estimates.take()
        self.shared.step(Arrived(board=data, estimates=[] if estimate is None else [estimate]))

    def _timing(self, stamp_ns: int) -> LoopTiming:
        return telemetry.wall_clock_timing(stamp_ns, self.rig.control.loop_hz, self.loop)
