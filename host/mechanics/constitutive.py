"""Pull-wire friction and stiffening (8.1.1) as optional terms: the wire sticks and slips, and the shape shows a loop.

Along a bent sheath a wire's tension may differ from its neighbour's by the capstan factor exp(mu |turning|) either way;
within that band it keeps what it had. Each arc bends by its own tension, kappa0 = T e / EI. The stiffening term is
`cubic_stiffening_m2` of the catheter: M = EI d (1 + c d^2) with d = kappa - kappa0, inside the kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from host.mechanics.pcar import Arcs, Equilibrium, arcs_of, solve
from host.mechanics.rotations import rotation_matrix
from protocol.catheter import Catheter

Array = NDArray[np.float64]

ROUNDS = 60
TOLERANCE = 1e-12  # relative change of the tensions between rounds


@njit(cache=True, nogil=True, error_model="numpy")
def stick_or_slip(tension_N: float, turning: Array, friction: float, kept: Array, result: Array) -> None:
    """Tension at each element of a wire pulled with `tension_N` at its near end.

    Arguments: `turning` (n,) rad between an element and the one before (>= 0); `friction`, the coefficient mu; `kept`
    (n,) N, the tensions before. Writes `result` (n,) N: the kept value, or the edge of the capstan's band.
    """
    upstream = tension_N
    for i in range(turning.size):
        factor = math.exp(friction * turning[i])
        upstream = min(max(kept[i], upstream / factor), upstream * factor)
        result[i] = upstream


@dataclass(frozen=True)
class WireEquilibrium:
    """A static shape with the tension of the wire along the distal shaft, the state of the next step."""

    equilibrium: Equilibrium
    arcs: Arcs
    tension_N: Array  # (n,) one per arc; that of the body is the tension which enters the shaft


class FrictionalWire:
    """A catheter whose pull-wire rubs in its sheath: call `step` along the history of tension and load."""

    def __init__(
        self, catheter: Catheter, insertion_m: float, body_turning_rad: float = 0.0, longest_arc_m: float = math.inf
    ) -> None:
        """`body_turning_rad`: total bend of the body on its way from the handle, which takes its share of tension.

        Raises: ValueError where the catheter has no [constitutive] or no [pcar] parameters.
        """
        if catheter.constitutive is None or catheter.pcar is None:
            raise ValueError(f"catheter: found {catheter.name} without friction, wanted [constitutive] and [pcar]")
        if not 0.0 <= body_turning_rad < math.inf:
            raise ValueError(f"body_turning_rad: found {body_turning_rad}, wanted 0 or more")
        self._catheter = catheter
        self._friction = catheter.constitutive.friction_coefficient
        self._arcs = arcs_of(catheter, insertion_m, 0.0, longest_arc_m)
        self._body_turning_rad = body_turning_rad
        self._tension_N = np.zeros(self._arcs.length_m.size)

    def step(self, tension_N: float, force_N: ArrayLike = (0.0, 0.0)) -> WireEquilibrium:
        """The shape after the tension at the handle and the tip force went to these values without turning back.

        Raises: ValueError. Where the statics do not converge the wire keeps its former tensions.
        """
        if not 0.0 <= tension_N < math.inf:
            raise ValueError(f"tension_N: found {tension_N}, wanted 0 or more")
        tensions, last = self._tension_N, np.full(self._tension_N.size, math.inf)
        for _ in range(ROUNDS):
            arcs = self._bent_by(tensions)
            found = solve(arcs, force_N)
            if not found.converged:
                return WireEquilibrium(found, arcs, self._tension_N)
            tensions = np.empty_like(self._tension_N)
            stick_or_slip(tension_N, self._turning(arcs, found), self._friction, self._tension_N, tensions)
            if float(np.abs(tensions - last).max()) <= TOLERANCE * max(tension_N, 1e-3):
                break
            last = tensions
        self._tension_N = tensions
        return WireEquilibrium(found, arcs, tensions)

    def _bent_by(self, tension_N: Array) -> Arcs:
        curvature = tension_N * self._catheter.pull_wire_offset_m / self._arcs.EI_N_m2
        return replace(self._arcs, unloaded_curvature_per_m=np.where(self._arcs.distal, curvature, 0.0))

    def _turning(self, arcs: Arcs, found: Equilibrium) -> Array:
        """Between the middles of neighbouring arcs; the first of the distal shaft also has the body's bend before it."""
        own = np.abs(found.curvature_per_m) * arcs.length_m
        own[0] += self._body_turning_rad
        middle = np.where(arcs.distal, 0.5 * own, 0.0)
        before = np.concatenate([[0.0], np.where(arcs.distal[:-1], 0.5 * own[:-1], 0.0)])
        return np.where(arcs.distal, middle + before, own)


