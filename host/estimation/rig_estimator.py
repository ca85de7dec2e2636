"""The estimator that a rig file asks for: planar arcs or the spatial rod."""

from __future__ import annotations

from host.estimation.interface import Estimator
from protocol.rig_file import Rig


def make_estimator(rig: Rig) -> Estimator:
    """Return the estimator of `[estimation] model`. Raises InputError where the catheter lacks that model's parameters."""
    if rig.estimation.model == "planar":
        from host.estimation.planar_rig import PlanarRigEstimator

        return PlanarRigEstimator.from_rig(rig)
    from host.estimation.spatial_rig import SpatialRigEstimator

    return SpatialRigEstimator.from_rig(rig)
