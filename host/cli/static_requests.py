"""What `seldinger solve` and `seldinger estimate` accept: the requests' keys, ranges and the catheter they name."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from protocol.catheter import Catheter, load_catheter
from protocol.errors import InputError
from protocol.requests import Request, read_json, validate

# Far beyond any catheter: what lies outside is a slip of unit, and must not reach a kernel.
Insertion = Annotated[float, Field(ge=-0.5, le=0.5)]
Curvature = Annotated[float, Field(ge=-500.0, le=500.0)]
Component = Annotated[float, Field(ge=-50.0, le=50.0)]
Coordinate = Annotated[float, Field(ge=-10.0, le=10.0)]
Station = Annotated[float, Field(ge=0.0, le=1.0)]
Vector2 = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Stations = Annotated[list[Station], Field(max_length=10_000)]

QUATERNION_TOLERANCE = 1e-3
SENSORS_OF_CASE = {1: 1, 2: 1, 3: 2, 4: 2, 5: 2, 6: 3}
Model = TypeVar("Model", bound=Request)


class Actuated(Request):
    """Keys that all requests share."""

    catheter: str
    insertion_m: Insertion
    curvature_per_m: Curvature


class PcarSolve(Actuated):
    """Planar statics: force on the tip in the base frame (x along the axis, y in the bending plane)."""

    model: Literal["pcar"]
    force_N: Annotated[list[Component], Field(min_length=2, max_length=2)]
    force_frame: Literal["base"] = "base"
    tendon_tension_N: Annotated[float, Field(ge=0.0, le=500.0)] = 0.0
    stations_m: Stations = Field(default_factory=list)


class CosseratSolve(Actuated):
    """Spatial statics."""

    model: Literal["cosserat"]
    force_N: Annotated[list[Component], Field(min_length=3, max_length=3)]
    force_frame: Literal["base", "tip"]
    tendon_tension_N: Annotated[float, Field(ge=0.0, le=500.0)] = 0.0
    stations_m: Stations = Field(default_factory=list)


class PlanarPose(Request):
    """Tip pose in the bending plane."""

    position_m: Vector2
    angle_rad: Annotated[float, Field(ge=-50.0, le=50.0)]


class PcarEstimate(Actuated):
    """Planar force from the tip's pose."""

    model: Literal["pcar"]
    tip: PlanarPose


class Sensor(Request):
    """One tracked pose."""

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


def read_request(source: str, planar: type[Model], spatial: type[Model]) -> Model:
    """The request in file `source` ('-': standard input), checked. Raises InputError naming the key."""
    data = read_json(source)
    model: Any = data.get("model") if isinstance(data, dict) else None
    if isinstance(data, dict) and model not in ("pcar", "cosserat"):
        raise InputError("model", "nothing" if model is None else model, "pcar or cosserat")
    wanted = planar if model == "pcar" else spatial
    unknown = [key for key in data if key not in wanted.model_fields] if isinstance(data, dict) else []
    if unknown:  # before missing keys: a misspelt key is both
        raise InputError(unknown[0], data[unknown[0]], "no such key; known keys: " + ", ".join(wanted.model_fields))
    return validate(wanted, data)


def catheter_for(request: Actuated, group: str) -> Catheter:
    """The request's catheter, which must have parameter group `group` (pcar or cosserat). Raises InputError."""
    catheter = load_catheter(request.catheter)
    if getattr(catheter, group) is None:
        raise InputError(
            "catheter", request.catheter, f"a catheter with [{group}] parameters, which nobody has identified for this one"
        )
    if not request.insertion_m > -catheter.distal_length_m:
        raise InputError(
            "insertion_m", request.insertion_m, f"more than -{catheter.distal_length_m}, the length of the distal shaft"
        )
    return catheter
