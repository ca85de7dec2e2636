"""A catheter in space finer than the model that is judged: stiff electrodes, uneven pre-curvature, its own integration."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

from host.mechanics.rotations import rotation_matrix
from host.studies.reproduction.fine_planar import ELECTRODES_STIFFER, UNEVEN, ELECTRODES_m
from protocol.catheter import Catheter

Array = np.ndarray
LOAD_STEPS = 6


def fine_poses(
    catheter: Catheter, insertion_m: float, curvature_per_m: float, force_tip_N: Array, offsets_m: Array
) -> tuple[Array, Array]:
    """Positions (k, 3) m and quaternions (k, 4), base frame, at `offsets_m` (k,) back from the tip, ascending from 0.

    The centre line is integrated from the tip in the tip's frame, moments by the lever to the tip, then put into the
    base frame. insertion_m is 0 or more; force (3,) N in the tip frame.
    """
    p = catheter.cosserat
    if p is None:
        raise ValueError(f"catheter: found {catheter.name} without [cosserat], wanted one with it")
    shaft = catheter.distal_length_m
    stiffness = {True: np.array([p.EbI1, p.EbI2, p.GbJ]), False: np.array([p.EI1, p.EI2, p.GJ])}

    def rates(sigma: float, y: Array, body: bool, stiffer: float) -> Array:
        q = y[3:7] / np.linalg.norm(y[3:7])
        R = rotation_matrix(q)
        u = R.T @ np.cross(-y[:3], force_tip_N) / (stiffness[body] * stiffer)
        if not body:
            u[0] += curvature_per_m * (1.0 + UNEVEN * np.cos(np.pi * (1.0 - sigma / shaft)))
        turn = 0.5 * np.array([-(q[1:] @ u), *(q[0] * u + np.cross(q[1:], u))])
        return np.concatenate([-R[:, 2], -turn])

    breaks = [0.0, ELECTRODES_m, shaft] + ([shaft + insertion_m] if insertion_m > 0.0 else [])
    y, found = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), dict[float, Array]()
    for part, (begin, end) in enumerate(itertools.pairwise(breaks)):
        at = [s for s in offsets_m if begin <= s <= end]
        run = solve_ivp(
            rates,
            (begin, end),
            y,
            "DOP853",
            rtol=1e-9,
            atol=1e-11,
            dense_output=True,
            args=(part == 2, ELECTRODES_STIFFER if part == 0 else 1.0),
        )
        found |= {s: run.sol(s) for s in at}
        y = run.y[:, -1]
    return _seen_from_base(np.array([found[s] for s in offsets_m]), y)


def _seen_from_base(rows: Array, base: Array) -> tuple[Array, Array]:
    w, v = base[3] / np.linalg.norm(base[3:7]), -base[4:7] / np.linalg.norm(base[3:7])
    q = rows[:, 3:7] / np.linalg.norm(rows[:, 3:7], axis=1)[:, None]
    turned = np.column_stack([w * q[:, 0] - q[:, 1:] @ v, w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])])
    return (rows[:, :3] - base[:3]) @ rotation_matrix(np.array([w, *v])).T, turned


def fine_under_base_force(
    catheter: Catheter, insertion_m: float, curvature_per_m: float, force_N: Array, offsets_m: Array
) -> tuple[Array, Array]:
    """As `fine_poses`, under a force (3,) N held in the base frame, grown from zero."""
    x: Array = np.zeros(3)
    for share in np.linspace(1.0 / LOAD_STEPS, 1.0, LOAD_STEPS):

        def miss(x: Array, share: float = share) -> Array:
            _, q = fine_poses(catheter, insertion_m, curvature_per_m, x, np.zeros(1))
            return (rotation_matrix(q[0]) @ x - share * force_N) * 100.0

        x = root(miss, x, tol=1e-8).x
    return fine_poses(catheter, insertion_m, curvature_per_m, x, offsets_m)
