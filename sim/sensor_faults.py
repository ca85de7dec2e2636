"""What goes wrong with an emulated sensor, and when: one kind of fault for all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class SensorFault:
    """Something wrong from start_ns to stop_ns. `kind` is one of the emulator's, which says what `value` means;
    `handle`: of this tool only (Aurora)."""

    kind: str
    start_ns: int
    stop_ns: int
    handle: str | None = None
    value: float = 0.0


def checked(faults: Iterable[SensorFault], kinds: Sequence[str]) -> list[SensorFault]:
    """The faults as a list. Raises ValueError for a kind that is not among `kinds`."""
    faults = list(faults)
    for fault in faults:
        if fault.kind not in kinds:
            raise ValueError(f"fault kind: found {fault.kind!r}, wanted one of {', '.join(kinds)}")
    return faults


def active(faults: Sequence[SensorFault], time_ns: int, kind: str | None = None) -> list[SensorFault]:
    """Those of `kind` (None: any) that last at `time_ns`."""
    return [f for f in faults if f.start_ns <= time_ns < f.stop_ns and kind in (None, f.kind)] if faults else []


def strongest(faults: Sequence[SensorFault], time_ns: int, kind: str) -> float:
    """The largest value among the active faults of `kind`, 0 without any."""
    return max((fault.value for fault in active(faults, time_ns, kind)), default=0.0) if faults else 0.0
