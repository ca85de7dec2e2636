"""Public Python face: `import seldinger as sd`.

    catheter = sd.load_catheter("livewire")
    shape = sd.solve(catheter, insertion_m=0.01, curvature_per_m=10.0, force_N=[0.0, 0.05, 0.0])

Functions: load_catheter, solve, estimate_force, calibrate, diagnose, open_recording, connect. docs/api.md has a complete
example of each. Lengths are in m, forces in N, angles in rad, quaternions scalar first.

Each name is loaded from its room when it is first used, so that `import seldinger` costs little.
"""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

# The package index has other packages named `realtime` and `protocol`: said here in one line, not as a failure far inside.
_FOLDER = Path(__file__).resolve().parents[1]
for _name in ("protocol", "realtime", "sim", "host"):
    _spec = importlib.util.find_spec(_name)
    _found = Path(_spec.origin).resolve().parents[1] if _spec is not None and _spec.origin is not None else None
    if _found != _FOLDER:
        raise ImportError(
            f"package '{_name}': found it in {_found or 'no folder'}, wanted seldinger's own in {_FOLDER}; another package "
            f"has that name: uninstall it (pip uninstall {_name}), then reinstall seldinger"
        )

if TYPE_CHECKING:
    from host.diagnosis import Verdict, diagnose
    from host.estimation import (
        BatchEstimate,
        PlanarEstimate,
        PoseSensor,
        RecordingEstimate,
        SpatialEstimate,
        SurfacePrior,
        estimate_force,
    )
    from host.identification import Calibration, calibrate
    from host.mechanics import CosseratSolution, CosseratSolutions, PcarSolution, solve
    from host.recordings.tables import RecordingTables, open_recording
    from host.run.connection import CommandRefused, RigConnection, connect
    from protocol.catheter import Catheter, load_catheter
    from protocol.errors import InputError

__all__ = [
    "BatchEstimate",
    "Calibration",
    "Catheter",
    "CommandRefused",
    "CosseratSolution",
    "CosseratSolutions",
    "InputError",
    "PcarSolution",
    "PlanarEstimate",
    "PoseSensor",
    "RecordingEstimate",
    "RecordingTables",
    "RigConnection",
    "SpatialEstimate",
    "SurfacePrior",
    "Verdict",
    "calibrate",
    "connect",
    "diagnose",
    "estimate_force",
    "load_catheter",
    "open_recording",
    "solve",
]

_ROOMS = {
    "host.diagnosis": ("Verdict", "diagnose"),
    "host.estimation": (
        "BatchEstimate",
        "PlanarEstimate",
        "PoseSensor",
        "RecordingEstimate",
        "SpatialEstimate",
        "SurfacePrior",
        "estimate_force",
    ),
    "host.identification": ("Calibration", "calibrate"),
    "host.mechanics": ("CosseratSolution", "CosseratSolutions", "PcarSolution", "solve"),
    "host.recordings.tables": ("RecordingTables", "open_recording"),
    "host.run.connection": ("CommandRefused", "RigConnection", "connect"),
    "protocol.catheter": ("Catheter", "load_catheter"),
    "protocol.errors": ("InputError",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a name of the public face from its room."""
    if name not in _HOME:
        raise AttributeError(f"module 'seldinger' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the public functions and types."""
    return __all__
