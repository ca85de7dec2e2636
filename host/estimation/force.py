"""The force at the tip from tracked poses: one function over both models, one sample or many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.estimation import planar
from host.estimation.planar import PlanarEstimate, RecordingEstimate
from host.estimation.reach import REACH_MARGIN_M, check_apart, check_reach, out_of_reach
from host.estimation.sensor_noise import PoseSensor, SurfacePrior
from host.estimation.spatial import ONE_TO_ONE, SpatialEstimate, checked_case, estimate_cosserat, quieter_than_noise
from host.estimation.spatial_batch import BatchEstimate, estimate_batch
from host.estimation.spatial_residuals import ROWS_OF_CASE
from host.mechanics.pcar import arcs_of
from host.mechanics.rod import checked_catheter, checked_workers, column, finite, number, real, yes_or_no
from host.mechanics.statics import MODELS
from protocol.catheter import Catheter
from protocol.errors import InputError, one_of

Array = NDArray[np.float64]

FOR_ONE_SAMPLE = "the default: it is for one sample"
NOT_FOR_PCAR = "the default: the planar model reads the tip's pose alone, in the bending plane, and needs no start"


@overload
def estimate_force(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    sensors: Sequence[PoseSensor | tuple[float, ArrayLike, ArrayLike]],
    case: int,
    *,
    model: Literal["cosserat"] = ...,
    previous_force_N: ArrayLike | None = ...,
    prior: SurfacePrior | None = ...,
    roll_rad: float = ...,
    thorough: bool = ...,
    ordered: bool = ...,
    workers: int | None = ...,
) -> SpatialEstimate | BatchEstimate: ...
@overload
def estimate_force(
    catheter: Catheter,
    insertion_m: ArrayLike,
    curvature_per_m: ArrayLike,
    sensors: Sequence[tuple[float, ArrayLike, ArrayLike]],
    case: None = ...,
    *,
    model: Literal["pcar"],
    prior: SurfacePrior | None = ...,
    thorough: bool = ...,
    workers: int | None = ...,
) -> PlanarEstimate | RecordingEstimate: ...


def estimate_force(  # noqa: PLR0913 - keyword arguments of a public function, each documented
    catheter: Catheter,
    insertion_m: Any,
    curvature_per_m: Any,
    sensors: Sequence[Any],
    case: int | None = None,
    *,
    model: str = "cosserat",
    previous_force_N: ArrayLike | None = None,
    prior: SurfacePrior | None = None,
    roll_rad: float = 0.0,
    thorough: bool = False,
    ordered: bool = False,
    workers: int | None = None,
) -> SpatialEstimate | BatchEstimate | PlanarEstimate | RecordingEstimate:
    """Estimate the force on the tip from poses measured along the catheter.

    The estimate is the force of largest likelihood: the sum of squared residuals, weighted by the sensors' noise, is
    smallest. Its covariance is that of first order.

    Parameters:
        catheter: as `load_catheter` returns it.
        insertion_m: length of catheter body outside the sheath, m. One number, or (n,) for n samples.
        curvature_per_m: unloaded curvature of the distal shaft, 1/m. One number, or (n,).
        sensors: one (offset_m, position_m, quaternion_wxyz) for each sensor, or a `PoseSensor` with covariances, from the
            tip backwards: arc length back from the tip, m; position (3,) in the base frame, m; unit quaternion (4,),
            scalar first, sensor frame to base frame. For n samples: positions (n, 3) and quaternions (n, 4).
            Planar model: one (0.0, position_m (2,), angle_rad), or (0.0, (n, 2), (n,)).
        case: which parts of the poses are used, 1 to 6: 1 position of the first sensor, 2 and its orientation, 3 position
            of the second relative to the first, 4 and both orientations, 5 orientation of the second relative to the
            first, 6 and of the third. Cases 1, 3 and 5 can have several answers. None for the planar model.
        model: "cosserat", a rod in space, or "pcar", circular arcs in the bending plane.
        previous_force_N: force (3,) of the sample before, tip frame, N: the search starts there and stays on its branch.
        prior: the surface that the tip touches, a `SurfacePrior` (one sample only).
        roll_rad: roll of the handle, rad (one sample only).
        thorough: look for a better force wherever any residual is left, not only more than the noise leaves; some
            milliseconds more (one sample only).
        ordered: the n samples follow each other in time; each search starts from the force before.
        workers: threads for n samples; default one for each core.

    Returns:
        SpatialEstimate for one sample: `force_N` (3,) on the tip in the tip frame, `covariance_N2` (3, 3), `converged`,
        `residual` (dimensionless), `chi_square`, `warnings`, `solutions_N` (k, 3), ...
        BatchEstimate for n samples: `force_N` (n, 3), `covariance_N2` (n, 3, 3), `converged` (n,), `residual` (n,).
        PlanarEstimate or RecordingEstimate for the planar model: `force_N` (2,) or (n, 2) in the base frame, ...
        A pose that no force explains is not an error: `converged` is False.

    Raises:
        InputError: a value is not finite, out of its range or of a wrong shape, or a sensor is further from the sheath's
            exit than the exposed length and 20 mm, or from the sensor before it than the catheter between them and 20 mm;
            names the argument, and among n samples the first that is wrong (sensors.0.position_m.17).

    Source:
        Thesis, (5.3) to (5.11) with (5.5) corrected, and chapter 4 for the planar model; weights and covariance are ours.

    Examples:
        >>> estimate_force(catheter, 0.01, 10.0, [(0.0, r0, q0), (0.03, r1, q1)], case=4).force_N  # doctest: +SKIP
    """
    one_of("model", model, MODELS)
    checked_catheter(catheter)
    _check_settings(sensors, prior, thorough, ordered)
    workers = checked_workers(workers)
    alone = OneSample(previous_force_N, prior, roll_rad, thorough)
    if model == "pcar":
        if case is not None:
            raise InputError("case", str(case), NOT_FOR_PCAR)
        alone.refuse(("previous_force_N", "roll_rad"), NOT_FOR_PCAR)
        return _planar(catheter, insertion_m, curvature_per_m, sensors, alone, workers)
    if case is None:
        raise InputError("case", "nothing", "1 to 6")
    used = sensors[: checked_case(case)]
    if _many(sensors):
        alone.refuse(OneSample._fields, FOR_ONE_SAMPLE)
        return _many_spatial(catheter, insertion_m, curvature_per_m, case, Poses.of(used), ordered, workers)
    number("insertion_m", insertion_m, "one finite length in m: the sensors have one sample")
    _check_sensors(catheter.distal_length_m, insertion_m, used)
    return estimate_cosserat(catheter, insertion_m, curvature_per_m, case, sensors, **alone._asdict())


class OneSample(NamedTuple):
    """The settings of `estimate_force` that one sample alone takes."""

    previous_force_N: ArrayLike | None
    prior: SurfacePrior | None
    roll_rad: float
    thorough: bool

    def refuse(self, keys: Sequence[str], wanted: str) -> None:
        """Raise InputError where one of the settings `keys` is not the default."""
        number("roll_rad", self.roll_rad, "a finite angle in rad")
        for key in keys:
            value = getattr(self, key)
            if value is not None and not (key in ("roll_rad", "thorough") and value == 0):
                raise InputError(key, str(value), wanted)


class Poses(NamedTuple):
    """Arc lengths back from the tip (k), positions (n, k, 3) and quaternions (n, k, 4) of n samples."""

    offsets_m: list[float]
    positions_m: Array
    quaternions_wxyz: Array

    @classmethod
    def of(cls, sensors: Sequence[Any]) -> Poses:
        """Return the poses of k sensors, each with a row for each sample. Raises InputError."""
        return cls(
            [number(f"sensors.{i}.offset_m", sensor[0], "an arc length in m") for i, sensor in enumerate(sensors)],
            _stacked("position_m", [sensor[1] for sensor in sensors], 3),
            _stacked("quaternion_wxyz", [sensor[2] for sensor in sensors], 4),
        )


def _many_spatial(
    catheter: Catheter, insertion_m: Any, curvature_per_m: Any, case: int, poses: Poses, ordered: bool, workers: int | None
) -> BatchEstimate:
    """Estimate n samples with the rod; those more exact than the sensors' noise are searched a second time, one by one."""
    insertion_m = column("insertion_m", insertion_m, len(poses.positions_m), "a finite length in m")
    _check_rows(poses.positions_m, poses.offsets_m, catheter.distal_length_m + insertion_m)
    found = estimate_batch(catheter, insertion_m, curvature_per_m, case, *poses, ordered=ordered, workers=workers)
    if not ordered and case in ONE_TO_ONE:
        _search_again(found, catheter, insertion_m, curvature_per_m, case, poses)
    return found


