"""Piecewise helical model (8.1.1): a few segments of constant curvature and torsion, force in the base frame.

Where it beats the rod, and where not, with figures: docs/conventions.md; `tests/host/test_helical.py` holds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from host.mechanics.helical_kernels import load_up, screw
from host.mechanics.rod import checked_force, rod_record
from host.mechanics.rotations import quaternion_of_matrix
from host.mechanics.tip_shooting import UNIQUE_BELOW, load_number
from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

MOST_SEGMENTS = 64


@dataclass(frozen=True)
class HelicalSolution:
    """Equilibrium of the chain. Not converged: the tip pose is NaN."""

    converged: bool
    tip_position_m: Array  # (3,) base frame
    tip_quaternion_wxyz: Array  # (4,)
    segment_lengths_m: Array  # (n,) base to tip
    curvatures_per_m: Array  # (n, 3) about the segment's own d1, d2, d3
    iterations: int
    load_reached: float
    unstable_modes: int


def solve_helical(
    catheter: Catheter, insertion_m: float, curvature_per_m: float, force_N: ArrayLike, segments: int = 4
) -> HelicalSolution:
    """Shape under a tip force in the base frame, on the branch from the unloaded shape.

    Arguments: insertion_m, curvature_per_m as in `solve_cosserat`; force_N (3,); segments, in proportion to length, at
    least one each for body and shaft. Error of the tip falls with the square of their number.
    Raises: InputError naming the key. Source: 8.1.1; virtual work as (2.6) to (2.13), with torsion.
    """
    rod = rod_record(catheter, insertion_m, curvature_per_m)
    if isinstance(segments, bool) or not isinstance(segments, int) or not 1 <= segments <= MOST_SEGMENTS:
        raise InputError("segments", segments, f"a whole number from 1 to {MOST_SEGMENTS}")
    force = checked_force("force_N", force_N, rod)
    chain = chain_of(rod, segments)
    u = np.empty((len(chain), 3))
    first = min(1.0, UNIQUE_BELOW / max(load_number(rod, float(np.linalg.norm(force))), 1e-12))
    converged, reached, passes, unstable = load_up(chain, force, first, u)
    position, quaternion = tip_of(chain, u) if converged else (np.full(3, np.nan), np.full(4, np.nan))
    return HelicalSolution(converged, position, quaternion, chain[:, 0].copy(), u, passes, reached, unstable)


def chain_of(rod: Array, segments: int) -> Array:
    """Segments (n, 5) base to tip: length m, stiffness about d1, d2, d3 in N m2, natural curvature 1/m."""
    shaft, body = float(rod[6]), float(rod[7])
    in_body = 0 if body == 0.0 else max(1, round(segments * body / (shaft + body)))
    in_shaft = max(1, segments - in_body)
    rows = [[body / in_body, *(1.0 / rod[3:6]), 0.0]] * in_body if in_body else []
    return np.array(rows + [[shaft / in_shaft, *(1.0 / rod[0:3]), rod[8]]] * in_shaft)


def tip_of(chain: Array, u: Array) -> tuple[Array, Array]:
    """Tip position (3,) and quaternion (4,) of the segments (n, 5) with curvatures u (n, 3)."""
    R, r, S, p = np.eye(3), np.zeros(3), np.empty((3, 3)), np.empty(3)
    for segment, bend in zip(chain, u, strict=True):
        screw(bend, segment[0], S, p)
        r, R = r + R @ p, R @ S
    return r, quaternion_of_matrix(R)
