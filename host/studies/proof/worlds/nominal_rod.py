"""Nominal model of the catheter in contact: the rod of `host.mechanics` under the recorded force."""

from __future__ import annotations

import numpy as np
from numba import njit

from host.mechanics.base_force import solve_cold, solve_warm
from host.mechanics.branch import CONVERGED
from host.mechanics.cosserat_kernels import EXACT, ROW, WORK

Array = np.ndarray
DISTAL_M, TORSION_TO_BENDING = 0.110, 0.77


@njit(cache=True)
def _tips(p: Array, handle: Array, force: Array, out: Array) -> None:
    """Write tip positions (n, 3). p: insertion offset, roll slope, knob gain, EI; handle, force on the tip: (n, 3)."""
    x, rows, work, stations = np.zeros(3), np.zeros((1, ROW)), np.zeros(WORK), np.zeros(0)
    soft, turned = 1.0 / p[3], np.zeros(3)
    rod = np.array([soft, soft, soft / TORSION_TO_BENDING, soft, soft, soft / TORSION_TO_BENDING, 0.0, 0.0, 0.0])
    for i in range(handle.shape[0]):
        rod[6] = max(DISTAL_M + handle[i, 0] + p[0], 1e-3)
        rod[8] = p[2] * handle[i, 2]
        roll = p[1] * handle[i, 1]
        c, s = np.cos(roll), np.sin(roll)
        turned[0], turned[1], turned[2] = c * force[i, 0] + s * force[i, 1], -s * force[i, 0] + c * force[i, 1], force[i, 2]
        if not solve_warm(rod, turned, stations, EXACT, x, rows, work)[0]:
            if solve_cold(rod, turned, stations, EXACT, x, rows, work)[0] != CONVERGED:
                out[i] = np.nan
                continue
        out[i, 0] = -(c * rows[0, 0] - s * rows[0, 1])
        out[i, 1] = -(s * rows[0, 0] + c * rows[0, 1])
        out[i, 2] = -rows[0, 2]


NAMES = ("insertion_offset_m", "roll_slope", "knob_gain_per_m_rad", "bending_stiffness_Nm2")


def tips(inputs: dict[str, Array], parameters: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Return tip positions (n,) m in the base frame.

    Args:
        inputs: `insertion_m`, `roll_rad`, `knob_rad`, and `force_x_N`, `force_y_N`, `force_z_N` on the tip, (n,) each.
        parameters: those of NAMES.
        time_s: (n,) s; the rod is static.
    """
    handle = np.column_stack([inputs["insertion_m"], inputs["roll_rad"], inputs["knob_rad"]])
    force = np.column_stack([inputs["force_x_N"], inputs["force_y_N"], inputs["force_z_N"]])
    out = np.empty((time_s.size, 3))
    _tips(np.array([parameters[name] for name in NAMES]), handle, force, out)
    return {"tip_x_m": out[:, 0], "tip_y_m": out[:, 1], "tip_z_m": out[:, 2]}
