"""The planar catheter as a function of its parameters: markers of every recording, with exact derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from host.identification import planar_sensitivities as sensitivities
from host.identification.parameters import CatheterParameter, ParametricModel, curvature_name, curvature_parameters
from host.identification.recorded_shapes import RecordedShape
from host.mechanics import pcar_kernels as kernels
from host.mechanics.pcar import NO_DRAG, Arcs, arcs_of
from protocol.catheter import Catheter, PcarParameters
from protocol.errors import InputError

Array = NDArray[np.float64]
GROUPS = ("stiffness", "lengths", "curvature")


class PlanarModel(ParametricModel):
    """Predicts marker positions from parameters: log EI of each arc, lengths of the distal arcs but the last, and the
    unloaded curvature of each group of recordings with the same nominal curvature.
    """

    def __init__(self, catheter: Catheter, recordings: list[RecordedShape], fit: tuple[str, ...]) -> None:
        if catheter.pcar is None:
            raise InputError("catheter", catheter.name, "a start catheter with [pcar] parameters")
        self.pcar = catheter.pcar
        self.arc_count = len(self.pcar.EI_N_m2)
        found = []
        if "stiffness" in fit:
            found += [CatheterParameter(f"EI{i + 1}", "N m2", value, True) for i, value in enumerate(self.pcar.EI_N_m2)]
        if "lengths" in fit:
            found += [
                CatheterParameter(f"l{i + 2}", "m", value, False) for i, value in enumerate(self.pcar.distal_arcs_m[:-1])
            ]
        if "curvature" in fit:
            found += curvature_parameters(recordings)
        super().__init__(catheter, recordings, found)

    def catheter_at(self, x: Array) -> Catheter | None:
        """The catheter with parameters `x`; None where a length is not positive."""
        values = self.values(x)
        stiffness = tuple(values.get(f"EI{i + 1}", old) for i, old in enumerate(self.pcar.EI_N_m2))
        lengths = [values.get(f"l{i + 2}", old) for i, old in enumerate(self.pcar.distal_arcs_m[:-1])]
        lengths.append(self.catheter.distal_length_m - sum(lengths))
        if min(lengths) < 1e-4 or not np.isfinite(stiffness).all() or min(stiffness) <= 0.0:
            return None
        return replace(self.catheter, pcar=PcarParameters(stiffness, tuple(lengths)))

    def predict(self, x: Array, index: int, jacobian: bool = False) -> tuple[Array, Array] | None:
        """Markers of recording `index` (m, 2) and, if asked, their derivatives by `x` (m, 2, p); None where the load
        has no equilibrium on its branch.
        """
        catheter = self.catheter_at(x)
        if catheter is None:
            return None
        recording = self.recordings[index]
        arcs = arcs_of(catheter, recording.insertion_m, self.curvature(self.values(x), recording))
        n = arcs.length_m.size
        work, kappa = np.empty((kernels.ROWS, n)), np.empty(n)
        external = kernels.Load(float(recording.force_N[0]), float(recording.force_N[1]), NO_DRAG)
        status, _, _ = kernels.load_path(arcs.shaft, external, kappa, work)
        if status != kernels.CONVERGED:
            return None
        shape = sensitivities.shape_of(arcs.length_m, kappa)
        station = np.maximum(0.0, arcs.total_length_m - recording.offset_m)
        position = np.empty((station.size, 2))
        sensitivities.marker_positions(shape, station, position)
        derivatives = self._derivatives(x, arcs, recording, shape, station) if jacobian else np.empty(0)
        return position, derivatives

    def _derivatives(
        self, x: Array, arcs: Arcs, recording: RecordedShape, shape: sensitivities.PlanarShape, station: Array
    ) -> Array:
        n = arcs.length_m.size
        length_by = self._length_by(arcs)
        q = length_by.shape[1]
        response, every = np.empty((n, n + q + 1)), np.empty((station.size, 2, n + q + 1))
        external = kernels.Load(float(recording.force_N[0]), float(recording.force_N[1]), NO_DRAG)
        work = np.empty((kernels.ROWS, n))
        sensitivities.curvature_response(arcs.shaft, external, arcs.distal, length_by, shape, work, response)
        sensitivities.marker_jacobian(shape, station, length_by, response, every)
        columns = []
        values = self.values(x)
        for parameter in self.parameters:
            if parameter.logarithmic:
                columns.append(every[:, :, int(parameter.name[2:]) - 1] * values[parameter.name])
            elif parameter.unit == "m":
                columns.append(every[:, :, n + int(parameter.name[1:]) - 2])
            else:
                same = parameter.name == curvature_name(recording.curvature_per_m)
                columns.append(every[:, :, n + q] * same)
        return np.stack(columns, axis=2)

    def _length_by(self, arcs: Arcs) -> Array:
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
