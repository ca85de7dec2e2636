"""Marker positions of a loaded planar shape and their exact derivatives by stiffness, length and curvature."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics import pcar_kernels as kernels
from host.mechanics.arc_integrals import phi
from host.mechanics.pcar_kernels import Load, Shaft

Array = NDArray[np.float64]


class PlanarShape(NamedTuple):
    """Arcs laid out in the plane, x + iy."""

    length: Array  # (n,) m
    kappa: Array  # (n,) 1/m
    node: NDArray[np.complex128]  # (n + 1,) ends of the arcs, m
    turn: NDArray[np.complex128]  # (n + 1,) directions there, exp(i angle)


@njit(cache=True, nogil=True, error_model="numpy")
def shape_of(length: Array, kappa: Array) -> PlanarShape:
    """Lay out the arcs of these lengths (m) and curvatures (1/m), each (n,), from the sheath's exit."""
    n = length.size
    node, turn = np.empty(n + 1, dtype=np.complex128), np.empty(n + 1, dtype=np.complex128)
    node[0], turn[0] = 0.0 + 0.0j, 1.0 + 0.0j
    for i in range(length.size):
        re0, im0, _, _, _, _, cosine, sine = phi(kappa[i] * length[i])
        node[i + 1] = node[i] + length[i] * turn[i] * complex(re0, im0)
        turn[i + 1] = turn[i] * complex(cosine, sine)
    return PlanarShape(length, kappa, node, turn)


@njit(cache=True, nogil=True, error_model="numpy")
def station_of(length: Array, station: float) -> tuple[int, float]:
    """Index of the arc that bears arc length `station` from the base, and how far into it."""
    before = 0.0
    last = 0
    for i in range(length.size):
        if length[i] > 0.0:
            last = i
            if station <= before + length[i]:
                return i, station - before
        before += length[i]
    return last, length[last]


@njit(cache=True, nogil=True, error_model="numpy")
def curvature_response(
    shaft: Shaft,
    external: Load,
    distal: NDArray[np.bool_],
    length_by: Array,
    shape: PlanarShape,
    work: Array,
    response: Array,
) -> None:
    """Differentiate the curvatures of the equilibrium `shape` by the parameters: `response` (n, n + q + 1), written.

    Parameters: EI of each arc (n), the q length parameters whose columns are `length_by` (n, q), the unloaded
    curvature of the `distal` arcs (1). Source: the static equations (2.8), differentiated.
    """
    n, q = length_by.shape
    length, EI, cubic, kappa0 = shaft.length, shaft.EI, shaft.cubic, shaft.kappa0
    kappa, node, turn = shape.kappa, shape.node, shape.turn
    kernels.evaluate(length, kappa, external, 1.0, work)
    kernels.factorize(shaft, kappa, work)
    conjugate = complex(external.force_x, -external.force_y)
    tip = node[n]
    for p in range(n + q + 1):
        for i in range(n):
            delta = kappa[i] - kappa0[i]
            value = 0.0
            if p < n:
                value = -delta * (1.0 + cubic[i] * delta * delta) if p == i else 0.0
            elif p == n + q:
                value = EI[i] * (1.0 + 3.0 * cubic[i] * delta * delta) if distal[i] else 0.0
            else:
                _, _, re1, im1, re2, im2, _, _ = phi(kappa[i] * length[i])
                phi1, phi2 = complex(re1, im1), complex(re2, im2)
                arm = length[i] * turn[i] * phi1 + tip - node[i + 1]
                change = 0.0 + 0.0j
                for k in range(n):
                    moved = length_by[k, p - n]
                    if moved == 0.0:
                        continue
                    beyond = 1j * kappa[k] * (tip - node[k + 1])
                    if k < i:
                        change += moved * 1j * kappa[k] * arm
                    elif k == i:
                        change += moved * (turn[i] * (phi1 + 1j * kappa[i] * length[i] * phi2) + beyond)
                    else:
                        change += moved * (turn[k + 1] + beyond)
                value = (conjugate * 1j * change).real
            work[kernels.STEP, i] = value
        kernels.back_substitute(length, work, kernels.STEP)
        response[:, p] = work[kernels.STEP]


@njit(cache=True, nogil=True, error_model="numpy")
def marker_positions(shape: PlanarShape, station: Array, position: Array) -> None:
    """Positions (m, 2), written, of the points at arc lengths `station` (m,) from the base."""
    length, kappa, node, turn = shape.length, shape.kappa, shape.node, shape.turn
    for j in range(station.size):
        arc, part = station_of(length, station[j])
        re0, im0, _, _, _, _, _, _ = phi(kappa[arc] * part)
        point = node[arc] + part * turn[arc] * complex(re0, im0)
        position[j, 0], position[j, 1] = point.real, point.imag


@njit(cache=True, nogil=True, error_model="numpy")
def marker_jacobian(shape: PlanarShape, station: Array, length_by: Array, response: Array, jacobian: Array) -> None:
    """Derivatives (m, 2, n + q + 1) of the marker positions; arguments as above. The markers stay at their arc length."""
    length, kappa, node, turn = shape.length, shape.kappa, shape.node, shape.turn
    n, q = length_by.shape
    for j in range(station.size):
        arc, part = station_of(length, station[j])
        re0, im0, re1, im1, _, _, cosine, sine = phi(kappa[arc] * part)
        point = node[arc] + part * turn[arc] * complex(re0, im0)
        ahead = turn[arc] * complex(cosine, sine)
        for p in range(n + q + 1):
            change = 1j * part * part * turn[arc] * complex(re1, im1) * response[arc, p]
            for i in range(arc):
                _, _, own_re, own_im, _, _, _, _ = phi(kappa[i] * length[i])
                lever = length[i] * turn[i] * complex(own_re, own_im) + point - node[i + 1]
                change += 1j * length[i] * lever * response[i, p]
                if n <= p < n + q:
                    grown = turn[i + 1] + 1j * kappa[i] * (point - node[i + 1]) - ahead
                    change += length_by[i, p - n] * grown
            jacobian[j, 0, p], jacobian[j, 1, p] = change.real, change.imag
