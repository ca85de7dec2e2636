"""The peer for base-frame forces: the rod as a boundary value problem for scipy's collocation solver."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

Array = NDArray[np.float64]

NODES, MOST_NODES = 20, 1000


def _columns(rod: Array, force: Array) -> Any:
    c, k0, F = rod[:3, None], rod[8], force

    def rates(_s: Array, y: Array) -> Array:
        q0, q1, q2, q3 = y[3:7]
        m = y[7:10]
        R = np.array(
            [
                [1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)],
                [2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)],
                [2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)],
            ]
        )
        n = np.einsum("jik,j->ik", R, F)
        u = c * m
        u[0] += k0
        turn = 0.5 * np.array(
            [
                -q1 * u[0] - q2 * u[1] - q3 * u[2],
                q0 * u[0] + q2 * u[2] - q3 * u[1],
                q0 * u[1] + q3 * u[0] - q1 * u[2],
                q0 * u[2] + q1 * u[1] - q2 * u[0],
            ]
        )
        bend = np.cross(m, u, axis=0) + np.array([n[1], -n[0], np.zeros_like(n[0])])
        return np.concatenate([R[:, 2], turn, bend])

    return rates


def _ends(base: Array, tip: Array) -> Array:
    return np.concatenate([base[:3], base[3:7] - [1.0, 0.0, 0.0, 0.0], tip[7:10]])


def unloaded(rod: Array) -> tuple[Array, Array]:
    """Mesh (n,) and states (10, n) of the unloaded shaft, where a cold solution starts."""
    s = np.linspace(0.0, rod[6], NODES)
    angle = rod[8] * s
    y = np.zeros((10, NODES))
    y[1] = -s * np.sinc(angle / (2 * np.pi)) * np.sin(angle / 2)
    y[2] = s * np.sinc(angle / (2 * np.pi)) * np.cos(angle / 2)
    y[3], y[4] = np.cos(angle / 2), np.sin(angle / 2)
    return s, y


def solve(rod: Array, force: Array, start: tuple[Array, Array], tolerance: float) -> Any:
    """scipy's solution for a shaft alone under a base-frame force (3,), from the mesh and states `start`."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where it diverges it overflows on its way
        return solve_bvp(_columns(rod, force), _ends, *start, tol=tolerance, max_nodes=MOST_NODES)
