"""Identification: from shapes recorded under known loads to a catheter's parameters, with their uncertainty."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from host.identification.calibration import Calibration, FittedParameter
    from host.identification.catheter_calibration import calibrate
    from host.identification.recorded_shapes import RecordedShape, read_recorded_shapes

__all__ = ["Calibration", "FittedParameter", "RecordedShape", "calibrate", "read_recorded_shapes"]

_HOME = {
    "Calibration": "host.identification.calibration",
    "FittedParameter": "host.identification.calibration",
    "calibrate": "host.identification.catheter_calibration",
    "RecordedShape": "host.identification.recorded_shapes",
    "read_recorded_shapes": "host.identification.recorded_shapes",
}


def __getattr__(name: str) -> Any:
    """Load a name of this room's face when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value