def _check_settings(sensors: object, prior: object, thorough: object, ordered: object) -> None:
    """Raise InputError where an argument is not of its kind; what it holds is checked where it is used."""
    if not (
        isinstance(sensors, list | tuple) and sensors and all(isinstance(s, list | tuple) and len(s) >= 3 for s in sensors)
    ):
        raise InputError(
            "sensors", str(sensors), "a list of (offset_m, position_m, quaternion_wxyz), from the tip backwards"
        )
    if prior is not None and not isinstance(prior, SurfacePrior):
        raise InputError("prior", type(prior).__name__, "a SurfacePrior or None")
    yes_or_no("thorough", thorough)
    yes_or_no("ordered", ordered)


def _check_sensors(distal_length_m: float, insertion_m: Any, sensors: Sequence[Any]) -> None:
    """Raise InputError where the catheter cannot reach a sensor; what is not a number is left to the estimator to name."""
    for index, sensor in enumerate(sensors):
        number(f"sensors.{index}.offset_m", sensor[0], "an arc length in m")
        try:
            exposed_m = distal_length_m + insertion_m
            far = math.hypot(*sensor[1]) > exposed_m + REACH_MARGIN_M
        except (TypeError, ValueError, IndexError):
            return
        if far and math.isfinite(exposed_m):
            check_reach(f"sensors.{index}.position_m", sensor[1], exposed_m)
    if len(sensors) > 1 and all(len(sensor[1]) == 3 and math.isfinite(math.hypot(*sensor[1])) for sensor in sensors):
        check_apart("sensors.{}.position_m", [sensor[0] for sensor in sensors], [sensor[1] for sensor in sensors])


