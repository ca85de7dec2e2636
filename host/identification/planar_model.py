"""The planar catheter as a function of its parameters: markers of every recording, with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from host.cli.contract_io import BadInput
from host.identification import planar_sensitivities as sensitivities
from host.identification.recorded_shapes import RecordedShape
from host.mechanics import pcar_kernels as kernels
from host.mechanics.catheter import Catheter, PcarParameters
from host.mechanics.pcar import NO_DRAG, Arcs, arcs_of

Array = NDArray[np.float64]
GROUPS = ("stiffness", "lengths", "curvature")


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted: its place in the catheter, and how it is scaled inside the search."""

    name: str
    unit: str
    start: float
    logarithmic: bool


class PlanarModel:
    """Predicts marker positions from parameters: log EI of each arc, lengths of the distal arcs but the last, and the
    unloaded curvature of each group of recordings with the same nominal curvature."""

    def __init__(self, catheter: Catheter, recordings: list[RecordedShape], fit: tuple[str, ...]) -> None:
        if catheter.pcar is None:
            raise BadInput("catheter", catheter.name, "a start catheter with [pcar] parameters")
        self.catheter, self.pcar, self.recordings = catheter, catheter.pcar, recordings
        self.arc_count = len(self.pcar.EI_N_m2)
        self.curvatures = sorted({recording.curvature_per_m for recording in recordings})
        self.parameters = self._parameters(fit)
        self._group = [self.curvatures.index(recording.curvature_per_m) for recording in recordings]
        for index, recording in enumerate(recordings):
            outside = catheter.distal_length_m + recording.insertion_m
            if not outside > 0.0:
                raise BadInput(f"recordings.{index}.insertion_m", recording.insertion_m,
                               f"more than -{catheter.distal_length_m}, the length of the distal shaft")
            if recording.offset_m.max() > outside + 1e-9:
                raise BadInput(f"recordings.{index}.markers", float(recording.offset_m.max()),
                               f"offset_m of at most {outside:.6g}, the length outside the sheath")

    def _parameters(self, fit: tuple[str, ...]) -> list[Parameter]:
        found = []
        if "stiffness" in fit:
            found += [Parameter(f"EI{i + 1}", "N m2", value, True) for i, value in enumerate(self.pcar.EI_N_m2)]
        if "lengths" in fit:
            found += [Parameter(f"l{i + 2}", "m", value, False) for i, value in enumerate(self.pcar.distal_arcs_m[:-1])]
        if "curvature" in fit:
            found += [Parameter(f"kappa0[{value:g}]", "1/m", value, False) for value in self.curvatures]
        return found

    def start(self) -> Array:
        """The search's start, in its own scale."""
        return np.array([np.log(p.start) if p.logarithmic else p.start for p in self.parameters])

    def scale(self) -> Array:
        """Natural size of a step in each parameter: a relative one for stiffness, else a part of the value."""
        floor = {"m": 0.1 * self.catheter.distal_length_m, "1/m": 5.0}
        return np.array([1.0 if p.logarithmic else max(abs(p.start), floor[p.unit]) for p in self.parameters])

    def values(self, x: Array) -> Array:
        """Parameters in SI from the search's `x`."""
        return np.array([np.exp(v) if p.logarithmic else v for p, v in zip(self.parameters, x, strict=True)])

    def catheter_at(self, x: Array) -> Catheter | None:
        """The catheter with parameters `x`; None where a length is not positive."""
        values = dict(zip([p.name for p in self.parameters], self.values(x).tolist(), strict=True))
        stiffness = tuple(values.get(f"EI{i + 1}", old) for i, old in enumerate(self.pcar.EI_N_m2))
        lengths = [values.get(f"l{i + 2}", old) for i, old in enumerate(self.pcar.distal_arcs_m[:-1])]
        lengths.append(self.catheter.distal_length_m - sum(lengths))
        if min(lengths) < 1e-4 or not np.isfinite(stiffness).all() or min(stiffness) <= 0.0:
            return None
        return replace(self.catheter, pcar=PcarParameters(stiffness, tuple(lengths)))

    def predict(self, x: Array, index: int, jacobian: bool = False) -> tuple[Array, Array] | None:
        """Markers of recording `index` (m, 2) and, if asked, their derivatives by `x` (m, 2, p); None where the load
        has no equilibrium on its branch."""
        catheter = self.catheter_at(x)
        if catheter is None:
            return None
        recording = self.recordings[index]
        values = dict(zip([p.name for p in self.parameters], self.values(x).tolist(), strict=True))
        nominal = recording.curvature_per_m
        arcs = arcs_of(catheter, recording.insertion_m, values.get(f"kappa0[{nominal:g}]", nominal))
        n = arcs.length_m.size
        work, kappa = np.empty((kernels.ROWS, n)), np.empty(n)
        status, _, _ = kernels.load_path(arcs.length_m, arcs.EI_N_m2, arcs.cubic_stiffening_m2,
                                         arcs.unloaded_curvature_per_m, recording.force_N[0], recording.force_N[1],
                                         NO_DRAG, kappa, work)
        if status != kernels.CONVERGED:
            return None
        node, turn = np.empty(n + 1, dtype=complex), np.empty(n + 1, dtype=complex)
        sensitivities.nodes_of(arcs.length_m, kappa, node, turn)
        station = np.maximum(0.0, arcs.total_length_m - recording.offset_m)
        position = np.empty((station.size, 2))
        sensitivities.marker_positions(arcs.length_m, kappa, station, node, turn, position)
        derivatives = self._derivatives(x, arcs, recording, kappa, node, turn, station, work) if jacobian else np.empty(0)
        return position, derivatives

    def _derivatives(self, x: Array, arcs: Arcs, recording: RecordedShape, kappa: Array, node: NDArray[np.complex128],
                     turn: NDArray[np.complex128], station: Array, work: Array) -> Array:
        n = arcs.length_m.size
        length_by = self._length_by(arcs, recording)
        q = length_by.shape[1]
        response, every = np.empty((n, n + q + 1)), np.empty((station.size, 2, n + q + 1))
        sensitivities.curvature_response(arcs.length_m, arcs.EI_N_m2, arcs.cubic_stiffening_m2,
                                         arcs.unloaded_curvature_per_m, arcs.distal, recording.force_N, length_by,
                                         kappa, node, turn, work, response)
        sensitivities.marker_jacobian(arcs.length_m, kappa, station, length_by, response, node, turn, every)
        columns = []
        for parameter, value in zip(self.parameters, self.values(x), strict=True):
            if parameter.logarithmic:
                columns.append(every[:, :, int(parameter.name[2:]) - 1] * value)
            elif parameter.unit == "m":
                columns.append(every[:, :, n + int(parameter.name[1:]) - 2])
            else:
                same = parameter.name == f"kappa0[{recording.curvature_per_m:g}]"
                columns.append(every[:, :, n + q] * same)
        return np.stack(columns, axis=2)

    def _length_by(self, arcs: Arcs, recording: RecordedShape) -> Array:
        """d(arc lengths outside) / d(l2, l3, ...): a distal arc grows at the cost of the last one."""
        n, q = self.arc_count, self.arc_count - 2
        by = np.zeros((n, q))
        out = arcs.length_m > 0.0
        for k in range(q):
            if out[k + 1]:
                by[k + 1, k], by[n - 1, k] = 1.0, -1.0
            elif out[1:].any():
                # all of it is in the sheath: its growth pushes the next ones out and the last one gives way
                first = int(np.argmax(out))
                by[first, k] += 1.0
                by[n - 1, k] -= 1.0
        return by
