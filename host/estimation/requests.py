"""Requests of `seldinger estimate`: keys, ranges, sensors within reach, and the answer as JSON."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from host.estimation.reach import check_apart, check_reach
from host.mechanics.requests import PICTURE_POINTS, Actuated, Coordinate, ShapePicture, Station, catheter_for
from protocol.requests import Request

Vector2 = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
QUATERNION_TOLERANCE = 1e-3
SENSORS_OF_CASE = {1: 1, 2: 1, 3: 2, 4: 2, 5: 2, 6: 3}


class PlanarPose(Request):
    """Tip pose in the bending plane."""

    position_m: Vector2
    angle_rad: Annotated[float, Field(ge=-50.0, le=50.0)]


class PcarEstimate(Actuated):
    """Planar force from the tip's pose."""

    model: Literal["pcar"]
    tip: PlanarPose


class Sensor(Request):
    """One tracked pose: its place on the catheter, position and orientation."""

    offset_m: Station
    position_m: Vector3
    quaternion_wxyz: Annotated[list[Coordinate], Field(min_length=4, max_length=4)]

    @field_validator("quaternion_wxyz")
    @classmethod
    def _unit(cls, value: list[float]) -> list[float]:
        norm = math.sqrt(sum(part * part for part in value))
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"a quaternion of unit length, not {norm:.6g}")
        return value


class CosseratEstimate(Actuated):
    """Spatial force from one to three tracked poses, cases 1 to 6 of chapter 5."""

    model: Literal["cosserat"]
    case: Annotated[int, Field(ge=1, le=6)]
    sensors: Annotated[list[Sensor], Field(min_length=1, max_length=3)]

    @model_validator(mode="after")
    def _enough_sensors(self) -> CosseratEstimate:
        if len(self.sensors) < SENSORS_OF_CASE[self.case]:
            raise ValueError(f"{SENSORS_OF_CASE[self.case]} sensors for case {self.case}, not {len(self.sensors)}")
        return self


def estimate_request(
    request: PcarEstimate | CosseratEstimate, with_picture: bool
) -> tuple[dict[str, Any], ShapePicture | None]:
    """Estimate the force of a request.

    Returns:
        The answer that `seldinger estimate --json` prints (docs/conventions.md, Residuals of the force estimation), and the
        picture where one is wanted.

    Raises:
        InputError: a catheter without parameters of that model, or a sensor out of the catheter's reach.
    """
    return _planar(request, with_picture) if isinstance(request, PcarEstimate) else _spatial(request, with_picture)


def _planar(request: PcarEstimate, with_picture: bool) -> tuple[dict[str, Any], ShapePicture | None]:
    from host.estimation import planar
    from host.mechanics import pcar

    catheter = catheter_for(request, "pcar")
    arcs = pcar.arcs_of(catheter, request.insertion_m, request.curvature_per_m)
    check_reach("tip.position_m", request.tip.position_m, arcs.total_length_m)
    found = planar.estimate(arcs, [*request.tip.position_m, request.tip.angle_rad], thorough=True)
    picture = None
    if with_picture:
        picture = ShapePicture(
            f"{catheter.name}, force from the tip's pose",
            pcar.shape(arcs, found.curvature_per_m, PICTURE_POINTS),
            pcar.shape(arcs, arcs.unloaded_curvature_per_m, PICTURE_POINTS),
            found.force_N,
            np.array([request.tip.position_m]),
        )
    return {**_common(found), "force_frame": "base"}, picture


def _spatial(request: CosseratEstimate, with_picture: bool) -> tuple[dict[str, Any], ShapePicture | None]:
    from host.estimation.spatial import PoseSensor, estimate_cosserat
    from host.mechanics.cosserat import solve_cosserat

    catheter = catheter_for(request, "cosserat")
    exposed_m = catheter.distal_length_m + request.insertion_m
    for index, sensor in enumerate(request.sensors):
        check_reach(f"sensors.{index}.position_m", sensor.position_m, exposed_m)
    used = request.sensors[: SENSORS_OF_CASE[request.case]]
    check_apart("sensors.{}.position_m", [sensor.offset_m for sensor in used], [sensor.position_m for sensor in used])
    sensors = [PoseSensor(sensor.offset_m, sensor.position_m, sensor.quaternion_wxyz) for sensor in request.sensors]
    actuation = (catheter, request.insertion_m, request.curvature_per_m)
    found = estimate_cosserat(*actuation, request.case, sensors)
    picture = None
    if with_picture:
        drawn = np.linspace(exposed_m, 0.0, PICTURE_POINTS)
        loaded = solve_cosserat(*actuation, found.force_N, found.force_frame, stations_m=drawn)
        picture = ShapePicture(
            f"{catheter.name}, force from poses, case {request.case}",
            loaded.station_positions_m,
            solve_cosserat(*actuation, stations_m=drawn).station_positions_m,
            np.asarray(loaded.force_base_N),
            np.array([sensor.position_m for sensor in request.sensors]),
        )
    return {**_common(found), "force_frame": found.force_frame, "solutions_N": found.solutions_N}, picture


def _common(found: Any) -> dict[str, Any]:
    return {
        "force_N": found.force_N,
        "covariance_N2": found.covariance_N2,
        "converged": found.converged,
        "residual": found.residual,
        "chi_square": found.chi_square,
        "iterations": found.iterations,
        "weakest_direction": found.weakest_direction,
        "weakest_std_N": found.weakest_std_N,
        "warnings": list(found.warnings),
    }
