"""Recorded shapes under known loads: the input of calibration, from JSON or CSV, checked.

JSON: {"recordings": [{"insertion_m": 0.0485, "curvature_per_m": 15.7, "force_N": [0.0, -0.1197], "weight": 1.0,
"markers": [{"offset_m": 0.0, "position_m": [0.114, -0.028]}, ...]}, ...]}; `offset_m` is the arc length back from the
tip, `weight` may be left out. CSV: one row a marker under the heading
recording,insertion_m,curvature_per_m,force_x_N,force_y_N,offset_m,x_m,y_m (for the spatial model also force_z_N and z_m);
rows of the same `recording` belong together. Planar frame: x along the sheath's axis, y in the bending plane; spatial
frame: the base frame.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from protocol.errors import InputError
from protocol.requests import Request, validate
from protocol.text_files import read_json, read_text

Array = NDArray[np.float64]
Coordinate = Annotated[float, Field(ge=-10.0, le=10.0)]
PLANAR_COLUMNS = ("recording", "insertion_m", "curvature_per_m", "force_x_N", "force_y_N", "offset_m", "x_m", "y_m")
SPATIAL_COLUMNS = (*PLANAR_COLUMNS[:5], "force_z_N", *PLANAR_COLUMNS[5:], "z_m")


@dataclass(frozen=True)
class RecordedShape:
    """One shape: actuation, load on the tip, and where the markers were."""

    insertion_m: float
    curvature_per_m: float
    force_N: Array  # (2,) or (3,) base frame
    offset_m: Array  # (m,) arc lengths back from the tip
    position_m: Array  # (m, 2) or (m, 3)
    weight: float = 1.0


class _Marker(Request):
    offset_m: Annotated[float, Field(ge=0.0, le=1.0)]
    position_m: Annotated[list[Coordinate], Field(min_length=2, max_length=3)]


class _Recording(Request):
    insertion_m: Annotated[float, Field(ge=-0.5, le=0.5)]
    curvature_per_m: Annotated[float, Field(ge=-500.0, le=500.0)]
    force_N: Annotated[list[Annotated[float, Field(ge=-50.0, le=50.0)]], Field(min_length=2, max_length=3)]
    markers: Annotated[list[_Marker], Field(min_length=1)]
    weight: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0


class _File(Request):
    recordings: Annotated[list[_Recording], Field(min_length=1)]


def read_recorded_shapes(source: str, dimensions: int) -> list[RecordedShape]:
    """The recordings in file `source` (.csv, else JSON; '-' is JSON on standard input).

    Arguments: `dimensions`, 2 for the planar model, 3 for the spatial one. Raises: InputError, naming key or line.
    """
    data = _table(source, dimensions) if source.lower().endswith(".csv") else read_json(source)
    return checked_shapes(data, dimensions)


def checked_shapes(data: Any, dimensions: int) -> list[RecordedShape]:
    """The recordings in `data`, laid out as the JSON file. Arguments, errors: `read_recorded_shapes`."""
    checked = validate(_File, data)
    for i, recording in enumerate(checked.recordings):
        if len(recording.force_N) != dimensions:
            raise InputError(f"recordings.{i}.force_N", recording.force_N, f"{dimensions} components")
        for j, marker in enumerate(recording.markers):
            if len(marker.position_m) != dimensions:
                raise InputError(f"recordings.{i}.markers.{j}.position_m", marker.position_m, f"{dimensions} coordinates")
    return [
        RecordedShape(
            r.insertion_m,
            r.curvature_per_m,
            np.array(r.force_N),
            np.array([m.offset_m for m in r.markers]),
            np.array([m.position_m for m in r.markers]),
            r.weight,
        )
        for r in checked.recordings
    ]


def _table(source: str, dimensions: int) -> dict[str, Any]:
    """A CSV file in the shape of the JSON one; numbers are converted here, checked by the caller."""
    text = read_text(source, wanted="a readable CSV file")
    wanted = PLANAR_COLUMNS if dimensions == 2 else SPATIAL_COLUMNS
    reader = csv.DictReader(io.StringIO(text))
    columns = tuple(reader.fieldnames or ())
    if set(columns) != set(wanted) or len(columns) != len(wanted):
        raise InputError(f"{source}: heading", ",".join(columns), ",".join(wanted))
    groups: dict[str, dict[str, Any]] = {}
    axes = "xyz"[:dimensions]
    for row in reader:
        line = f"{source}: line {reader.line_num}"
        values = {key: _number(row[key], f"{line}: {key}") for key in wanted[1:]}
        head = {
            "insertion_m": values["insertion_m"],
            "curvature_per_m": values["curvature_per_m"],
            "force_N": [values[f"force_{axis}_N"] for axis in axes],
        }
        group = groups.setdefault(row["recording"], {**head, "markers": []})
        if any(group[key] != value for key, value in head.items()):
            raise InputError(line, head, f"the load and actuation of the other rows of recording {row['recording']}")
        group["markers"].append({"offset_m": values["offset_m"], "position_m": [values[f"{a}_m"] for a in axes]})
    return {"recordings": list(groups.values())}


def _number(text: str | None, key: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise InputError(key, text, "a number") from None
    if not math.isfinite(value):
        raise InputError(key, text, "a finite number")
    return value
