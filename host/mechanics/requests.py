"""Requests of `seldinger solve`: keys, ranges, the catheter they name, and the answer as JSON."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from protocol.catheter import Catheter, load_catheter
from protocol.errors import Description, InputError
from protocol.requests import Request, unknown_key, validate
from protocol.text_files import read_json

# Far beyond any catheter: a value outside is a mistaken unit, and must not reach a kernel.
Insertion = Annotated[float, Field(ge=-0.5, le=0.5)]
Curvature = Annotated[float, Field(ge=-500.0, le=500.0)]
Component = Annotated[float, Field(ge=-50.0, le=50.0)]
Coordinate = Annotated[float, Field(ge=-10.0, le=10.0)]
Station = Annotated[float, Field(ge=0.0, le=1.0)]
Stations = Annotated[list[Station], Field(max_length=10_000)]

Array = NDArray[np.float64]
PICTURE_POINTS = 121
Planar = TypeVar("Planar", bound=Request)
Spatial = TypeVar("Spatial", bound=Request)


class Actuated(Request):
    """Keys of every request: catheter and actuation."""

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
    """Request of spatial statics: tip force in the tip or base frame, stations along the catheter."""

    model: Literal["cosserat"]
    force_N: Annotated[list[Component], Field(min_length=3, max_length=3)]
    force_frame: Literal["base", "tip"]
    tendon_tension_N: Annotated[float, Field(ge=0.0, le=500.0)] = 0.0
    stations_m: Stations = Field(default_factory=list)


def read_request(source: str, planar: type[Planar], spatial: type[Spatial]) -> Planar | Spatial:
    """Read and check the request in file `source` ('-': standard input).

    Arguments: `planar`, `spatial`: what the request must be when its key "model" is pcar or cosserat.
    Raises: InputError that names the first bad key.
    """
    data = read_json(source)
    model: Any = data.get("model") if isinstance(data, dict) else None
    if isinstance(data, dict) and data and not data.keys() & planar.model_fields.keys():
        raise InputError(source, Description(f"the keys {', '.join(list(data)[:4])}"), "a request with the key model")
    if isinstance(data, dict) and model not in ("pcar", "cosserat"):
        raise InputError("model", "nothing" if model is None else model, "pcar or cosserat")
    wanted = planar if model == "pcar" else spatial
    unknown = [key for key in data if key not in wanted.model_fields] if isinstance(data, dict) else []
    if unknown:  # before missing keys: a misspelt key is both
        raise InputError(unknown[0], data[unknown[0]], unknown_key(unknown[0], list(wanted.model_fields)))
    return validate(wanted, data)


def catheter_for(request: Actuated, group: str) -> Catheter:
    """Load the request's catheter. Raises InputError where it has no parameters of `group` (pcar or cosserat)."""
    catheter = load_catheter(request.catheter)
    if getattr(catheter, group) is None:
        raise InputError(
            "catheter", request.catheter, f"a catheter with [{group}] parameters; this one has none: calibrate it first"
        )
    if not request.insertion_m > -catheter.distal_length_m:
        raise InputError(
            "insertion_m", request.insertion_m, f"more than -{catheter.distal_length_m}, the length of the distal shaft"
        )
    return catheter


class ShapePicture(NamedTuple):
    """What a picture of a solution shows.

    loaded_m, unloaded_m: (points, 2 or 3), from the sheath to the tip. force_N: on the tip, base frame. measured_m: (k, 2 or
    3), tracked positions; k may be 0.
    """

    title: str
    loaded_m: Array
    unloaded_m: Array
    force_N: Array
    measured_m: Array


def solve_request(request: PcarSolve | CosseratSolve, with_picture: bool) -> tuple[dict[str, Any], ShapePicture | None]:
    """Solve a request.

    Returns:
        The answer that `seldinger solve --json` prints (docs/conventions.md; "converged" false: with "reason" and
        "load_reached"), and the picture where one is wanted and there is a solution.

    Raises:
        InputError: a catheter without parameters of that model, or an insertion that leaves no catheter outside.
    """
    return _planar(request, with_picture) if isinstance(request, PcarSolve) else _spatial(request, with_picture)


def _not_converged(reason: str, load_reached: float, iterations: int) -> dict[str, Any]:
    return {"converged": False, "reason": reason, "load_reached": load_reached, "iterations": iterations}


def _planar(request: PcarSolve, with_picture: bool) -> tuple[dict[str, Any], ShapePicture | None]:
    from host.mechanics import pcar

    catheter = catheter_for(request, "pcar")
    arcs = pcar.arcs_of(catheter, request.insertion_m, request.curvature_per_m)
    total = arcs.total_length_m
    found = pcar.solve(arcs, request.force_N)
    if not found.converged:
        return _not_converged(found.status.name.lower(), found.load_share, found.iterations), None
    # inside the sheath the catheter is straight
    stations = [
        pcar.point_at(arcs, found.curvature_per_m, total - back) if back <= total else (np.array([total - back, 0.0]), 0.0)
        for back in request.stations_m
    ]
    picture = None
    if with_picture:
        picture = ShapePicture(
            f"{catheter.name}, circular arcs",
            pcar.shape(arcs, found.curvature_per_m, PICTURE_POINTS),
            pcar.shape(arcs, arcs.unloaded_curvature_per_m, PICTURE_POINTS),
            np.array(request.force_N),
            np.empty((0, 2)),
        )
    answer = {
        "tip": {"position_m": found.tip_position_m, "angle_rad": found.tip_angle_rad},
        "arc_curvatures_per_m": found.curvature_per_m,
        "arc_lengths_m": arcs.length_m,
        "stations": [{"position_m": position, "angle_rad": angle} for position, angle in stations],
        "iterations": found.iterations,
        "converged": True,
        "stable": found.stable,
    }
    return answer, picture


def _spatial(request: CosseratSolve, with_picture: bool) -> tuple[dict[str, Any], ShapePicture | None]:
    from host.mechanics.cosserat import solve_cosserat

    catheter = catheter_for(request, "cosserat")
    total = catheter.distal_length_m + request.insertion_m
    drawn = np.linspace(total, 0.0, PICTURE_POINTS) if with_picture else np.empty(0)
    actuation = (catheter, request.insertion_m, request.curvature_per_m)
    stations_m = np.concatenate([request.stations_m, drawn])
    found = solve_cosserat(*actuation, request.force_N, request.force_frame, request.tendon_tension_N, stations_m)
    if not found.converged:
        return _not_converged(found.reason, found.load_reached, found.iterations), None
    count = len(request.stations_m)
    picture = None
    if with_picture:
        picture = ShapePicture(
            f"{catheter.name}, rod",
            found.station_positions_m[count:],
            solve_cosserat(*actuation, stations_m=drawn).station_positions_m,
            np.asarray(found.force_base_N),
            np.empty((0, 3)),
        )
    stations = zip(found.station_positions_m[:count], found.station_quaternions_wxyz[:count], strict=True)
    answer = {
        "tip": {"position_m": found.tip_position_m, "quaternion_wxyz": found.tip_quaternion_wxyz},
        "stations": [{"position_m": position, "quaternion_wxyz": turn} for position, turn in stations],
        "force_tip_N": found.force_tip_N,
        "force_base_N": found.force_base_N,
        "iterations": found.iterations,
        "converged": True,
        "stable": found.stable,
        "branch": found.branch,
    }
    return answer, picture
