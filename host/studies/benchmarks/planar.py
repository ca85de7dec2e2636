"""Benchmarks of the planar model: statics and force from tip pose, compared with scipy's fsolve on the same equations."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import fsolve

from host.estimation import planar_kernels
from host.estimation.planar import tip_covariance
from host.mechanics import pcar, pcar_kernels
from host.mechanics.pcar_kernels import Load, Shaft
from host.studies.benchmarks.runner import Report, Row, alternate, row_of
from protocol.catheter import load_catheter

Array = NDArray[np.float64]

CASES = 200
RIGHT_m, RIGHT_N = 1e-4, 1e-3


@njit(cache=True, nogil=True)
def _solve(shaft: Shaft, external: Load, kappa: Array, work: Array, repeats: int) -> int:
    status = 0
    for _ in range(repeats):
        status, _, _ = pcar_kernels.load_path(shaft, external, kappa, work)
    return status


@njit(cache=True, nogil=True)
def _invert(shaft: Shaft, pose: Array, covariance: Array, kappa: Array, work: Array, force: Array, repeats: int) -> bool:
    done = False
    for _ in range(repeats):
        done, force[0], force[1] = planar_kernels.two_stage(shaft, pose, covariance, kappa, work)
    return done


def random_inputs(seed: int) -> list[tuple[pcar.Arcs, Array, pcar.Equilibrium]]:
    """Arcs of the planar catheter, forces (2,) and the equilibria that grow from the unloaded shapes."""
    catheter, rng = load_catheter("thermocool_sf"), np.random.default_rng(seed)
    inputs: list[tuple[pcar.Arcs, Array, pcar.Equilibrium]] = []
    while len(inputs) < CASES:
        arcs = pcar.arcs_of(catheter, rng.uniform(0.0, 0.05), rng.uniform(0.0, 60.0))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        force = rng.uniform(0.01, 0.25) * np.array([np.cos(angle), np.sin(angle)])
        found = pcar.solve(arcs, force)
        if found.converged:
            inputs.append((arcs, force, found))
    return inputs


def _tip(arcs: pcar.Arcs, kappa: Array) -> Array:
    return pcar.shape(arcs, kappa, 2)[-1]


def direct(seed: int, _report: Report) -> list[Row]:
    """Shape under a force, cold, compared with fsolve on the moments from the unloaded shape."""
    ours, peers, truth, answers, theirs = [], [], [], [], []
    for arcs, force, found in random_inputs(seed):
        kappa, work = np.empty_like(arcs.length_m), np.empty((pcar_kernels.ROWS, arcs.length_m.size))
        answer = np.empty_like(kappa)
        ours.append(
            lambda n, a=arcs, f=force, k=kappa, w=work: _solve(
                a.shaft, Load(float(f[0]), float(f[1]), pcar.NO_DRAG), k, w, n
            )
        )
        peers.append(
            lambda a=arcs, f=force, k=answer: np.copyto(
                k, _quiet_fsolve(lambda x: pcar.static_residual(a, x, f), a.unloaded_curvature_per_m)
            )
        )
        truth.append(found.tip_position_m)
        answers.append((arcs, kappa))
        theirs.append((arcs, answer))
    ours[0](1), peers[0]()
    timed = alternate(ours, peers)
    errors = [
        np.array([np.linalg.norm(_tip(*side) - tip) for side, tip in zip(sides, truth, strict=True)])
        for sides in (answers, theirs)
    ]
    return [row_of("pcar_direct", "", "scipy fsolve", timed, seed, **_summary("tip_error_m", errors, RIGHT_m))]


def inverse(seed: int, _report: Report) -> list[Row]:
    """Force from the tip's pose as in chapter 4, compared with fsolve for curvatures, then force by least squares."""
    ours, peers, truth, answers, theirs = [], [], [], [], []
    covariance = tip_covariance()
    for arcs, force, found in random_inputs(seed):
        pose = np.array([*found.tip_position_m, found.tip_angle_rad])
        kappa, work = np.empty_like(arcs.length_m), np.empty((pcar_kernels.ROWS, arcs.length_m.size))
        answer, other = np.empty(2), np.empty(2)
        ours.append(lambda n, a=arcs, p=pose, k=kappa, w=work, f=answer: _invert(a.shaft, p, covariance, k, w, f, n))
        peers.append(lambda a=arcs, p=pose, f=other: np.copyto(f, _by_fsolve(a, p)))
        truth.append(force)
        answers.append(answer)
        theirs.append(other)
    ours[0](1), peers[0]()
    timed = alternate(ours, peers)
    errors = [np.linalg.norm(np.array(sides) - np.array(truth), axis=1) for sides in (answers, theirs)]
    return [
        row_of(
            "pcar_inverse", "", "scipy fsolve and least squares", timed, seed, **_summary("force_error_N", errors, RIGHT_N)
        )
    ]


def _quiet_fsolve(function: Callable[[Array], Array], start: Array) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where it does not converge, the error says so
        return np.asarray(fsolve(function, start, xtol=1e-10), dtype=np.float64)


def _by_fsolve(arcs: pcar.Arcs, pose: Array) -> Array:
    """Force (2,): curvatures that reach the pose by fsolve, then the force that balances the moments, linear in it."""

    def misses(kappa: Array) -> Array:
        angle = float(kappa @ arcs.length_m)
        return np.append(_tip(arcs, kappa) - pose[:2], angle - pose[2])

    kappa = _quiet_fsolve(misses, arcs.unloaded_curvature_per_m)
    zero = pcar.static_residual(arcs, kappa, [0.0, 0.0])
    columns = np.column_stack([pcar.static_residual(arcs, kappa, unit) - zero for unit in np.eye(2)])
    return np.asarray(np.linalg.lstsq(columns, -zero, rcond=None)[0], dtype=np.float64)


def _summary(key: str, errors: list[Array], limit: float) -> dict[str, object]:
    right = [e < limit for e in errors]
    medians = [float(np.median(e[r])) if r.any() else float("inf") for e, r in zip(errors, right, strict=True)]
    return {key: medians[0], "peer_" + key: medians[1], "right": int(right[0].sum()), "peer_right": int(right[1].sum())}
