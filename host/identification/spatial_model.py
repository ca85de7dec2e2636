"""The spatial catheter as a function of its parameters: markers of every recording, with central differences.

As in section 3.3: bending stiffness both ways for shaft and body, and torsion by GJ = 0.3846 (EI1 + EI2) (Poisson's ratio
0.3) unless `torsion` is fitted by itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from host.identification.parameters import CatheterParameter, ParametricModel, curvature_parameters
from host.identification.recorded_shapes import RecordedShape
from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from protocol.catheter import Catheter, CosseratParameters
from protocol.errors import InputError

Array = NDArray[np.float64]
GROUPS = ("stiffness", "torsion", "curvature")

TORSION_SHARE = 0.3846  # 1 / (2 (1 + 0.3))
STEP = 2e-3  # of a parameter's scale, for the differences
BENDING, TORSION = ("EI1", "EI2", "EbI1", "EbI2"), ("GJ", "GbJ")


class SpatialModel(ParametricModel):
    """Predicts marker positions (m, 3) from the logarithms of the rod's stiffness, and unloaded curvatures."""

    def __init__(self, catheter: Catheter, recordings: list[RecordedShape], fit: tuple[str, ...]) -> None:
        if catheter.cosserat is None:
            raise InputError("catheter", catheter.name, "a start catheter with [cosserat] parameters")
        self.rod = catheter.cosserat
        names = (BENDING if "stiffness" in fit else ()) + (TORSION if "torsion" in fit else ())
        found = [CatheterParameter(name, "N m2", getattr(self.rod, name), True) for name in names]
        if "curvature" in fit:
            found += curvature_parameters(recordings)
        super().__init__(catheter, recordings, found)

    def catheter_at(self, x: Array) -> Catheter | None:
        """The catheter with parameters `x`; None where one has left all bounds."""
        values = self.values(x)
        stiffness = {**vars(self.rod), **{name: values[name] for name in (*BENDING, *TORSION) if name in values}}
        if "EI1" in values and "GJ" not in values:
            stiffness["GJ"] = TORSION_SHARE * (stiffness["EI1"] + stiffness["EI2"])
            stiffness["GbJ"] = TORSION_SHARE * (stiffness["EbI1"] + stiffness["EbI2"])
        if not all(1e-9 < value < 1.0 for value in stiffness.values()):
            return None
        return replace(self.catheter, cosserat=CosseratParameters(**stiffness))

    def predict(self, x: Array, index: int, jacobian: bool = False) -> tuple[Array, Array] | None:
        """Markers of recording `index` (m, 3) and, if asked, their derivatives by `x` (m, 3, p); None where the load
        has no equilibrium on its branch.
        """
        here = self._solve(x, index, None)
        if here is None:
            return None
        if not jacobian:
            return here.station_positions_m, np.empty(0)
        columns = []
        for p, size in enumerate(STEP * self.scale()):
            shift = np.zeros(x.size)
            shift[p] = size
            sides = [self._solve(x + side * shift, index, here) for side in (-1.0, 1.0)]
            if sides[0] is None or sides[1] is None:
                return None
            columns.append((sides[1].station_positions_m - sides[0].station_positions_m) / (2.0 * size))
        return here.station_positions_m, np.stack(columns, axis=2)

    def _solve(self, x: Array, index: int, start: CosseratSolution | None) -> CosseratSolution | None:
        catheter, recording = self.catheter_at(x), self.recordings[index]
        if catheter is None:
            return None
        found = solve_cosserat(
            catheter,
            recording.insertion_m,
            self.curvature(self.values(x), recording),
            recording.force_N,
            stations_m=recording.offset_m,
            start=start,
        )
        return found if found.converged else None