def _check_rows(positions_m: Array, offsets_m: Sequence[float], exposed_m: Array) -> None:
    """Raise InputError for the first of n samples, positions (n, k, ...), that the catheter cannot reach; exposed_m (n,)."""
    for row in np.flatnonzero(out_of_reach(positions_m, offsets_m, exposed_m)):
        for index, position in enumerate(positions_m[row]):
            check_reach(f"sensors.{index}.position_m.{row}", position, float(exposed_m[row]))
        check_apart(f"sensors.{{}}.position_m.{row}", offsets_m, list(positions_m[row]))


def _search_again(
    found: BatchEstimate, catheter: Catheter, insertion_m: ArrayLike, curvature_per_m: ArrayLike, case: int, poses: Poses
) -> None:
    """Repeat, one by one, the samples whose poses are more exact than the sensors' noise; see `quieter_than_noise`."""
    n = len(found.force_N)
    insertion, curvature = np.broadcast_to(insertion_m, n), np.broadcast_to(curvature_per_m, n)
    for i in np.flatnonzero(found.converged & quieter_than_noise(found.chi_square, int(ROWS_OF_CASE[case]) - 3)):
        places = zip(poses.offsets_m, poses.positions_m[i], poses.quaternions_wxyz[i], strict=True)
        sensors = [PoseSensor(offset, position, quaternion) for offset, position, quaternion in places]
        one = estimate_cosserat(catheter, float(insertion[i]), float(curvature[i]), case, sensors)
        found.force_N[i], found.covariance_N2[i] = one.force_N, one.covariance_N2
        found.converged[i], found.residual[i], found.chi_square[i] = one.converged, one.residual, one.chi_square


def _many(sensors: Sequence[Any]) -> bool:
    """Whether the first sensor has a row for each of n samples."""
    position = sensors[0][1]
    ndim = getattr(position, "ndim", None)
    if ndim is not None:
        return bool(ndim == 2)
    return isinstance(position, list | tuple) and len(position) > 0 and hasattr(position[0], "__len__")


def _stacked(key: str, parts: list[Any], width: int) -> Array:
    """Arrays (n, width) of k sensors as one (n, k, width). Raises InputError."""
    arrays = [
        real(f"sensors.{i}.{key}", part, f"numbers (n, {width}), a row for each sample") for i, part in enumerate(parts)
    ]
    rows = arrays[0].shape[0] if arrays[0].ndim else 1
    for index, array in enumerate(arrays):
        if array.shape != (rows, width):
            raise InputError(f"sensors.{index}.{key}", f"shape {array.shape}", f"({rows}, {width})")
    return np.stack(arrays, axis=1)


def _planar(
    catheter: Catheter,
    insertion_m: Any,
    curvature_per_m: Any,
    sensors: Sequence[Any],
    alone: OneSample,
    workers: int | None,
) -> PlanarEstimate | RecordingEstimate:
    """Estimate one sample or many with circular arcs, from the pose of the tip in the bending plane."""
    if len(sensors) != 1 or len(sensors[0]) != 3 or number("sensors.0.offset_m", sensors[0][0], "0.0: the tip") != 0.0:
        raise InputError("sensors", str(sensors), "one (0.0, position_m, angle_rad): the planar model reads the tip's pose")
    _, position, angle = sensors[0]
    if not _many(sensors):
        arcs = arcs_of(catheter, insertion_m, curvature_per_m)
        _check_sensors(catheter.distal_length_m, insertion_m, sensors)
        x, y = finite("sensors.0.position_m", position, (2,), "two finite numbers in m")
        pose = (x, y, number("sensors.0.angle_rad", angle, "a finite angle in rad"))
        return planar.estimate(arcs, pose, prior=alone.prior, thorough=alone.thorough)
    alone.refuse(("prior", "thorough"), FOR_ONE_SAMPLE)
    places = real("sensors.0.position_m", position, "numbers (n, 2), in m")
    angles = real("sensors.0.angle_rad", angle, "numbers (n,), in rad")
    if places.ndim != 2 or places.shape[1] != 2 or angles.shape != places.shape[:1]:
        raise InputError("sensors.0", f"shapes {places.shape} and {angles.shape}", "positions (n, 2) and angles (n,)")
    insertion_m = column("insertion_m", insertion_m, len(places), "a finite length in m")
    _check_rows(places[:, None, :], [0.0], catheter.distal_length_m + insertion_m)
    poses = np.column_stack([places, angles])
    return planar.estimate_recording(catheter, insertion_m, curvature_per_m, poses, workers=workers)
