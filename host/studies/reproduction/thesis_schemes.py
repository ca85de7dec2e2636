"""What the thesis compares or draws with its schemes: iterates, internal loads of (3.18), the conventional BVP."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp

from host.mechanics.rotations import rotation_matrix
from host.mechanics.thesis_reference import ELEMENTS, euler_sweep

Array = np.ndarray


def iterates(rod: Array, force: Array, count: int) -> list[Array]:
    """Centre lines (501, 3) m of Algorithm 3.1's first `count` passes under a force (3,) N in the base frame."""
    shape, x, lines = np.empty((ELEMENTS + 1, 7)), np.zeros(3), []
    for _ in range(count):
        euler_sweep(rod, x, 0.0, ELEMENTS, shape)
        lines.append(shape[:, :3].copy())
        x = rotation_matrix(shape[-1, 3:].copy()).T @ force
    return lines


def internal_loads(rod: Array, force: Array, tension: float, sigma: Array) -> Array:
    """n (N) and m (Nm) of (3.18), (3.19) as corrected, (k, 6), at `sigma` (k,) m back from the tip, ascending.

    The force (3,) N is in the tip frame. Where the body begins the tension (N) leaves the rod.
    """

    def rates(_s: float, y: Array, at: int, k0: float, pull: float) -> Array:
        n, m = y[:3], y[3:]
        u = rod[at : at + 3] * m + [k0, 0.0, 0.0]
        return np.concatenate([np.cross(u, n) + pull * np.array([u[1], -u[0], 0.0]), np.cross(u, m) + [-n[1], n[0], 0.0]])

    y = np.concatenate([force - [0.0, 0.0, tension], np.zeros(3)])
    ends, parts = (rod[6], rod[6] + rod[7]), []
    for begin, end, args in ((0.0, ends[0], (0, rod[8], tension)), (ends[0], ends[1], (3, 0.0, 0.0))):
        run = solve_ivp(rates, (begin, end), y, "DOP853", rtol=1e-10, atol=1e-13, dense_output=True, args=args)
        inside = sigma[sigma <= end] if begin == 0.0 else sigma[sigma > begin]
        parts.append(run.sol(inside).T)
        y = run.y[:, -1] + [0.0, 0.0, tension, 0.0, 0.0, 0.0]
    return np.vstack(parts)


def conventional(rod: Array, force: Array, nodes: int = ELEMENTS + 1) -> tuple[bool, Array]:
    """The shaft in the global frame as a boundary value problem for scipy's solve_bvp: (converged, tip (3,) m). No body.

    State: position, quaternion, moment in the base frame; the force (3,) N is constant along the rod. Starts from the
    unloaded shape.
    """
    c = rod[:3]

    def rates(_s: Array, y: Array) -> Array:
        w, v, m = y[3], y[4:7], y[7:10]
        R = np.array(
            [
                [2 * (w * w + v[0] * v[0]) - 1, 2 * (v[0] * v[1] - w * v[2]), 2 * (v[0] * v[2] + w * v[1])],
                [2 * (v[0] * v[1] + w * v[2]), 2 * (w * w + v[1] * v[1]) - 1, 2 * (v[1] * v[2] - w * v[0])],
                [2 * (v[0] * v[2] - w * v[1]), 2 * (v[1] * v[2] + w * v[0]), 2 * (w * w + v[2] * v[2]) - 1],
            ]
        )
        u = c[:, None] * np.einsum("jis,js->is", R, m)
        u[0] += rod[8]
        d3 = R[:, 2]
        turn = 0.5 * np.vstack([-(v * u).sum(axis=0), w * u + np.cross(v.T, u.T).T])
        return np.vstack([d3, turn, -np.cross(d3.T, force).T])

    def ends(a: Array, b: Array) -> Array:
        return np.concatenate([a[:3], a[3:7] - [1.0, 0.0, 0.0, 0.0], b[7:10]])

    shape = np.empty((nodes, 7))
    euler_sweep(rod, np.zeros(3), 0.0, nodes - 1, shape)
    s = np.linspace(0.0, rod[6], nodes)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        found = solve_bvp(rates, ends, s, np.vstack([shape.T, np.zeros((3, nodes))]), tol=1e-3, max_nodes=20 * nodes)
    return bool(found.success), np.asarray(found.y[:3, -1])
