"""NDI Aurora client without I/O: bytes in, timed poses out; brings the device up and polls it."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from realtime.drivers import ndi_protocol as ndi
from realtime.drivers.aurora_session import AuroraConfig, LineAction, SessionFailed, SessionStep, enumerate_and_start, set_up
from realtime.drivers.device_events import DeviceEvent, DeviceEventKind
from realtime.drivers.frame_clock import FrameClock
from realtime.drivers.pose_sample import NO_FLAGS, PoseFlag, PoseSample, describe_flags, flags_of

LOST_AFTER_TIMEOUTS = 5
# Part of a frame's period in which, after a new frame, polls can bring nothing. Well below 1: polling must come before
# the next frame is ready, or the least delay would never be seen.
POLL_REST = 0.4
# Longest reply to wait for: 63 bytes a tool in TX, and the system status.
_REPLY_BYTES_PER_TOOL, _REPLY_BYTES = 72, 40
__all__ = ["AuroraClient", "AuroraConfig", "AuroraCounters", "PoseFlag", "PoseSample"]

FRAME_MODULUS = 1 << 32
# A frame counter that goes back, or ahead of time by more than these frames, is accepted after this many in a row.
_JUMP_FRAMES, _STRANGE_IN_ROW = 10, 3
_UNIT_TOLERANCE = 0.02  # of |q|; TX rounds to 1e-4, damage that passes two CRCs does not stop here by chance


@dataclass
class AuroraCounters:
    """Counts since the client was made."""

    polls: int = 0
    poll_timeouts: int = 0
    replies: int = 0
    damaged: int = 0
    unexpected: int = 0
    repeats: int = 0
    frames_missed: int = 0
    frames_strange: int = 0
    poses: int = 0
    missing: int = 0
    not_a_pose: int = 0
    frozen: int = 0
    warnings: int = 0
    errors: int = 0
    sessions: int = 0


class _Flight(NamedTuple):
    sent_ns: int
    deadline_ns: int


class AuroraClient:
    """The driver's core. Call in turn: `line_actions` (carry them out), `outgoing` (send), `feed` (received bytes).

    It starts by itself, retries without end, and never raises on what the device sends. `take_events`, `phase`
    and `counters` report what happens. All times are the caller's clock in ns.
    """

    def __init__(self, config: AuroraConfig | None = None) -> None:
        self.config = config or AuroraConfig()
        self.phase = "starting"
        self.firmware = ""
        self.tools: dict[str, ndi.ToolInfo] = {}
        self.written: dict[str, int] = {}
        self.clock = FrameClock(1.0 / self.config.rate_hz)
        self._reader = ndi.ReplyReader()
        self._counters = AuroraCounters()
        self._events: list[DeviceEvent] = []
        self._actions: list[LineAction] = []
        self._out = b""
        self._session: Generator[SessionStep, str | None, dict[str, ndi.ToolInfo]] | None = None
        self._deadline_ns: int | None = None
        self._pausing = False
        self._baud = 9600
        self._was_tracking = False
        self._last_error = ""
        self._now_ns = 0
        self._begin_tracking()

    @property
    def tracking(self) -> bool:
        """Return whether poses are being polled."""
        return self.phase == "tracking"

    @property
    def counters(self) -> AuroraCounters:
        """Return a copy of the counters."""
        self._counters.damaged = self._reader.damaged
        return AuroraCounters(**asdict(self._counters))

    def take_events(self) -> list[DeviceEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def line_actions(self) -> list[LineAction]:
        """Return the actions on the serial line before sending, in order: set the speed, send a break."""
        actions, self._actions = self._actions, []
        return actions

    @property
    def next_due_ns(self) -> int | None:
        """Return the time (ns) of the next call of `outgoing` if nothing arrives; None: at once."""
        if not self.tracking:
            return self._deadline_ns
        return self._flight.deadline_ns if self._flight is not None else self._next_poll_ns

    def outgoing(self, now_ns: int) -> bytes:
        """Return the bytes to send now. Time-outs and retries are decided here."""
        if self.tracking:
            self._poll(now_ns)
        elif self._session is None:
            if self._deadline_ns is None or now_ns >= self._deadline_ns:
                self._start_session(set_up(self), now_ns)
        elif self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self._resume(None, now_ns)
        out, self._out = self._out, b""
        return out

    def feed(self, data: bytes, now_ns: int) -> list[PoseSample]:
        """Return the poses completed by `data`, which was read at `now_ns`."""
        samples: list[PoseSample] = []
        for reply in self._reader.feed(data):
            self._counters.replies += 1
            if self.tracking:
                samples += self._tracked(reply, now_ns)
            elif self._session is not None and not self._pausing and reply.text is not None:
                self._resume(reply.text, now_ns)
            else:
                self._counters.unexpected += 1
        return samples

    def lost(self, now_ns: int, why: str) -> None:
        """Note that the transport is gone. The client starts from the beginning with the next `outgoing`."""
        self._fail(why, now_ns, retry_s=0.0)

    # Session: the scripts of aurora_session, one reply or time-out at a time.

    def event(self, kind: DeviceEventKind, text: str, now_ns: int | None = None) -> None:
        """Note an event; an error that repeats the last one is noted once. For the session's scripts."""
        self._counters.warnings += kind is DeviceEventKind.WARNING
        self._counters.errors += kind is DeviceEventKind.ERROR
        if kind is DeviceEventKind.ERROR and text == self._last_error:
            return
        self._last_error = text if kind is DeviceEventKind.ERROR else ""
        self._events.append(DeviceEvent(self._now_ns if now_ns is None else now_ns, "aurora", kind, text))

    def line(self, action: LineAction) -> None:
        """Request a line action. For the session's scripts."""
        self._baud = action.baud
        self._reader.clear()
        self._actions.append(action)

    def _start_session(self, script: Generator[SessionStep, str | None, dict[str, ndi.ToolInfo]], now_ns: int) -> None:
        self._session = script
        self._counters.sessions += 1
        self._reader.clear()
        self._resume(None, now_ns)

    def _resume(self, reply: str | None, now_ns: int) -> None:
        assert self._session is not None
        self._now_ns = now_ns
        try:
            step = self._session.send(reply)
        except StopIteration as done:
            self._session, self.tools = None, done.value
            self._begin_tracking()
            self.phase = "tracking"
            kind = DeviceEventKind.RECONNECTED if self._was_tracking else DeviceEventKind.TRACKING
            self._was_tracking = True
            self.event(kind, f"tools {', '.join(self.tools)} at {self._baud} baud, {self.firmware}")
        except (SessionFailed, ndi.ProtocolError) as failed:
            self._fail(str(failed), now_ns, self.config.retry_s)
        else:
            self.phase, self._pausing = step.phase, step.pause
            self._out += step.send
            self._deadline_ns = now_ns + round(step.wait_s * 1e9)

    def _fail(self, why: str, now_ns: int, retry_s: float) -> None:
        self.event(DeviceEventKind.LOST if self.tracking else DeviceEventKind.ERROR, why, now_ns)
        self.phase, self._session, self._out = "waiting", None, b""
        self._deadline_ns = now_ns + round(retry_s * 1e9)

    # Tracking.

    def _begin_tracking(self) -> None:
        self.clock.reset()
        self._frames_seen = 0
        self._flight: _Flight | None = None
        self._next_poll_ns = 0
        self._timeouts = 0
        self._strange_in_row = 0
        self._frame_seen_ns = 0
        self._frame: int | None = None  # newest frame of all tools, unwrapped
        self._tool_frames: dict[str, int] = {}
        self._system_status: int | None = None
        self._tool_flags: dict[str, PoseFlag] = {}
        self._same: dict[str, tuple[tuple[float, ...], int]] = {}

    def _poll(self, now_ns: int) -> None:
        if self._flight is not None:
            if now_ns < self._flight.deadline_ns:
                return
            self._counters.poll_timeouts += 1
            self._timeouts += 1
            self._reader.clear()
            if self._timeouts >= LOST_AFTER_TIMEOUTS:
                self._fail(f"no reply to {self.config.reply} for {self._timeouts} polls", now_ns, 0.0)
                return
        elif now_ns < self._next_poll_ns:
            return
        self._out += ndi.command(self.config.reply, f"{ndi.TRANSFORMS:04X}")
        self._counters.polls += 1
        wire_ns = self._wire_ns(_REPLY_BYTES + _REPLY_BYTES_PER_TOOL * max(len(self.tools), 4))
        self._flight = _Flight(now_ns, now_ns + round(self.config.poll_timeout_s * 1e9) + wire_ns)

    def _tracked(self, reply: ndi.NdiReply, now_ns: int) -> list[PoseSample]:
        self._flight, self._timeouts = None, 0
        self._next_poll_ns = now_ns
        text = reply.text
        if text is not None and text.startswith("ERROR"):
            self._fail(f"{self.config.reply}: {ndi.describe_reply(text)}", now_ns, self.config.retry_s)
            return []
        if text == "RESET":
            self._fail("the device was reset or switched on again", now_ns, self.config.retry_s)
            return []
        try:
            if reply.binary is not None:
                parsed = ndi.parse_bx(reply.binary)
            else:
                parsed = ndi.parse_tx(text or "")
        except ndi.ProtocolError:
            self._counters.unexpected += 1
            return []
        before = self._frame
        samples = self._samples(parsed, reply.n_bytes, now_ns)
        rest_ns = POLL_REST * 1e9 / self.config.rate_hz - 2 * self._wire_ns(reply.n_bytes)
        gap_ns = self.config.poll_gap_s * 1e9
        self._next_poll_ns = now_ns + round(gap_ns if self._frame == before else max(gap_ns, rest_ns))
        return samples

    def _wire_ns(self, n_bytes: int) -> int:
        return n_bytes * 10 * 10**9 // self._baud

    def _samples(self, parsed: ndi.TrackingReply, n_bytes: int, now_ns: int) -> list[PoseSample]:
        frames = [tool.frame for tool in parsed.tools if tool.frame is not None and tool.handle in self.tools]
        newest = self._newest_frame(frames, now_ns)
        if newest is None:
            return []
        # The reply's time on the wire is known. `latency_s` is the delay before it.
        if newest != self._frame:
            self._frame = newest
            self._frames_seen += 1
            self.clock.observe(newest, now_ns - self._wire_ns(n_bytes))
        samples = []
        for tool in parsed.tools if self._frames_seen > self.config.settle_frames else ():
            if tool.handle in self.tools and (frame := self._fresh(tool, newest)) is not None:
                stamp_ns = min(self.clock.time_ns(frame), now_ns) - round(self.config.latency_s * 1e9)
                samples.append(self._sample(tool, frame, stamp_ns, now_ns))
        self._system(parsed.system_status, now_ns)
        return samples

    def _newest_frame(self, frames: list[int], now_ns: int) -> int | None:
        """Return the reply's newest frame, unwrapped; None if the counter cannot have this value."""
        if not frames:
            return self._frame
        newest = max(_unwrap(frame, self._frame if self._frame is not None else frame) for frame in frames)
        if self._frame is not None:
            most = self._frame + _JUMP_FRAMES + 2 * (now_ns - self._frame_seen_ns) * 1e-9 * self.config.rate_hz
            if not self._frame <= newest <= most:
                self._counters.frames_strange += 1
                self._strange_in_row += 1
                if self._strange_in_row < _STRANGE_IN_ROW:
                    return None
                text = f"frame counter went from {self._frame} to {newest}: learning its clock again"
                self.event(DeviceEventKind.WARNING, text, now_ns)
                self.clock.reset()
                self._frame = None
                self._tool_frames.clear()
        self._strange_in_row, self._frame_seen_ns = 0, now_ns
        return newest

    def _fresh(self, tool: ndi.ToolReply, newest: int) -> int | None:
        """Return the tool's frame, unwrapped, if it was not reported before."""
        frame = newest if tool.frame is None else _unwrap(tool.frame, newest)
        before = self._tool_frames.get(tool.handle)
        if before is not None and frame <= before:
            self._counters.repeats += 1
            return None
        if before is not None:
            self._counters.frames_missed += frame - before - 1
        self._tool_frames[tool.handle] = frame
        return frame

    def _sample(self, tool: ndi.ToolReply, frame: int, stamp_ns: int, now_ns: int) -> PoseSample:
        flags = flags_of(tool)
        position, quaternion = np.full(3, np.nan), np.full(4, np.nan)
        if tool.position_m is not None and tool.quaternion_wxyz is not None:
            norm = math.hypot(*tool.quaternion_wxyz)
            far = math.hypot(*tool.position_m)
            if abs(norm - 1.0) < _UNIT_TOLERANCE and far <= self.config.max_distance_m:
                position = np.array(tool.position_m)
                quaternion = np.array(tool.quaternion_wxyz) * (math.copysign(1.0, tool.quaternion_wxyz[0]) / norm)
            else:
                flags |= PoseFlag.NOT_A_POSE
                self._counters.not_a_pose += 1
            if self._is_frozen(tool.handle, tool.quaternion_wxyz + tool.position_m):
                flags |= PoseFlag.FROZEN
                self._counters.frozen += 1
        missing = bool(flags & ~PoseFlag.PARTLY_OUT_OF_VOLUME)
        if missing:
            position, quaternion = np.full(3, np.nan), np.full(4, np.nan)
        self._counters.poses += not missing
        self._counters.missing += missing
        if flags != self._tool_flags.get(tool.handle, NO_FLAGS):
            self._tool_flags[tool.handle] = flags
            self.event(DeviceEventKind.WARNING, f"tool {tool.handle}: {describe_flags(flags)}", now_ns)
        return PoseSample(tool.handle, frame, stamp_ns, now_ns, position, quaternion, tool.error_m, missing, flags)

    def _is_frozen(self, handle: str, numbers: tuple[float, ...]) -> bool:
        before, run = self._same.get(handle, ((), 0))
        run = run + 1 if numbers == before else 0
        self._same[handle] = (numbers, run)
        return 0 < self.config.frozen_after <= run

    def _system(self, status: int, now_ns: int) -> None:
        """Report changes of the system's status; enumerate the tools again after one was plugged in or unplugged."""
        first, risen = self._system_status is None, status & ~(self._system_status or 0)
        self._system_status = status
        if risen:
            self.event(DeviceEventKind.WARNING, ndi.describe_system_status(risen) or f"system status {risen:04X}", now_ns)
        # A bit that was set before the ports were last read is not a change.
        if not first and risen & (ndi.PORT_OCCUPIED | ndi.PORT_UNOCCUPIED):
            self.event(DeviceEventKind.LOST, "a tool was plugged in or unplugged; reading the ports again", now_ns)
            self._start_session(enumerate_and_start(self, stop_first=True), now_ns)


def _unwrap(frame: int, near: int) -> int:
    """Return the counter value congruent to `frame` (mod 2^32) that is nearest to `near`."""
    half = FRAME_MODULUS // 2
    return near + (frame - near + half) % FRAME_MODULUS - half
