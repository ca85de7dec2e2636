"""Planar arcs: against closed forms, an independent model at 1e-12, the elastica, and their own derivatives."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from host.mechanics import pcar
from host.mechanics.arc_integrals import phi, phi3
from host.mechanics.puncture import solve_through_puncture
from protocol.catheter import load_catheter
from tests.references import elastica
from tests.references.arcs_by_quadrature import NODES, WEIGHTS, gradient, point, work_of_drag

REFERENCES = json.loads((Path(__file__).parents[1] / "references" / "planar.json").read_text())
THERMOCOOL = load_catheter("thermocool_sf")


def arcs_with(length: list[float], EI: list[float], kappa0: list[float], cubic: float = 0.0) -> pcar.Arcs:
    n = len(length)
    return pcar.Arcs(np.array(length), np.array(EI), np.array(kappa0), np.full(n, cubic), np.arange(n) > 0, np.eye(n)[0])


def softened(insertion_m: float, curvature_per_m: float, softer: float, longest: float = np.inf) -> pcar.Arcs:
    arcs = pcar.arcs_of(THERMOCOOL, insertion_m, curvature_per_m, longest)
    return replace(arcs, EI_N_m2=arcs.EI_N_m2 / softer)


@pytest.mark.parametrize("u", [0.0, 1e-300, 1e-9, -1e-4, 0.3, -0.999999, 1.0 - 1e-15, 1.0 + 1e-15, -2.7, 9.0])
def test_arc_integrals_equal_quadrature_on_both_sides_of_the_seam(u: float) -> None:
    found = phi(u)
    wave = np.exp(1j * u * NODES)
    for k in range(3):
        assert abs(complex(found[2 * k], found[2 * k + 1]) - np.sum(WEIGHTS * NODES**k * wave)) < 1e-14
    assert abs(complex(*phi3(u, found[4], found[5], found[6], found[7])) - np.sum(WEIGHTS * NODES**3 * wave)) < 1e-13


@pytest.mark.parametrize("group", ["table_2_2", "retracted", "random", "soft"])
def test_equilibria_of_the_independent_model(group: str) -> None:
    assert len(REFERENCES[group]) >= 5
    for case in REFERENCES[group]:
        arcs = softened(case["insertion_m"], case["curvature_per_m"], case["softer"])
        found = pcar.solve(arcs, case["force_N"])
        assert found.converged and found.stable, case
        assert np.abs(found.tip_position_m - case["tip_m"]).max() < 1e-12, case
        assert abs(found.tip_angle_rad - case["angle_rad"]) < 1e-11, case
        assert np.allclose(found.curvature_per_m, case["curvature_per_m_of_arcs"], rtol=0, atol=1e-8), case


def test_where_the_branch_folds_there_is_no_answer() -> None:
    for case in REFERENCES["fold"]:
        assert case["fold"]
        found = pcar.solve(softened(case["insertion_m"], case["curvature_per_m"], case["softer"]), case["force_N"])
        assert found.status is pcar.Status.FOLD and not found.converged and 0.0 < found.load_share < 1.0, case


def test_just_below_a_fold_there_is_an_answer() -> None:
    for case in REFERENCES["fold"]:
        arcs, force = softened(case["insertion_m"], case["curvature_per_m"], case["softer"]), np.array(case["force_N"])
        reached = pcar.solve(arcs, force).load_share
        assert pcar.solve(arcs, 0.98 * reached * force).converged, case


def test_array_form_equals_single_calls() -> None:
    cases = REFERENCES["random"][:50]
    arcs = [pcar.arcs_of(THERMOCOOL, case["insertion_m"], case["curvature_per_m"]) for case in cases]
    length, kappa0 = np.array([a.length_m for a in arcs]), np.array([a.unloaded_curvature_per_m for a in arcs])
    kappa, found = np.empty_like(length), np.empty((50, pcar.FOUND))
    pcar.solve_many(
        length,
        arcs[0].EI_N_m2,
        arcs[0].cubic_stiffening_m2,
        kappa0,
        np.array([case["force_N"] for case in cases]),
        pcar.NO_DRAG,
        kappa,
        found,
    )
    assert (found[:, pcar.STATUS] == 0).all() and (found[:, pcar.UNSTABLE] == 0).all()
    for i, case in enumerate(cases):
        assert np.array_equal(kappa[i], pcar.solve(arcs[i], case["force_N"]).curvature_per_m)


@pytest.mark.parametrize("kappa", [[3.0, -8.0, 25.0], [0.0, 0.0, 0.0], [1e-7, 0.0, -40.0], [12.0, 60.0, -1e-12]])
def test_jacobians_equal_the_complex_step(kappa: list[float]) -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.04, 15.0)
    at, force = np.array(kappa), np.array([-0.11, 0.23])
    jacobian = pcar.kinematic_jacobian(arcs, at)
    for row in range(3):
        assert np.allclose(jacobian[row], gradient(lambda k, row=row: point(arcs.length_m, k)[row], at), rtol=0, atol=1e-15)
    free = pcar.tangent_stiffness(arcs, at, np.zeros(2))
    second = np.stack([free - pcar.tangent_stiffness(arcs, at, unit) for unit in np.eye(2)])  # of the tip's x and y
    for row in range(2):
        steps = [gradient(lambda k, row=row, i=i: complex_jacobian(arcs.length_m, k)[row][i], at) for i in range(3)]
        assert np.allclose(second[row], steps, rtol=0, atol=1e-16)
    stiffness = pcar.tangent_stiffness(arcs, at, force)
    expected = np.diag(arcs.EI_N_m2 * arcs.length_m) - np.einsum("k,kij->ij", force, second)
    assert np.allclose(stiffness, expected, rtol=0, atol=1e-18)


def complex_jacobian(length: np.ndarray, kappa: np.ndarray) -> list[list[complex]]:
    """d(x, y)/d kappa at complex curvatures, by quadrature of the lever of every point of each arc."""
    tip = point(length, kappa)
    rows: list[list[complex]] = [[], []]
    before = 0.0
    for l in length:
        lever_x = lever_y = 0.0
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            x, y, _ = point(length, kappa, before + l * node)
            lever_x, lever_y = lever_x + weight * (tip[0] - x), lever_y + weight * (tip[1] - y)
        rows[0].append(-l * lever_y)
        rows[1].append(l * lever_x)
        before += l
    return rows


def test_distributed_drag_is_the_gradient_of_its_work() -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.03, 18.0)
    kappa, drag = np.array([4.0, -15.0, 30.0]), np.array([[0.3, -0.2], [1.0, 0.5], [-0.7, 0.9]])
    loaded = pcar.static_residual(arcs, kappa, [0.0, 0.0], drag) - pcar.static_residual(arcs, kappa, [0.0, 0.0])
    work = gradient(lambda k: work_of_drag(arcs.length_m, k, drag), kappa)
    assert np.allclose(loaded, work, rtol=1e-12, atol=1e-16)
    stiffness = pcar.tangent_stiffness(arcs, kappa, [0.1, 0.2], drag)
    step = 1e-4
    for i in range(3):
        shift = np.zeros(3)
        shift[i] = step
        by = [pcar.static_residual(arcs, kappa + m * shift, [0.1, 0.2], drag) for m in (-2, -1, 1, 2)]
        fourth_order = (by[0] - 8.0 * by[1] + 8.0 * by[2] - by[3]) / (12.0 * step)
        assert np.allclose(-stiffness[:, i], fourth_order, rtol=0, atol=1e-13)


def test_many_arcs_with_drag_approach_the_continuous_rod() -> None:
    force, drag = [0.05, -0.12], [0.2, 0.8]
    errors = []
    for longest in (0.01, 0.005, 0.0025):
        arcs = pcar.arcs_of(THERMOCOOL, 0.04, 18.0, longest)
        tip, _ = elastica.shape([0.04, 0.0192, 0.0508], [1.490e-3, 0.430e-3, 0.250e-3], [0.0, 18.0, 18.0], force, drag)
        errors.append(np.abs(pcar.solve(arcs, force, drag).tip_position_m - tip[:2]).max())
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2] and errors[2] < 1e-5


def test_transverse_end_load_equals_the_elliptic_integrals_of_the_elastica() -> None:
    EI, length, tip_angle = 2e-4, 0.07, 1.1
    modulus = (1.0 + np.sin(tip_angle)) / 2.0
    start = np.arcsin(1.0 / np.sqrt(2.0 * modulus))
    load = ellipk(modulus) - ellipkinc(start, modulus)  # sqrt(F L^2 / EI)
    force = EI * load**2 / length**2
    x = np.sqrt(2.0 * np.sin(tip_angle)) / load * length
    y = length - 2.0 / load * (ellipe(modulus) - ellipeinc(start, modulus)) * length
    errors = []
    for n in (200, 400):
        found = pcar.solve(arcs_with([length / n] * n, [EI] * n, [0.0] * n), [0.0, force])
        errors.append(np.abs([found.tip_position_m[0] - x, found.tip_position_m[1] - y]).max())
        assert abs(found.tip_angle_rad - tip_angle) < 1e-4
    # second order in the arcs' length: extrapolated, the arcs are the elastica
    assert errors[1] < 2e-7 and 3.8 < errors[0] / errors[1] < 4.2


def test_small_loads_give_beam_theory_for_two_stiffnesses() -> None:
    body, shaft, EIb, EIs, F = 0.03, 0.05, 1.2e-3, 0.3e-3, 1e-7
    n = 400
    arcs = arcs_with([body / n] * n + [shaft / n] * n, [EIb] * n + [EIs] * n, [0.0] * (2 * n))
    total = body + shaft
    deflection = F / 3.0 * ((total**3 - shaft**3) / EIb + shaft**3 / EIs)
    slope = F / 2.0 * ((total**2 - shaft**2) / EIb + shaft**2 / EIs)
    found = pcar.solve(arcs, [0.0, F])
    assert found.tip_position_m[1] == pytest.approx(deflection, rel=2e-6)
    assert found.tip_angle_rad == pytest.approx(slope, rel=1e-9)


def test_straight_shaft_under_axial_load_is_straight_and_buckles_where_euler_says() -> None:
    EI, length, n = 2e-4, 0.06, 120
    arcs = arcs_with([length / n] * n, [EI] * n, [0.0] * n)
    euler = np.pi**2 * EI / (4.0 * length**2)
    for share, stable in ((0.999, True), (1.001, False)):
        found = pcar.solve(arcs, [-share * euler, 0.0])
        assert found.converged and found.stable is stable
        assert np.allclose(found.tip_position_m, [length, 0.0], rtol=0, atol=1e-15)


def test_a_shape_barely_off_the_symmetric_one_takes_the_bent_branch() -> None:
    EI, length = 2e-4, 0.06
    arcs = arcs_with([length / 4] * 4, [EI] * 4, [0.0] * 4)
    euler = np.pi**2 * EI / (4.0 * length**2)
    for lateral in (1e-3, 1e-5, 1e-7):
        found = pcar.solve(arcs, [-1.5 * euler, lateral * euler])
        assert found.converged and found.stable and found.tip_position_m[1] > 0.5 * length


@pytest.mark.parametrize("insertion_m", [0.0485, 0.0, -0.01, -0.0192, -0.03, -0.069])
def test_pose_sensitivities_equal_high_order_differences(insertion_m: float) -> None:
    force, curvature, back = np.array([-0.05, -0.12]), 15.7, 0.0004

    def pose(d: float, k: float, f: np.ndarray) -> np.ndarray:
        arcs = pcar.arcs_of(THERMOCOOL, d, k)
        found = pcar.solve(arcs, f)
        position, angle = pcar.point_at(arcs, found.curvature_per_m, arcs.total_length_m - back)
        return np.array([*position, angle])

    def derivative(function, h: float) -> np.ndarray:
        return (function(-2 * h) - 8 * function(-h) + 8 * function(h) - function(2 * h)) / (12 * h)

    arcs = pcar.arcs_of(THERMOCOOL, insertion_m, curvature)
    by = pcar.pose_sensitivity(arcs, pcar.solve(arcs, force), force, back)
    for axis, unit in enumerate(np.eye(2)):
        expected = derivative(lambda h, unit=unit: pose(insertion_m, curvature, force + h * unit), 4e-4)
        assert np.allclose(by.by_force[:, axis], expected, rtol=1e-8, atol=1e-8)
    assert np.allclose(
        by.by_curvature, derivative(lambda h: pose(insertion_m, curvature + h, force), 0.05), rtol=1e-8, atol=1e-9
    )
    if insertion_m in (0.0, -0.0192):  # corners, where another arc begins to come out: the derivative on the way back
        at = [pose(insertion_m - k * 1e-5, curvature, force) for k in range(3)]
        assert np.allclose(by.by_insertion, (3 * at[0] - 4 * at[1] + at[2]) / 2e-5, rtol=1e-5, atol=1e-5)
    else:
        step = 1e-4 if insertion_m > -0.06 else 1e-5
        assert np.allclose(
            by.by_insertion, derivative(lambda h: pose(insertion_m + h, curvature, force), step), rtol=1e-6, atol=1e-6
        )


def test_the_shape_is_continuous_as_arcs_slide_into_the_sheath() -> None:
    force = [-0.1, 0.15]
    for corner in (0.0, -0.0192):
        poses = [pcar.solve(pcar.arcs_of(THERMOCOOL, corner + d, 22.0), force).tip_position_m for d in (-1e-9, 0.0, 1e-9)]
        assert np.abs(poses[0] - poses[1]).max() < 1e-8 and np.abs(poses[2] - poses[1]).max() < 1e-8


def test_a_retracted_shaft_equals_a_catheter_made_that_short() -> None:
    found = pcar.solve(pcar.arcs_of(THERMOCOOL, -0.03, 25.0), [0.02, 0.2])
    alone = pcar.solve(arcs_with([0.04], [0.250e-3], [25.0]), [0.02, 0.2])
    assert np.allclose(found.tip_position_m, alone.tip_position_m, rtol=0, atol=1e-15)
    assert found.curvature_per_m[2] == pytest.approx(alone.curvature_per_m[0], rel=1e-13)


@settings(max_examples=60)
@given(
    insertion=st.floats(-0.06, 0.05),
    curvature=st.floats(-60.0, 60.0),
    size=st.floats(0.0, 0.35),
    angle=st.floats(-np.pi, np.pi),
)
def test_mirroring_and_scaling(insertion: float, curvature: float, size: float, angle: float) -> None:
    force = size * np.array([np.cos(angle), np.sin(angle)])
    arcs = pcar.arcs_of(THERMOCOOL, insertion, curvature)
    found = pcar.solve(arcs, force)
    mirrored = pcar.solve(pcar.arcs_of(THERMOCOOL, insertion, -curvature), force * [1.0, -1.0])
    assert mirrored.status is found.status
    if not found.converged:
        return
    assert np.allclose(mirrored.tip_position_m, found.tip_position_m * [1.0, -1.0], rtol=0, atol=1e-12)
    assert np.abs(pcar.static_residual(arcs, found.curvature_per_m, force)).max() < 1e-15
    double = pcar.solve(replace(arcs, EI_N_m2=2.0 * arcs.EI_N_m2), 2.0 * force)
    assert np.allclose(double.tip_position_m, found.tip_position_m, rtol=0, atol=1e-12)
    end = pcar.point_at(arcs, found.curvature_per_m, arcs.total_length_m)[0]
    assert np.allclose(end, found.tip_position_m, rtol=0, atol=1e-13)
    assert np.hypot(*found.tip_position_m) <= arcs.total_length_m * (1.0 + 1e-12)


def test_cubic_stiffening_bends_less_and_stays_an_equilibrium() -> None:
    soft = pcar.arcs_of(THERMOCOOL, 0.04, 15.0)
    stiff = replace(soft, cubic_stiffening_m2=np.full(3, 2e-3))
    force = [0.0, -0.15]
    a, b = pcar.solve(soft, force), pcar.solve(stiff, force)
    assert abs(b.curvature_per_m[2] - 15.0) < abs(a.curvature_per_m[2] - 15.0)
    assert np.abs(pcar.static_residual(stiff, b.curvature_per_m, force)).max() < 1e-16


@pytest.mark.slow
def test_puncture_at_the_free_point_needs_no_reaction() -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7)
    force = [0.03, -0.12]
    free = pcar.solve(arcs, force)
    held = solve_through_puncture(arcs, force, 0.08, pcar.point_at(arcs, free.curvature_per_m, 0.08)[0])
    assert held.equilibrium.converged and np.abs(held.reaction_N).max() < 1e-9
    assert np.allclose(held.equilibrium.tip_position_m, free.tip_position_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("longest", "station", "other"), [(np.inf, 0.08, (0.0, -0.06)), (0.02, 0.06, (0.05, 0.1))])
def test_puncture_is_the_least_energy_under_the_constraint(longest: float, station: float, other: tuple) -> None:
    arcs, force = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7, longest), np.array([0.03, -0.12])
    # a place that the catheter can reach: where another force would put it
    target = pcar.point_at(arcs, pcar.solve(arcs, other).curvature_per_m, station)[0]
    held = solve_through_puncture(arcs, force, station, target)
    assert held.equilibrium.converged and held.equilibrium.stable
    kappa = held.equilibrium.curvature_per_m
    assert np.allclose(pcar.point_at(arcs, kappa, station)[0], target, rtol=0, atol=1e-12)

    def energy(k: np.ndarray) -> float:
        bend = 0.5 * np.sum(arcs.EI_N_m2 * arcs.length_m * (k - arcs.unloaded_curvature_per_m) ** 2)
        return 1e6 * float(bend - force @ pcar.point_at(arcs, k, arcs.total_length_m)[0])

    best = minimize(
        energy,
        kappa + 0.3,
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
        constraints={"type": "eq", "fun": lambda k: 1e3 * (pcar.point_at(arcs, k, station)[0] - target)},
    )
    assert np.allclose(best.x, kappa, rtol=0, atol=2e-3) and energy(kappa) <= best.fun + 1e-9
    # the reaction, put on as a load of the chain up to the hole, balances the arcs together with the tip's force
    reached = pcar.shortened(arcs, station)
    residual = pcar.static_residual(arcs, kappa, force)
    moments = held.reaction_N @ pcar.kinematic_jacobian(reached, kappa)[:2]
    assert np.allclose(residual + moments, 0.0, rtol=0, atol=1e-14)


def test_puncture_refuses_what_it_cannot_hold() -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7)
    for station, point_m in ((0.02, (0.02, 0.0)), (0.5, (0.1, 0.0)), (np.nan, (0.1, 0.0)), (0.08, (np.nan, 0.0))):
        with pytest.raises(ValueError, match="found"):
            solve_through_puncture(arcs, [0.0, 0.1], station, point_m)
    far = solve_through_puncture(arcs, [0.0, 0.1], 0.08, (0.2, 0.2))
    assert not far.equilibrium.converged


@pytest.mark.parametrize("force", [[np.nan, 0.0], [0.0, np.inf], [0.1], [[0.1, 0.2]]])
def test_bad_forces_never_reach_the_kernel(force: list) -> None:
    with pytest.raises(ValueError, match="force_N"):
        pcar.solve(pcar.arcs_of(THERMOCOOL, 0.03, 10.0), force)


@pytest.mark.parametrize(
    ("insertion_m", "curvature"), [(np.nan, 1.0), (-0.07, 1.0), (-1.0, 1.0), (np.inf, 1.0), (0.0, np.nan)]
)
def test_bad_actuation_is_refused(insertion_m: float, curvature: float) -> None:
    with pytest.raises(ValueError, match=r"insertion_m|curvature_per_m"):
        pcar.arcs_of(THERMOCOOL, insertion_m, curvature)
