"""The estimator that a rig file asks for: planar arcs or the spatial rod; adapted, and watched for contacts of the body."""

from __future__ import annotations

from host.estimation.adapted_rig import AdaptedRigEstimator
from host.estimation.contact_watch import ContactWatch, WatchedEstimator, curvature_as_configured
from host.estimation.interface import Estimator
from host.estimation.lasting_errors import ActuationKnowledge
from protocol.catheter import load_catheter
from protocol.rig_file import Rig


def make_estimator(rig: Rig) -> Estimator:
    """Return the estimator of section [estimation]. Raises InputError where the catheter lacks its model's parameters."""
    catheter, estimator = load_catheter(rig.catheter.name), plain_estimator(rig)
    adapted: AdaptedRigEstimator | None = None
    if rig.estimation.adaptation:
        estimator = adapted = AdaptedRigEstimator.from_rig(rig, catheter, estimator, plain_estimator(rig))
    if not rig.estimation.contact_watch or catheter.cosserat is None:
        return estimator
    watch = ContactWatch(
        catheter,
        rig.tracker.position_noise_m,
        rig.tracker.orientation_noise_rad,
        ActuationKnowledge.from_rig(rig),
        curvature_as_configured(rig) if adapted is None else adapted.free_curvature,
    )
    return WatchedEstimator(estimator, watch, rig.tracker.tool_offsets_m, adapted)


def plain_estimator(rig: Rig) -> Estimator:
    """Return the estimator of `[estimation] model` with the stiffness of the catheter's file. Raises InputError."""
    if rig.estimation.model == "planar":
        from host.estimation.planar_rig import PlanarRigEstimator

        return PlanarRigEstimator.from_rig(rig)
    from host.estimation.spatial_rig import SpatialRigEstimator

    return SpatialRigEstimator.from_rig(rig)
