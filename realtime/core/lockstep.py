"""The realtime core in virtual time: one period a `step`, fed with bytes by the simulated rig that hands out time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from protocol.rig_file import Rig
from protocol.setpoint_encoder import BUFFER_BYTES, encode_setpoint
from protocol.topics import ForceEstimate, Log, LoopTiming, Message, Reply
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from realtime.core import telemetry
from realtime.core.lines import FromRig, SensorClients, ToRig
from realtime.core.rig_core import Arrived, CommandRequest, Leaving, RigCore, Tick
from realtime.loop.native_loop import HISTOGRAM_WORDS, WORK_BIN_NS, count_in

Publish = Callable[[str, Message], None]


def _nothing(topic: str, message: Message) -> None:
    """Drop the message; the default of `publish`."""


class LockstepLoop:
    """Runs the drivers, the core and the tick in turn. `step` and `request` may be called from different threads.

    Args:
        rig: the rig file.
        force_source: which force closes the loop, `sensor` or `estimate`.
        publish: gets every message with its topic.
    """

    def __init__(self, rig: Rig, force_source: str = "sensor", publish: Publish = _nothing) -> None:
        self.rig, self.publish = rig, publish
        self.period_ns = round(1e9 / rig.control.loop_hz)
        self.state, self.inputs, self.outputs = new(STATE), new(INPUTS), new(OUTPUTS)
        self._state, self._inputs, self._outputs = self.state[0], self.inputs[0], self.outputs[0]
        self.sensors = SensorClients(rig)
        names = [name for name in INPUTS.names or () if name != "now_ns"]
        records = {name: getattr(self._inputs, name) for name in names}
        self._lock = threading.RLock()  # one step of the core at a time; what `publish` calls may make a request in turn
        self._leases = 0
        self.core = RigCore(rig, records, self._timing, force_source, new_lease=self._next_lease)
        self.params = self.core.params
        self.work = np.zeros(HISTOGRAM_WORDS, np.int64)
        self.missed_ticks = 0
        self._ticks: list[Tick] = []
        self._frames: list[bytes] = []  # for the board, from requests between two steps
        self._buffer = np.zeros(BUFFER_BYTES, np.uint8)
        self._estimates: deque[ForceEstimate] = deque()
        tick(self.params, self.state.copy(), self.inputs.copy(), self.outputs.copy())  # compiles; changes nothing

    @property
    def now_ns(self) -> int:
        """Return the computer's clock (ns) at the newest period."""
        return self.core.now_ns

    def step(self, now_ns: int, arriving: FromRig) -> ToRig:
        """Run one period: process the received data, run the tick, return the data to send."""
        with self._lock:
            return self._step(now_ns, arriving)

    def request(self, name: str, payload: bytes) -> Reply | None:
        """Answer a request of commander `name`, at the time of the newest period."""
        with self._lock:
            return self._step_core(self.now_ns, Arrived(requests=[CommandRequest(name, payload)])).replies[0]

    def estimate_at(self, estimate: ForceEstimate) -> None:
        """Queue a force estimate that arrives at its `published_ns`."""
        self._estimates.append(estimate)

    def log(self, now_ns: int, level: str, source: str, text: str) -> None:
        """Publish a log line of another part of the simulated rig."""
        self.publish("log", Log(stamp_ns=now_ns, level=level, source=source, text=text[:500]))

    def _step(self, now_ns: int, arriving: FromRig) -> ToRig:
        if self.core.now_ns:
            self.missed_ticks += max(round((now_ns - self.core.now_ns) / self.period_ns) - 1, 0)
        readings = self.sensors.feed(arriving, now_ns)
        arrived = Arrived(board=arriving.board, poses=readings.poses, forces=readings.forces, device_events=readings.events)
        arrived.estimates = self._due_estimates(now_ns)
        self._step_core(now_ns, arrived)
        self._inputs.now_ns = now_ns
        started = time.perf_counter_ns()
        tick(self.params, self.state, self.inputs, self.outputs)
        setpoint = self._setpoint()
        count_in(self.work, WORK_BIN_NS, time.perf_counter_ns() - started)
        self._ticks.append(Tick(int(self._state.ticks), self._outputs))
        commands, self._frames = b"".join(self._frames), []
        return self.sensors.outgoing(setpoint + commands, now_ns)

    def _step_core(self, now_ns: int, arrived: Arrived) -> Leaving:
        arrived.ticks, self._ticks = self._ticks, []
        leaving = self.core.step(now_ns, arrived)
        self._frames += leaving.frames
        for topic, message in leaving.messages:
            self.publish(topic, message)
        return leaving

    def _due_estimates(self, now_ns: int) -> list[ForceEstimate]:
        due = []
        while self._estimates and self._estimates[0].published_ns <= now_ns:
            due.append(self._estimates.popleft())
            self.publish("force/estimate", due[-1])
        return due

    def _setpoint(self) -> bytes:
        y = self._outputs
        if not y.valid:
            return b""
        n = encode_setpoint(self._buffer, y.number & 0xFF, y.number, y.execute_us, y.expiry_us, y.position_steps)
        return self._buffer[:n].tobytes()

    def _timing(self, stamp_ns: int) -> LoopTiming:
        return telemetry.loop_message(stamp_ns, self.rig.control.loop_hz, self.missed_ticks, self.work)

    def _next_lease(self) -> str:
        self._leases += 1
        return f"lease-{self._leases}"