def hysteresis_loop(
    catheter: Catheter,
    insertion_m: float,
    tension_N: ArrayLike,
    force_N: ArrayLike = (0.0, 0.0),
    body_turning_rad: float = 0.0,
    longest_arc_m: float = math.inf,
) -> tuple[Array, Array]:
    """Tip angle and tip tension along a history of handle tension.

    Arguments: `tension_N` (k,) handle tensions in order; `force_N` (2,) constant tip force. Result: tip angle (k,) rad,
    tension in the last arc (k,) N. Raises: ValueError, also where a step has no equilibrium.
    """
    wire = FrictionalWire(catheter, insertion_m, body_turning_rad, longest_arc_m)
    history = np.asarray(tension_N, dtype=float)
    angle, tension = np.empty(history.size), np.empty(history.size)
    for k, value in enumerate(history):
        step = wire.step(float(value), force_N)
        if not step.equilibrium.converged:
            raise ValueError(f"tension_N: found {value} N at step {k} without an equilibrium, wanted a smaller load")
        angle[k], tension[k] = step.equilibrium.tip_angle_rad, step.tension_N[-1]
    return angle, tension


class FrictionalRod:
    """The spatial counterpart of `FrictionalWire`: the rod of chapter 3 with a pull-wire that rubs in its sheath.

    The rod has one unloaded curvature along the distal shaft. Here that is the mean of what the tensions along the wire
    give, kappa0 = mean(T) e / EI1 (3.2.3), which is right to first order in the friction.
    """

    def __init__(self, catheter: Catheter, insertion_m: float, body_turning_rad: float = 0.0, elements: int = 10) -> None:
        """`body_turning_rad` as in `FrictionalWire`; `elements` of the distal shaft that have a tension of their own.

        Raises: ValueError where the catheter has no [constitutive] or no [cosserat] parameters.
        """
        if catheter.constitutive is None or catheter.cosserat is None:
            raise ValueError(f"catheter: found {catheter.name} without friction, wanted [constitutive] and [cosserat]")
        if not 0.0 <= body_turning_rad < math.inf:
            raise ValueError(f"body_turning_rad: found {body_turning_rad}, wanted 0 or more")
        self._catheter, self._insertion_m = catheter, insertion_m
        self._friction, self._body_turning_rad = catheter.constitutive.friction_coefficient, body_turning_rad
        self._gain = catheter.pull_wire_offset_m / catheter.cosserat.EI1
        self._exposed_m = catheter.distal_length_m + min(insertion_m, 0.0)
        self._places = self._exposed_m * (1.0 - (np.arange(elements) + 0.5) / elements)  # middles, back from the tip
        self._tension_N = np.zeros(elements)

    def step(self, tension_N: float, force_N: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[CosseratSolution, Array]:
        """The shape and the tensions (n,) after handle tension and tip force (3,), base frame, went to these values.

        Raises: ValueError. Where the statics do not converge the wire keeps its former tensions.
        """
        if not 0.0 <= tension_N < math.inf:
            raise ValueError(f"tension_N: found {tension_N}, wanted 0 or more")
        tensions, last = self._tension_N, np.full(self._tension_N.size, math.inf)
        for _ in range(ROUNDS):
            curvature = float(np.mean(tensions)) * self._gain
            found = solve_cosserat(
                self._catheter, self._insertion_m, curvature, force_N, stations_m=[self._exposed_m, *self._places]
            )
            if not found.converged:
                return found, self._tension_N
            tensions = np.empty_like(self._tension_N)
            stick_or_slip(tension_N, self._turning(found), self._friction, self._tension_N, tensions)
            if float(np.abs(tensions - last).max()) <= TOLERANCE * max(tension_N, 1e-3):
                break
            last = tensions
        self._tension_N = tensions
        return found, tensions

    def _turning(self, found: CosseratSolution) -> Array:
        """Angle between the shaft's directions at neighbouring places; the first has the body's bend before it."""
        directions = np.array([rotation_matrix(q)[:, 2] for q in found.station_quaternions_wxyz])
        cosines = np.sum(directions[1:] * directions[:-1], axis=1)
        turning = np.arccos(np.clip(cosines, -1.0, 1.0))
        turning[0] += self._body_turning_rad
        return turning
