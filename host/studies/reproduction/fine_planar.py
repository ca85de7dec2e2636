"""A planar catheter finer than the model that is judged: an elastica with stiff electrodes and an uneven pre-curvature."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

from protocol.catheter import Catheter

Array = np.ndarray
ELECTRODES_m, ELECTRODES_STIFFER = 0.008, 1.3
UNEVEN = 0.015
MARKERS = 9
MARKER_NOISE_m = 1e-4
_LOAD_STEPS = 12


class FineShape(NamedTuple):
    """A shape as it was recorded: arc lengths of the markers from the sheath's exit, their places, the tip's angle."""

    stations_m: Array  # (n,)
    markers_m: Array  # (n, 2)
    tip_angle_rad: float


def fine_shape(
    catheter: Catheter, insertion_m: float, curvature_per_m: float, force_N: Array, random: np.random.Generator | None
) -> FineShape:
    """The shape under a tip force (2,) N in the base frame, the markers with noise where `random` is given.

    The bending moment obeys m' = Fx sin(theta) - Fy cos(theta), m(tip) = 0, theta' = kappa0 + m / EI, started at the
    base and shot to the tip while the load grows.
    """
    pcar = catheter.pcar
    if pcar is None:
        raise ValueError(f"catheter: found {catheter.name} without [pcar], wanted one with it")
    total = insertion_m + catheter.distal_length_m

    def stiffness(s: float) -> float:
        along = s - insertion_m
        value = pcar.EI_N_m2[0] if along < 0 else pcar.EI_N_m2[1] if along < pcar.l2_m else pcar.EI_N_m2[2]
        return value * (ELECTRODES_STIFFER if s > total - ELECTRODES_m else 1.0)

    def unloaded(s: float) -> float:
        along = (s - insertion_m) / catheter.distal_length_m
        return 0.0 if along < 0 else curvature_per_m * (1.0 + UNEVEN * math.cos(math.pi * along))

    def derivative(s: float, y: Array, force: Array) -> list[float]:
        angle, moment = y[2], y[3]
        return [
            math.cos(angle),
            math.sin(angle),
            unloaded(s) + moment / stiffness(s),
            force[0] * math.sin(angle) - force[1] * math.cos(angle),
        ]

    breaks = [0.0, insertion_m, insertion_m + pcar.l2_m, total - ELECTRODES_m, total]
    stations = np.linspace(0.0, total, MARKERS + 1)[1:]

    def shot(moment: float, force: Array) -> tuple[Array, Array]:
        y, points = np.array([0.0, 0.0, 0.0, moment]), []
        for begin, end in itertools.pairwise(breaks):
            inside = stations[(stations > begin) & (stations <= end + 1e-12)]
            run = solve_ivp(derivative, (begin, end), y, args=(force,), rtol=1e-9, atol=1e-12, dense_output=True)
            points += [run.sol(min(s, end))[:2] for s in inside]
            y = run.y[:, -1]
        return y, np.array(points)

    moment = 0.0
    for share in np.linspace(1.0 / _LOAD_STEPS, 1.0, _LOAD_STEPS):
        load = share * np.asarray(force_N)
        found = root(lambda m, load=load: [shot(float(m[0]), load)[0][3]], [moment], tol=1e-11)
        moment = float(found.x[0])
    end, markers = shot(moment, np.asarray(force_N))
    if random is not None:
        markers = markers + random.normal(0.0, MARKER_NOISE_m, markers.shape)
    return FineShape(stations, markers, float(end[2]))
