"""Force at the tip from measured poses, by both models of the catheter; and the estimator of a running rig.

`estimate_force` is one function over both models. `Estimator` is what the model process calls for each pose. A name is
loaded when it is first used, because the compiled estimators take half a second to import.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from host.estimation.force import estimate_force
    from host.estimation.interface import Actuation, Estimator, PoseReading, TipForce
    from host.estimation.planar import PlanarEstimate, PlanarTracker, RecordingEstimate
    from host.estimation.sensor_noise import PoseSensor, SurfacePrior
    from host.estimation.service import EstimationService, load_estimator
    from host.estimation.spatial import SpatialEstimate
    from host.estimation.spatial_batch import BatchEstimate, ForceTracker

__all__ = [
    "Actuation",
    "BatchEstimate",
    "EstimationService",
    "Estimator",
    "ForceTracker",
    "PlanarEstimate",
    "PlanarTracker",
    "PoseReading",
    "PoseSensor",
    "RecordingEstimate",
    "SpatialEstimate",
    "SurfacePrior",
    "TipForce",
    "estimate_force",
    "load_estimator",
]

_HOME = {
    "estimate_force": "host.estimation.force",
    "Actuation": "host.estimation.interface",
    "Estimator": "host.estimation.interface",
    "PoseReading": "host.estimation.interface",
    "TipForce": "host.estimation.interface",
    "PlanarEstimate": "host.estimation.planar",
    "PlanarTracker": "host.estimation.planar",
    "RecordingEstimate": "host.estimation.planar",
    "PoseSensor": "host.estimation.sensor_noise",
    "SurfacePrior": "host.estimation.sensor_noise",
    "EstimationService": "host.estimation.service",
    "load_estimator": "host.estimation.service",
    "SpatialEstimate": "host.estimation.spatial",
    "BatchEstimate": "host.estimation.spatial_batch",
    "ForceTracker": "host.estimation.spatial_batch",
}


def __getattr__(name: str) -> Any:
    """Load a name of this room's face when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value
