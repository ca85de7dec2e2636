"""The catheter's shape for pictures: the planar twin at the commanded joints and the force, led through the tracked tip."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.mechanics.pcar import arcs_of, shape, solve
from protocol.catheter import Catheter, ConstitutiveParameters, PcarParameters

Array = NDArray[np.float64]

POINTS = 24
LONGEST_ARC_m = 0.0056
# Further off than this the twin and the tracker are not of the same catheter: drawn apart, so that it is seen.
LARGEST_CORRECTION_m = 0.01


class Shape(NamedTuple):
    """points_m (n, 3) from the sheath's exit to the tip, base frame; gap_m from the twin's tip to the tracked one."""

    points_m: Array
    gap_m: float | None


def catheter_of(parameters: Mapping[str, Any]) -> Catheter | None:
    """The catheter that a recording's header describes (`dataclasses.asdict` of one); None where that is too little."""
    pcar, constitutive = parameters.get("pcar"), parameters.get("constitutive")
    if not pcar:
        return None
    try:
        return Catheter(
            **{
                **parameters,
                "pcar": PcarParameters(tuple(pcar["EI_N_m2"]), tuple(pcar["distal_arcs_m"])),
                "cosserat": None,
                "constitutive": ConstitutiveParameters(**constitutive) if constitutive else None,
            }
        )
    except (TypeError, KeyError):
        return None


def twin(
    catheter: Catheter, insertion_m: float, roll_rad: float, curvature_per_m: float, force_N: Sequence[float] | None
) -> Array | None:
    """The static shape, (POINTS, 3) m in the base frame; None where nothing is outside or no shape bears the force.

    force_N: (3,) of the tip on the tissue, base frame; None for none. Source: chapter 2, by `host.mechanics.pcar`.
    """
    # The bending plane: positive curvature bends towards -e2 at roll 0.
    across = np.array([math.sin(roll_rad), -math.cos(roll_rad), 0.0])
    load = np.zeros(2) if force_N is None else -np.array([force_N[2], float(np.dot(force_N, across))])
    try:
        arcs = arcs_of(catheter, insertion_m, curvature_per_m, LONGEST_ARC_m)
        found = solve(arcs, load)
        if not found.converged:
            found = solve(arcs, np.zeros(2))
        plane = shape(arcs, found.curvature_per_m, POINTS)
    except ValueError:
        return None
    return np.outer(plane[:, 0], [0.0, 0.0, 1.0]) + np.outer(plane[:, 1], across)


def through(points_m: Array, tip_m: Sequence[float] | None) -> Shape:
    """`points_m` bent, most at the tip, so that they end at `tip_m` where that is near; the gap is always returned."""
    if tip_m is None:
        return Shape(points_m, None)
    off = np.asarray(tip_m, dtype=float) - points_m[-1]
    gap_m = float(np.linalg.norm(off))
    if gap_m > LARGEST_CORRECTION_m:
        return Shape(points_m, gap_m)
    share = np.linspace(0.0, 1.0, len(points_m)) ** 2
    return Shape(points_m + share[:, None] * off, gap_m)
