"""The planar places where the seed thesis is wrong as printed: each test passes corrected and fails as printed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from host.identification.calibration import calibrate_model
from host.identification.planar_model import PlanarModel
from host.identification.recorded_shapes import RecordedShape
from host.identification.robust_fit import Objective
from host.mechanics import pcar
from protocol.catheter import load_catheter
from tests.references.arcs_by_quadrature import gradient, point

THERMOCOOL = load_catheter("thermocool_sf")
KAPPA, FORCE = np.array([6.0, -11.0, 23.0]), np.array([0.07, -0.13])
LENGTH = np.array([0.0485, 0.0192, 0.0508])


def angles() -> tuple[float, float, float]:
    turn = KAPPA * LENGTH
    return turn[0], turn[0] + turn[1], turn.sum()


def test_table_2_1_body_stiffness_is_1490_N_mm2() -> None:
    assert THERMOCOOL.pcar is not None
    body, first, second = THERMOCOOL.pcar.EI_N_m2
    assert body == pytest.approx(1490e-6) and body > first > second
    arcs = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7)
    # row 1 of Table 2.2: 12.5 mN move the tip by millimetres; with 1.490 N mm2 the body would hang straight down
    free = pcar.point_at(arcs, arcs.unloaded_curvature_per_m, arcs.total_length_m)[0]
    printed = replace(arcs, EI_N_m2=np.array([1.490e-6, first, second]))
    moved = [np.hypot(*(pcar.solve(model, [0.0, -0.0125]).tip_position_m - free)) for model in (arcs, printed)]
    assert moved[0] < 0.015 < 0.09 < moved[1]


def test_equation_2_11_has_l3_alone() -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7)

    def potential(kappa: np.ndarray) -> complex:
        bend = 0.5 * np.sum(arcs.EI_N_m2 * LENGTH * (kappa - arcs.unloaded_curvature_per_m) ** 2)
        x, y, _ = point(LENGTH, kappa)
        return FORCE[0] * x + FORCE[1] * y - bend

    residual = pcar.static_residual(arcs, KAPPA, FORCE)
    assert np.allclose(residual, gradient(potential, KAPPA), rtol=1e-12, atol=1e-18)
    printed = residual[2] + arcs.EI_N_m2[2] * LENGTH[1] * (15.7 - KAPPA[2])
    assert abs(printed - residual[2]) > 1e-5


def test_appendix_b_dE2_dk1_prefactor() -> None:
    k1, k2, k3 = KAPPA
    l1 = LENGTH[0]
    a, b, c = angles()
    bracket = (
        k2 * k3 * np.cos(a)
        - k2 * k3
        - k1**2 * k2 * l1 * np.sin(b)
        + k1**2 * k3 * l1 * np.sin(b)
        + k1**2 * k2 * l1 * np.sin(c)
        - k1**2 * k3 * l1 * np.sin(a)
        + k1 * k2 * k3 * l1 * np.sin(a)
    )
    found = pcar.kinematic_jacobian(pcar.arcs_of(THERMOCOOL, 0.0485, 15.7), KAPPA)[1, 0]
    assert found == pytest.approx(bracket / (k1**2 * k2 * k3), rel=1e-11)
    assert abs(bracket / k1**2) > 100.0 * abs(found)


def test_appendix_b_dE2_dk2_prefactor() -> None:
    k2, k3 = KAPPA[1:]
    l2 = LENGTH[1]
    a, b, c = angles()
    bracket = k3 * np.cos(b) - k3 * np.cos(a) - k2**2 * l2 * np.sin(b) + k2 * k3 * l2 * np.sin(b) + k2**2 * l2 * np.sin(c)
    found = pcar.kinematic_jacobian(pcar.arcs_of(THERMOCOOL, 0.0485, 15.7), KAPPA)[1, 1]
    assert found == pytest.approx(bracket / (k2**2 * k3), rel=1e-11)
    assert abs(bracket / k2**2) > 10.0 * abs(found)


def printed_tip(kappa: np.ndarray) -> np.ndarray:
    """(2.12), (2.13) as printed, which divide by every curvature."""
    with np.errstate(divide="ignore", invalid="ignore"):
        k1, k2, k3 = kappa
        a, b, c = k1 * LENGTH[0], k1 * LENGTH[0] + k2 * LENGTH[1], float(kappa @ LENGTH)
        x = np.sin(a) / k1 + (np.sin(b) - np.sin(a)) / k2 + (np.sin(c) - np.sin(b)) / k3
        y = (1.0 - np.cos(a)) / k1 + (np.cos(a) - np.cos(b)) / k2 + (np.cos(b) - np.cos(c)) / k3
        return np.array([x, y])


@pytest.mark.parametrize("straight", [0, 1, 2])
def test_equations_2_3_to_2_18_are_smooth_through_a_straight_arc(straight: int) -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.0485, 15.7)
    total = arcs.total_length_m
    assert np.allclose(pcar.point_at(arcs, KAPPA, total)[0], printed_tip(KAPPA), rtol=0, atol=1e-15)
    zero = KAPPA.copy()
    zero[straight] = 0.0
    assert not np.isfinite(printed_tip(zero)).all()
    beside = [zero + sign * 1e-7 * np.eye(3)[straight] for sign in (-1.0, 1.0)]
    limit = np.mean([pcar.point_at(arcs, kappa, total)[0] for kappa in beside], axis=0)
    assert np.allclose(pcar.point_at(arcs, zero, total)[0], limit, rtol=0, atol=1e-16)
    slope = (pcar.point_at(arcs, beside[1], total)[0] - pcar.point_at(arcs, beside[0], total)[0]) / 2e-7
    assert np.allclose(pcar.kinematic_jacobian(arcs, zero)[:2, straight], slope, rtol=0, atol=1e-9)
    assert np.isfinite(pcar.tangent_stiffness(arcs, zero, FORCE)).all()


def recordings(count: int) -> list[RecordedShape]:
    arcs = pcar.arcs_of(THERMOCOOL, 0.04, 20.0)
    offset = np.array([0.0, 0.02, 0.05])
    found = []
    for k in range(count):
        force = np.array([0.02 * np.cos(k), -0.01 * (k + 1)])
        kappa = pcar.solve(arcs, force).curvature_per_m
        at = np.array([pcar.point_at(arcs, kappa, arcs.total_length_m - back)[0] for back in offset])
        found.append(RecordedShape(0.04, 20.0, force, offset, at + [0.0, 1e-3]))
    return found


def test_equation_2_20_sums_over_the_recordings_given() -> None:
    for count in (1, 15):
        model = PlanarModel(THERMOCOOL, recordings(count), ("stiffness",))
        # every marker is 1 mm off: the sum is one unit of 1 mm for each of the `count` recordings' three markers
        assert Objective(model, "distance", 1e-3)(model.start()) == pytest.approx(3 * count, rel=1e-3)


def test_table_2_2_errors_of_any_marker_and_of_the_tip_are_told_apart() -> None:
    shapes = recordings(4)
    shapes[1].position_m[2] += [0.0, 0.004]  # off near the base, not at the tip
    model = PlanarModel(THERMOCOOL, shapes, ("stiffness",))
    left = calibrate_model(model).left_out[1]
    assert left.max_m > left.tip_m + 2e-3
