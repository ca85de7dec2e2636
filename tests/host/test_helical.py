"""The piecewise helical model: its derivatives, its limit, its branch, and where it stands beside the rod."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from host.mechanics.cosserat import solve_cosserat
from host.mechanics.helical import chain_of, solve_helical, tip_of
from host.mechanics.helical_kernels import back_substitute, factorize, place, screw, work_of_force
from host.mechanics.rotations import quaternion_of_vector, rotation_matrix
from protocol.catheter import load_catheter
from protocol.errors import InputError
from tests.host.rod_cases import random_catheter, rod_of, uniform_catheter, unit
from tests.host.rotation_angle import angle_between

Array = NDArray[np.float64]

STEEROCATH = load_catheter("steerocath_t")


def test_a_segment_is_a_helix_smooth_through_zero_curvature() -> None:
    S, p, rng = np.empty((3, 3)), np.empty(3), np.random.default_rng(0)
    for size in (0.0, 1e-7, 0.0999, 0.1001, 5.0, 60.0):
        u = size * unit(rng)
        screw(u, 0.1, S, p)
        assert np.abs(S - rotation_matrix(quaternion_of_vector(0.1 * u))).max() < 1e-13
        s = np.polynomial.legendre.leggauss(30)
        points = [rotation_matrix(quaternion_of_vector(0.05 * (x + 1.0) * u))[:, 2] for x in s[0]]
        assert np.abs(p - 0.05 * s[1] @ np.array(points)).max() < 1e-12


def test_gradient_and_hessian_of_the_work_against_differences() -> None:
    rng = np.random.default_rng(1)
    chain, force = chain_of(rod_of("steerocath_t", 0.02, 20.0), 5), np.array([0.1, -0.05, 0.08])
    n = len(chain)
    u = 15.0 * rng.normal(size=(n, 3))
    R, r, R_end, r_end = np.empty((n, 3, 3, 3)), np.empty((n, 3, 3)), np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))

    def slope_at(v: Array) -> tuple[Array, Array]:
        slope, curve = np.empty(3 * n), np.empty((3 * n, 3 * n))
        place(chain, v.reshape(n, 3), R, r, R_end, r_end)
        work_of_force(chain, R, r, r_end[n], force, slope, curve)
        return slope, curve

    slope, curve = slope_at(u.ravel())
    h = 1e-3
    work = np.array(
        [[tip_of(chain, (u.ravel() + s * h * e).reshape(n, 3))[0] @ force for s in (1, -1)] for e in np.eye(3 * n)]
    )
    assert np.abs(slope - (work[:, 0] - work[:, 1]) / (2 * h)).max() < 1e-5 * np.abs(slope).max()
    numeric = np.array([(slope_at(u.ravel() + h * e)[0] - slope_at(u.ravel() - h * e)[0]) / (2 * h) for e in np.eye(3 * n)])
    assert np.abs(curve - curve.T).max() == 0.0
    assert np.abs(curve - numeric).max() < 2e-2 * np.abs(curve).max()  # inside a segment by Gauss points


def test_factorization_solves_and_counts() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(9, 9))
    A = A + A.T
    b = rng.normal(size=9)
    L, x = A.copy(), b.copy()
    assert factorize(L) == np.sum(np.linalg.eigvalsh(A) < 0.0)
    back_substitute(L, x)
    assert np.abs(A @ x - b).max() < 1e-9


def test_one_segment_without_load_is_the_unloaded_arc() -> None:
    found = solve_helical(STEEROCATH, 0.0, 30.0, [0.0, 0.0, 0.0], 1)
    angle = 30.0 * 0.07
    assert np.abs(found.tip_position_m - [0.0, -(1 - math.cos(angle)) / 30.0, math.sin(angle) / 30.0]).max() < 1e-14


@pytest.mark.parametrize("insertion", [-0.03, 0.0, 0.04])
def test_many_segments_are_the_rod_and_the_error_falls_with_their_square(insertion: float) -> None:
    force = [0.05, 0.08, -0.03]
    rod = solve_cosserat(STEEROCATH, insertion, 20.0, force)
    errors = []
    for segments in (8, 16, 32):
        found = solve_helical(STEEROCATH, insertion, 20.0, force, segments)
        errors.append(float(np.linalg.norm(found.tip_position_m - rod.tip_position_m)))
    assert errors[2] < 3e-5 and 3.0 < errors[0] / errors[1] < 5.0 and 3.3 < errors[1] / errors[2] < 4.7
    assert angle_between(found.tip_quaternion_wxyz, rod.tip_quaternion_wxyz) < 2e-3


def test_four_segments_are_within_the_thesis_model_error() -> None:
    """Mean tip error of the rod against experiments: 1.97 mm (section 3.3). Four segments add well below that."""
    rng, errors = np.random.default_rng(3), []
    for _ in range(60):
        catheter, k0, force = random_catheter(rng), rng.uniform(0.0, 45.0), rng.uniform(0.02, 0.25) * unit(rng)
        rod, helices = solve_cosserat(catheter, 0.0, k0, force), solve_helical(catheter, 0.0, k0, force)
        assert rod.converged == helices.converged
        if rod.converged:
            errors.append(np.linalg.norm(rod.tip_position_m - helices.tip_position_m))
    assert np.median(errors) < 0.6e-3 and max(errors) < 3e-3


def test_it_needs_no_more_than_a_few_dozen_newton_steps_where_the_load_is_large() -> None:
    rng = np.random.default_rng(4)
    for _ in range(30):
        catheter = random_catheter(rng)
        p = catheter.cosserat
        assert p is not None
        force = rng.uniform(30.0, 62.0) * min(p.EI1, p.EI2, p.GJ) / 0.07**2 * unit(rng)
        found = solve_helical(catheter, 0.0, rng.uniform(0.0, 45.0), force)
        assert not found.converged or (found.iterations < 120 and found.unstable_modes == 0)


def test_buckling_of_the_chain_tends_to_eulers_load() -> None:
    EI = 2e-4
    catheter, critical = uniform_catheter(EI, 3e-4, 2e-4), math.pi**2 * EI / (4 * 0.07**2)
    for share, modes in ((0.97, 0), (1.03, 1)):
        found = solve_helical(catheter, 0.0, 0.0, [0.0, 0.0, -share * critical], 16)
        assert found.converged and found.unstable_modes == modes


def test_a_chain_that_folds_says_so() -> None:
    rng, folds = np.random.default_rng(5), 0
    for _ in range(200):
        catheter = random_catheter(rng)
        p = catheter.cosserat
        assert p is not None
        k0, size = rng.uniform(2.0, 20.0), rng.uniform(2, 40) * p.EI1 / 0.07**2
        found = solve_helical(catheter, 0.0, k0, size * np.array([0.0, 0.02, -1.0]))
        if not found.converged:
            folds += 1
            assert np.all(np.isnan(found.tip_position_m)) and 0.0 <= found.load_reached < 1.0
    assert folds < 200


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"segments": 0}, "segments"),
        ({"segments": 2.5}, "segments"),
        ({"segments": True}, "segments"),
        ({"force_N": [0.0, math.nan, 0.0]}, "force_N"),
        ({"insertion_m": -0.07}, "insertion_m"),
    ],
)
def test_bad_input_is_named(change: dict, key: str) -> None:
    good: dict = {"catheter": STEEROCATH, "insertion_m": 0.0, "curvature_per_m": 10.0, "force_N": [0.0, 0.1, 0.0]}
    with pytest.raises(InputError) as error:
        solve_helical(**(good | change))
    assert error.value.key == key
