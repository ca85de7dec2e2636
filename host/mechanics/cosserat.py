"""Kirchhoff rod model of the catheter: its shape under a tip force given in the tip frame or in the base frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics.catheter import Catheter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointLoad:
    """A point force on the rod. `offset_m`: arc length back from the tip; `frame`: "base" or "body" (turns with the rod there)."""

    offset_m: float
    force_N: ArrayLike
    frame: str = "base"


@dataclass(frozen=True)
class CosseratSolution:
    """Shape of the catheter and what is known about the equilibrium (see `solve_cosserat`)."""

    converged: bool
    reason: str  # "converged", "fold", "iterations", ...
    tip_position_m: Array  # (3,)
    tip_quaternion_wxyz: Array  # (4,)
    station_positions_m: Array  # (n, 3)
    station_quaternions_wxyz: Array  # (n, 4)
    force_tip_N: Array  # (3,)
    force_base_N: Array  # (3,)
    iterations: int
    load_steps: int
    load_reached: float  # 1.0 when converged; else the share of the load at which the branch ends
    branch: str  # "unloaded" (continuous with the unloaded shape), "warm" (continuous with `start`), "none"
    stable: bool
    unstable_modes: int
    base_force_N: Array  # (3,) force of the rod on the sheath's exit, base frame, tendon included
    base_moment_Nm: Array  # (3,)
    jacobian_force: Array  # (6, 3) d(tip position, tip rotation; base frame) / d(force in the frame it was given in)
    jacobian_actuation: Array  # (6, 3) the same by insertion (m), roll (rad), curvature (1/m), force held in its frame


def solve_cosserat(
    catheter: Catheter,
    insertion_m: float,
    curvature_per_m: float,
    force_N: ArrayLike = (0.0, 0.0, 0.0),
    force_frame: str = "base",
    tendon_tension_N: float = 0.0,
    stations_m: Sequence[float] | Array = (),
    *,
    roll_rad: float = 0.0,
    point_loads: Sequence[PointLoad] = (),
    distributed_N_per_m: ArrayLike | None = None,
    start: CosseratSolution | None = None,
) -> CosseratSolution:
    """Signature fixed; the body follows. Raises ValueError("key: found X, wanted Y") for bad input."""
    raise NotImplementedError
