"""The sweeps of a characterization on a real rig's ports, recorded; nothing moves before the operator has confirmed."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from host.recordings.header import header_of
from host.recordings.writer import RecordingWriter
from protocol.rig_file import AXES, Rig
from protocol.topics import Message
from realtime.core.sweep import MOVE_SPEED, REST_S, Sweep, SweepLoop
from realtime.core.sweep_ports import RigPorts, run_sweeps
from realtime.drivers.net_ft import RDT_PORT
from realtime.loop.scheduling import RealtimeSettings

_UNITS = (("mm", 1e3), ("deg", 57.29577951308232), ("deg", 57.29577951308232))


class PortNames(NamedTuple):
    """Ports of the devices; None: the port of the rig file."""

    board: str | None = None
    tracker: str | None = None
    force: int = RDT_PORT


def describe(sweeps: Sequence[Sweep]) -> str:
    """Describe the motion, its range and its duration, for the question to the operator."""
    parts = []
    for axis, (unit, scale) in enumerate(_UNITS):
        swing = [
            (s.centre[axis] - s.amplitude * (s.axis == axis), s.centre[axis] + s.amplitude * (s.axis == axis))
            for s in sweeps
        ]
        low, high = min(span[0] for span in swing), max(span[1] for span in swing)
        parts.append(f"{AXES[axis]} {low * scale:.0f} to {high * scale:.0f} {unit}")
    return f"stages will move: {', '.join(parts)} (from home); about {duration_s(sweeps) / 60:.0f} min"


def duration_s(sweeps: Sequence[Sweep]) -> float:
    """Return the duration of the sweeps (s), from stages at home."""
    total, place = 0.0, (0.0, 0.0, 0.0)
    for sweep in sweeps:
        total += max(abs(a - b) / speed for a, b, speed in zip(sweep.centre, place, MOVE_SPEED, strict=True))
        total += REST_S + sweep.seconds
        place = sweep.centre
    return total


def record_on_rig(
    rig: Rig,
    sweeps: Sequence[Sweep],
    path: Path,
    ports: PortNames = PortNames(),
    progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Drive `sweeps` on the rig at its ports, then record them into `path`. SIGINT and SIGTERM brake the stages and disarm.

    Nothing is written while the stages move: a disk, or a thread that writes to it, may hold the loop up for longer than
    the board waits for a set-point. What there is of sweeps broken off is written as well.
    Raises ValueError (sweeps that the stages cannot do) and OSError (a port that does not open, or is held by another
    process) before anything moves; RuntimeError where the sweeps were ended early.
    """
    received: list[tuple[str, Message]] = []

    def publish(topic: str, message: Message) -> None:
        received.append((topic, message))

    loop = SweepLoop(rig, sweeps, publish)
    with (
        RigPorts(rig, ports.board, ports.tracker, ports.force) as lines,
        RecordingWriter(path, header_of(rig, "wall", None, {"job": "characterize"})) as recording,
    ):
        try:
            with _stopping() as stop:
                run_sweeps(loop, lines, each=_progress_of(loop, progress), stop=stop.is_set, settings=RealtimeSettings())
        except OSError as gone:
            loop.break_off(f"board: {gone}")
        for topic, message in received:
            recording.write(topic, message, message.stamp_ns)
        if not loop.problem and recording.failure:
            loop.problem = recording.failure
    if loop.problem:
        lost = "".join(f"; {device}: {why}" for device, why in lines.failures.items())
        raise RuntimeError(f"characterize: {loop.problem}{lost}; the sweeps were ended early")
    return path


def _progress_of(loop: SweepLoop, progress: Callable[[float], None]) -> Callable[[], None]:
    reported = -1.0

    def each() -> None:
        nonlocal reported
        if loop.progress != reported:
            reported = loop.progress
            progress(reported)

    return each


class _stopping:
    """While active, SIGINT and SIGTERM set the returned event instead of ending the process."""

    def __init__(self) -> None:
        self._event, self._before = threading.Event(), dict[int, Any]()

    def __enter__(self) -> threading.Event:
        def on_signal(number: int, frame: FrameType | None) -> None:
            self._event.set()

        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, on_signal)
        return self._event

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
