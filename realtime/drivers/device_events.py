"""Events of a sensor's driver: its messages apart from the samples."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class DeviceEventKind(Enum):
    """TRACKING: samples flow for the first time. RECONNECTED: they flow again; hold, and come back disarmed."""

    TRACKING = "tracking"
    LOST = "lost"
    RECONNECTED = "reconnected"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """One event for the log, with the driver's time of it."""

    stamp_ns: int
    device: str
    kind: DeviceEventKind
    text: str
