"""One tool's pose in one frame, and the flags that say why it is missing or to be taken with care."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from realtime.drivers import ndi_protocol as ndi


class PoseFlag(IntFlag):
    """Why a pose is missing, or is to be taken with care."""

    MISSING = 1
    DISABLED = 2
    UNOCCUPIED = 4
    OUT_OF_VOLUME = 8
    PARTLY_OUT_OF_VOLUME = 16
    SENSOR_BROKEN = 32
    PROCESSING_EXCEPTION = 64
    NOT_A_POSE = 128
    FROZEN = 256


NO_FLAGS = PoseFlag(0)


@dataclass(frozen=True, slots=True, eq=False)
class PoseSample:
    """One tool in one frame. Where `missing` is true, position and quaternion are NaN and must not be used.

    tool: port handle, e.g. "0A"; frame: device's counter; stamp_ns: when the field was sampled, host clock;
    arrival_ns: when the reply was read; position_m: (3,); quaternion_wxyz: (4,), unit, w >= 0, tool -> tracker;
    quality_m: the device's own indicator value; flags: reasons.
    """

    tool: str
    frame: int
    stamp_ns: int
    arrival_ns: int
    position_m: np.ndarray
    quaternion_wxyz: np.ndarray
    quality_m: float
    missing: bool
    flags: PoseFlag = NO_FLAGS


_STATE_FLAGS = {
    ndi.HandleState.VALID: NO_FLAGS,
    ndi.HandleState.MISSING: PoseFlag.MISSING,
    ndi.HandleState.DISABLED: PoseFlag.DISABLED,
    ndi.HandleState.UNOCCUPIED: PoseFlag.UNOCCUPIED,
}
_PORT_FLAGS = {
    ndi.PortStatus.OUT_OF_VOLUME: PoseFlag.OUT_OF_VOLUME,
    ndi.PortStatus.PARTLY_OUT_OF_VOLUME: PoseFlag.PARTLY_OUT_OF_VOLUME,
    ndi.PortStatus.SENSOR_BROKEN: PoseFlag.SENSOR_BROKEN,
    ndi.PortStatus.PROCESSING_EXCEPTION: PoseFlag.PROCESSING_EXCEPTION,
}


def flags_of(tool: ndi.ToolReply) -> PoseFlag:
    """Return the flags of a handle's state and port status."""
    flags = _STATE_FLAGS[tool.state]
    for bit, flag in _PORT_FLAGS.items():
        if tool.status & bit:
            flags |= flag
    return flags


def describe_flags(flags: PoseFlag) -> str:
    """Describe the flags, e.g. "missing, out of volume"; "in view" when none is set."""
    names = [flag.name or "" for flag in PoseFlag if flag in flags]
    return ", ".join(name.lower().replace("_", " ") for name in names) or "in view"
