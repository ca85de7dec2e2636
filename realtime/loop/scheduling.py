"""Requests to the kernel for the loop's thread: priority, locked memory, one CPU, shallow idle states.

Each is used where allowed and left where not (containers, plain users); all of it is undone on leaving.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14
_IDLE_LATENCY_DEVICE = "/dev/cpu_dma_latency"
_ADVICE = "run as root, or allow CAP_SYS_NICE and CAP_IPC_LOCK (limits.conf: rtprio 99, memlock unlimited)"


@dataclass(frozen=True)
class RealtimeSettings:
    """What to ask for. `cpu` -1: the last one this process may use; None: no pinning."""

    priority: int = 80
    cpu: int | None = -1
    lock_memory: bool = True
    shallow_idle: bool = True


@dataclass
class RealtimeReport:
    """What was granted, and what was not, with the reason."""

    priority: bool = False
    memory_locked: bool = False
    cpu: int | None = None
    shallow_idle: bool = False
    refused: list[str] = field(default_factory=list)

    @property
    def warning(self) -> str | None:
        """Describe what was refused in one line; None where every request was granted."""
        if not self.refused:
            return None
        return (
            f"the loop runs without the settings that it requested: {'; '.join(self.refused)}. Ticks can be late; {_ADVICE}"
        )


@contextlib.contextmanager
def realtime_thread(settings: RealtimeSettings | None) -> Iterator[RealtimeReport]:
    """Ask for `settings` for the calling thread (memory and idle states: for its process, the machine); None: nothing.

    Yields the report; afterwards everything is as before. Never raises for what is not granted.
    """
    report = RealtimeReport()
    if settings is None:
        yield report
        return
    with contextlib.ExitStack() as undo:
        if settings.cpu is not None:
            _pin(settings.cpu, report, undo)
        if settings.lock_memory:
            _lock_memory(report, undo)
        if settings.shallow_idle:
            _hold_idle_latency(report, undo)
        _raise_priority(settings.priority, report, undo)
        yield report


def _raise_priority(priority: int, report: RealtimeReport, undo: contextlib.ExitStack) -> None:
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        report.refused.append(f"SCHED_FIFO priority {priority} ({error.strerror})")
        return
    report.priority = True
    undo.callback(os.sched_setscheduler, 0, before, parameters)


def _pin(cpu: int, report: RealtimeReport, undo: contextlib.ExitStack) -> None:
    before = os.sched_getaffinity(0)
    wanted = max(before) if cpu < 0 else cpu
    try:
        os.sched_setaffinity(0, {wanted})
    except OSError as error:
        report.refused.append(f"CPU {wanted} ({error.strerror})")
        return
    report.cpu = wanted
    undo.callback(os.sched_setaffinity, 0, before)


def _may_lock_all() -> bool:
    """Whether locking cannot make a later allocation fail: unlimited, or a process that limits do not bind."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        return True
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _CAP_IPC_LOCK & 1)
    return False


def _lock_memory(report: RealtimeReport, undo: contextlib.ExitStack) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if not _may_lock_all():
        report.refused.append("locked memory (the memlock limit would make later allocations fail)")
    elif libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        report.refused.append(f"locked memory ({os.strerror(ctypes.get_errno())})")
    else:
        report.memory_locked = True
        undo.callback(libc.munlockall)


def _hold_idle_latency(report: RealtimeReport, undo: contextlib.ExitStack) -> None:
    """Zero microseconds of wake-up latency for as long as the device stays open; a machine without it needs none."""
    if not os.path.exists(_IDLE_LATENCY_DEVICE):
        return
    try:
        device = os.open(_IDLE_LATENCY_DEVICE, os.O_WRONLY)
    except OSError as error:
        report.refused.append(f"{_IDLE_LATENCY_DEVICE} ({error.strerror})")
        return
    undo.callback(os.close, device)
    try:
        os.write(device, struct.pack("i", 0))
        report.shallow_idle = True
    except OSError as error:
        report.refused.append(f"{_IDLE_LATENCY_DEVICE} ({error.strerror})")
