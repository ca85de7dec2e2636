"""The numbers a calibration searches: their names, units, starts, and their scale inside the search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from host.identification.recorded_shapes import RecordedShape
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CatheterParameter:
    """One number that is fitted; a logarithmic one is searched by its logarithm, which keeps it positive."""

    name: str
    unit: str
    start: float
    logarithmic: bool


class ParametricModel:
    """What the planar and the spatial model share: parameters and the check of the recordings."""

    def __init__(self, catheter: Catheter, recordings: list[RecordedShape], parameters: list[CatheterParameter]) -> None:
        self.catheter, self.recordings, self.parameters = catheter, recordings, parameters
        for index, recording in enumerate(recordings):
            outside = catheter.distal_length_m + recording.insertion_m
            if not outside > 0.0:
                raise InputError(
                    f"recordings.{index}.insertion_m",
                    recording.insertion_m,
                    f"more than -{catheter.distal_length_m}, the length of the distal shaft",
                )
            if recording.offset_m.max() > outside + 1e-9:
                raise InputError(
                    f"recordings.{index}.markers",
                    float(recording.offset_m.max()),
                    f"offset_m of at most {outside:.6g}, the length outside the sheath",
                )

    def start(self) -> Array:
        """The search's start, in its own scale."""
        return np.array([np.log(p.start) if p.logarithmic else p.start for p in self.parameters])

    def scale(self) -> Array:
        """Natural size of a step in each parameter: a relative one for stiffness, else a part of the value."""
        smallest = {"m": 0.1 * self.catheter.distal_length_m, "1/m": 5.0}
        return np.array([1.0 if p.logarithmic else max(abs(p.start), smallest[p.unit]) for p in self.parameters])

    def values(self, x: Array) -> dict[str, float]:
        """Parameters by name, SI, from the search's `x`."""
        return {p.name: float(np.exp(v)) if p.logarithmic else float(v) for p, v in zip(self.parameters, x, strict=True)}

    def curvature(self, values: dict[str, float], recording: RecordedShape) -> float:
        """Unloaded curvature (1/m) of a recording: the fitted one of its nominal curvature, else the nominal one."""
        return values.get(curvature_name(recording.curvature_per_m), recording.curvature_per_m)


def curvature_name(nominal_per_m: float) -> str:
    """Name of the parameter that stands for all recordings of one nominal curvature."""
    return f"kappa0[{nominal_per_m:g}]"


def curvature_parameters(recordings: list[RecordedShape]) -> list[CatheterParameter]:
    """One unloaded curvature for each nominal curvature among the recordings."""
    nominal = sorted({recording.curvature_per_m for recording in recordings})
    return [CatheterParameter(curvature_name(value), "1/m", value, False) for value in nominal]
