"""Planar force from the tip's pose: exact without noise, efficient with it, honest where no force explains the pose."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from host.estimation import planar
from host.estimation.contact_knowledge import ContactKnowledge
from host.estimation.interface import Actuation, PoseReading
from host.estimation.lasting_errors import ActuationKnowledge
from host.estimation.planar_rig import PlanarRigEstimator, bending_plane
from host.estimation.sensor_noise import TrackedSensors
from host.mechanics import pcar
from protocol.catheter import load_catheter
from protocol.rig_file import SIMULATED_RIG, load_rig

REFERENCES = json.loads((Path(__file__).parents[1] / "references" / "planar.json").read_text())
THERMOCOOL, BLAZER = load_catheter("thermocool_sf"), load_catheter("blazer_prime_xp")
SURE = ActuationKnowledge((1e-6, 1e-3, 0.08), (1e-6, 1e-3, 1e-3), (1e-6, 1e-3, 1e-3))


def pose_of(arcs: pcar.Arcs, force: NDArray) -> NDArray | None:
    found = pcar.solve(arcs, force)
    return np.array([*found.tip_position_m, found.tip_angle_rad]) if found.converged else None


@pytest.mark.parametrize("group", ["table_2_2", "random"])
def test_force_from_poses_of_the_independent_model(group: str) -> None:
    for case in REFERENCES[group]:
        arcs = pcar.arcs_of(THERMOCOOL, case["insertion_m"], case["curvature_per_m"])
        found = planar.estimate(arcs, [*case["tip_m"], case["angle_rad"]])
        assert found.converged and found.residual < 1e-9, case
        assert np.abs(found.force_N - case["force_N"]).max() < 1e-6, case


def test_the_thesis_two_stages_agree_without_noise() -> None:
    for case in REFERENCES["random"]:
        arcs = pcar.arcs_of(THERMOCOOL, case["insertion_m"], case["curvature_per_m"])
        force, converged = planar.two_stage(arcs, [*case["tip_m"], case["angle_rad"]])
        assert converged and np.abs(force - case["force_N"]).max() < 1e-6, case


@pytest.mark.parametrize("curvature", [10.0, 20.0, 30.0])
@pytest.mark.parametrize("size", [0.15, 0.25, 0.35])
def test_all_directions_of_figures_4_3_to_4_5(curvature: float, size: float) -> None:
    arcs = pcar.arcs_of(THERMOCOOL, 0.0413, curvature)
    for alpha in np.radians(np.arange(90.0, 270.0, 7.5)):
        force = size * np.array([np.cos(alpha), np.sin(alpha)])
        pose = pose_of(arcs, force)
        assert pose is not None
        assert np.abs(planar.estimate(arcs, pose).force_N - force).max() < 1e-6


@pytest.mark.parametrize(("insertion_m", "longest_m"), [(0.03, 0.01), (0.0, 0.005), (-0.01, math.inf), (-0.025, 0.01)])
def test_any_number_of_arcs(insertion_m: float, longest_m: float) -> None:
    arcs, force = pcar.arcs_of(THERMOCOOL, insertion_m, 20.0, longest_m), np.array([-0.08, -0.12])
    assert np.count_nonzero(arcs.length_m) != 3
    found = planar.estimate(arcs, pose_of(arcs, force))
    assert found.converged and np.abs(found.force_N - force).max() < 1e-6
    assert np.abs(planar.two_stage(arcs, pose_of(arcs, force))[0] - force).max() < 1e-5


def test_a_single_arc_cannot_tell_the_force_and_says_so() -> None:
    arcs = pcar.arcs_of(THERMOCOOL, -0.03, 20.0)
    found = planar.estimate(arcs, pose_of(arcs, np.array([-0.05, -0.1])))
    assert found.weakest_std_N == planar.UNSEEN_STD_N and any("weakly observed" in line for line in found.warnings)
    assert np.isfinite(found.covariance_N2).all()


def test_straight_shaft_does_not_show_its_axial_force() -> None:
    found = planar.estimate(pcar.arcs_of(THERMOCOOL, 0.03, 0.0), [0.1, 0.0, 0.0])
    assert found.converged and abs(found.weakest_direction[0]) > 0.999 and found.warnings
    assert abs(found.force_N[1]) < 1e-9


def test_covariance_is_the_inverse_information_by_differences() -> None:
    arcs, force = pcar.arcs_of(THERMOCOOL, 0.04, 18.0), np.array([-0.06, -0.11])
    found = planar.estimate(arcs, pose_of(arcs, force))
    by = []
    for unit in np.eye(2):
        poses = [pose_of(arcs, force + k * 2e-3 * unit) for k in (-2, -1, 1, 2)]
        by.append((poses[0] - 8.0 * poses[1] + 8.0 * poses[2] - poses[3]) / (12.0 * 2e-3))  # type: ignore[operator]
    jacobian = np.array(by).T
    information = jacobian.T @ np.linalg.inv(planar.tip_covariance()) @ jacobian
    assert np.allclose(found.covariance_N2, np.linalg.inv(information), rtol=1e-6)


def test_noisy_estimates_reach_the_cramer_rao_bound_and_beat_the_two_stages() -> None:
    arcs, force = pcar.arcs_of(THERMOCOOL, 0.04, 25.0), np.array([-0.08, -0.12])
    pose, covariance = pose_of(arcs, force), planar.tip_covariance()
    bound = planar.estimate(arcs, pose).covariance_N2
    rng = np.random.default_rng(1)
    poses = pose + rng.normal(size=(4000, 3)) * np.sqrt(np.diag(covariance))
    found = planar.estimate_recording(THERMOCOOL, 0.04, 25.0, poses)
    assert found.converged.mean() > 0.999
    error = found.force_N[found.converged] - force
    scatter = np.sqrt(np.trace(error.T @ error) / len(error))
    assert scatter < 1.1 * math.sqrt(np.trace(bound))
    normalized = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_N2[found.converged]), error)
    assert 1.25 < np.median(normalized) < 1.55  # chi square of two: 1.386
    thesis = np.array([planar.two_stage(arcs, noisy)[0] for noisy in poses[:400]]) - force
    assert np.median(np.hypot(*error[:400].T)) < np.median(np.hypot(*thesis.T))


def test_recording_equals_the_loop_of_single_calls_and_survives_gaps() -> None:
    rng = np.random.default_rng(3)
    insertion, curvature = rng.uniform(-0.015, 0.05, 60), rng.uniform(5.0, 45.0, 60)
    poses = []
    for d, k in zip(insertion, curvature, strict=True):
        poses.append(pose_of(pcar.arcs_of(THERMOCOOL, d, k), rng.normal(size=2) * 0.08))
    table = np.array(poses) + rng.normal(size=(60, 3)) * np.sqrt(np.diag(planar.tip_covariance()))
    table[7] = np.nan
    found = planar.estimate_recording(THERMOCOOL, insertion, curvature, table, workers=3)
    assert not found.converged[7] and np.isnan(found.force_N[7]).all()
    for i in range(60):
        if i != 7:
            alone = planar.estimate(pcar.arcs_of(THERMOCOOL, insertion[i], curvature[i]), table[i])
            assert np.allclose(found.force_N[i], alone.force_N, rtol=0, atol=1e-12)
            assert np.allclose(found.covariance_N2[i], alone.covariance_N2, rtol=1e-9)
            assert found.residual[i] == pytest.approx(alone.residual, rel=1e-9, abs=1e-15)


def test_tracking_starts_from_the_last_sample_and_recovers_after_a_bad_one() -> None:
    tracker = planar.PlanarTracker(THERMOCOOL)
    cold = warm = 0
    for k in range(60):
        force = np.array([-0.06 + 0.04 * math.sin(0.2 * k), -0.1 + 0.05 * math.cos(0.13 * k)])
        arcs = pcar.arcs_of(THERMOCOOL, 0.03 + 1e-4 * k, 20.0 + 0.1 * k)
        pose = pose_of(arcs, force)
        if k == 30:
            assert not tracker.update(0.03, 20.0, [0.4, 0.0, 0.0]).converged
        found = tracker.update(0.03 + 1e-4 * k, 20.0 + 0.1 * k, pose)
        assert found.converged and np.abs(found.force_N - force).max() < 1e-6
        warm += found.iterations
        cold += planar.estimate(arcs, pose).iterations
    assert warm < cold


def test_surface_normal_prior_helps_across_the_normal_only_as_far_as_it_is_sure() -> None:
    arcs, normal = pcar.arcs_of(THERMOCOOL, 0.04, 25.0), np.array([-0.8, -0.6])
    pose = pose_of(arcs, 0.15 * normal)
    rng = np.random.default_rng(5)
    tangent = np.array([-normal[1], normal[0]])
    plain, helped = [], []
    for noise in rng.normal(size=(200, 3)) * np.sqrt(np.diag(planar.tip_covariance())):
        prior = planar.SurfacePrior(normal, 0.002)
        plain.append(planar.estimate(arcs, pose + noise).force_N - 0.15 * normal)
        helped.append(planar.estimate(arcs, pose + noise, prior=prior).force_N - 0.15 * normal)
    before, after = (float(np.std(np.array(errors) @ tangent)) for errors in (plain, helped))
    assert after < 0.5 * before and after < 0.0025
    loose = planar.estimate(arcs, pose, prior=planar.SurfacePrior(normal, 1e3))
    assert np.allclose(loose.force_N, 0.15 * normal, atol=1e-6)


@pytest.mark.parametrize("pose", [[0.3, 0.0, 0.0], [-0.05, 0.09, -2.0], [0.0, 0.0, 3.0], [0.118, 0.02, -1.5]])
def test_poses_that_no_force_explains_are_reported_not_raised(pose: list[float]) -> None:
    found = planar.estimate(pcar.arcs_of(THERMOCOOL, 0.0485, 15.7), pose, thorough=True)
    assert not found.converged and found.residual > 0.02 and found.warnings
    assert np.isfinite(found.force_N).all() and np.isfinite(found.covariance_N2).all()


@settings(max_examples=40)
@given(
    insertion=st.floats(-0.015, 0.05),
    curvature=st.floats(5.0, 45.0),
    size=st.floats(0.0, 0.3),
    angle=st.floats(-math.pi, math.pi),
)
def test_the_estimate_inverts_the_statics(insertion: float, curvature: float, size: float, angle: float) -> None:
    arcs, force = pcar.arcs_of(THERMOCOOL, insertion, curvature), size * np.array([math.cos(angle), math.sin(angle)])
    pose = pose_of(arcs, force)
    if pose is not None:
        found = planar.estimate(arcs, pose)
        assert found.converged
        mirrored = planar.estimate(pcar.arcs_of(THERMOCOOL, insertion, -curvature), pose * [1.0, -1.0, -1.0])
        assert np.allclose(mirrored.force_N, found.force_N * [1.0, -1.0], atol=1e-9)
        # to 1e-6 N, or to a millionth of what the sensors could tell in a direction that hardly shows
        assert np.abs(found.force_N - force).max() < max(1e-6, 1e-6 * found.weakest_std_N)


@pytest.mark.parametrize(
    "change",
    [
        {"pose": [np.nan, 0.0, 0.0]},
        {"pose": [0.1, 0.0]},
        {"covariance": np.zeros((3, 3))},
        {"covariance": np.eye(2)},
        {"covariance": -np.eye(3)},
        {"prior": planar.SurfacePrior([0.0, 0.0], 0.1)},
        {"prior": planar.SurfacePrior([1.0, 0.0], 0.0)},
    ],
)
def test_bad_input_is_refused(change: dict) -> None:
    arguments = {"pose": [0.1, 0.0, 0.0], **change}
    with pytest.raises(ValueError, match=r"found|wanted"):
        planar.estimate(pcar.arcs_of(THERMOCOOL, 0.04, 10.0), **arguments)


def reading(arcs: pcar.Arcs, force: NDArray, back_m: float, roll_rad: float, noise: NDArray) -> PoseReading:
    """A tracked pose in the base frame of a shape that lies in the plane at `roll_rad`."""
    kappa = pcar.solve(arcs, force).curvature_per_m
    position, angle = pcar.point_at(arcs, kappa, arcs.total_length_m - back_m)
    # roll about e3 after bending from e3 towards -e2, that is about +e1
    half, turn = 0.5 * angle, 0.5 * roll_rad
    w, x, y, z = (
        math.cos(turn) * math.cos(half),
        math.cos(turn) * math.sin(half),
        math.sin(turn) * math.sin(half),
        math.sin(turn) * math.cos(half),
    )
    y_axis, _ = bending_plane(roll_rad)
    return PoseReading(position[0] * np.array([0.0, 0.0, 1.0]) + position[1] * y_axis + noise, np.array([w, x, y, z]), 123)


def test_rig_estimator_gives_the_force_on_the_tissue_in_the_base_frame() -> None:
    estimator = PlanarRigEstimator(
        BLAZER, TrackedSensors(0.02, 0.29e-3, 0.0035), SURE, ContactKnowledge(10.0, 10.0, 10.0, 0.05)
    )
    for roll in (0.0, 1.2, -2.5):
        arcs, force = pcar.arcs_of(BLAZER, -0.07, 18.0, 0.0056), np.array([-0.15, -0.02])
        tip, shaft = (reading(arcs, force, back, roll, np.zeros(3)) for back in (0.0, 0.02))
        found = estimator.estimate(tip, shaft, Actuation(-0.07, roll, 18.0, 0))
        y_axis, normal = bending_plane(roll)
        on_tissue = -(force[0] * np.array([0.0, 0.0, 1.0]) + force[1] * y_axis)
        assert found.converged and found.stamp_ns == 123
        assert np.allclose(found.force_N, on_tissue, atol=2e-4)
        assert found.force_N[2] > 0.1  # the tip pushes the wall outwards, along e3
        assert normal @ found.covariance_N2 @ normal == pytest.approx(0.05**2, rel=1e-6)


def test_rig_estimator_stays_within_its_covariance_under_noise_and_play() -> None:
    rng = np.random.default_rng(11)
    rig = load_rig(SIMULATED_RIG)
    offset = rig.tracker.shaft_sensor_offset_m
    normalized, converged = [], 0
    for _ in range(40):
        estimator = PlanarRigEstimator.from_rig(rig)
        insertion, curvature, roll = rng.uniform(-0.075, -0.065), rng.uniform(10.0, 25.0), rng.uniform(-3.0, 3.0)
        force = np.array([-rng.uniform(0.05, 0.2), rng.normal() * 0.02])
        arcs = pcar.arcs_of(BLAZER, insertion + 0.3e-3 * rng.normal(), curvature + 0.5 * rng.normal(), 0.0028)
        tip, shaft = (reading(arcs, force, back, roll, rng.normal(size=3) * 0.29e-3) for back in (0.0, offset))
        found = estimator.estimate(tip, shaft, Actuation(insertion, roll, curvature, 0))
        y_axis, _ = bending_plane(roll)
        error = found.force_N + force[0] * np.array([0.0, 0.0, 1.0]) + force[1] * y_axis
        normalized.append(error @ np.linalg.solve(found.covariance_N2, error))
        converged += found.converged
    assert converged >= 38 and np.median(normalized) < 3.0


def test_rig_estimator_without_shaft_sensor_and_with_bad_input() -> None:
    estimator = PlanarRigEstimator.from_rig(load_rig(SIMULATED_RIG))
    arcs = pcar.arcs_of(BLAZER, -0.07, 18.0, 0.0056)
    tip = reading(arcs, np.array([-0.1, 0.0]), 0.0, 0.3, np.zeros(3))
    alone = estimator.estimate(tip, None, Actuation(-0.07, 0.3, 18.0, 0))
    assert alone.converged and abs(alone.force_N[2] - 0.1) < 3.0 * math.sqrt(alone.covariance_N2[2, 2])
    odd = estimator.estimate(tip._replace(position_m=np.array([0.02, 0.02, -0.02])), None, Actuation(-0.07, 0.3, 18.0, 0))
    assert not odd.converged and np.isfinite(odd.force_N).all() and np.isfinite(odd.covariance_N2).all()
    with pytest.raises(ValueError, match=r"pose_tip.position_m: found .*wanted a position at most 60.0 mm"):
        estimator.estimate(tip._replace(position_m=np.array([0.2, 0.2, 5.0])), None, Actuation(-0.07, 0.3, 18.0, 0))
    for bad in (tip._replace(position_m=np.full(3, np.nan)), tip._replace(quaternion_wxyz=np.full(4, np.inf))):
        with pytest.raises(ValueError, match="found"):
            estimator.estimate(bad, None, Actuation(-0.07, 0.3, 18.0, 0))
    with pytest.raises(ValueError, match="insertion_m"):
        estimator.estimate(tip, None, Actuation(-0.2, 0.3, 18.0, 0))


@pytest.mark.parametrize("wound_rad", [-0.5, 0.5])
def test_rig_estimator_follows_the_plane_that_the_poses_show(wound_rad: float) -> None:
    """A shaft that is wound up lies in another plane than the controller's roll says."""
    rig = load_rig(SIMULATED_RIG)
    estimator = PlanarRigEstimator.from_rig(rig)
    arcs, force = pcar.arcs_of(BLAZER, -0.07, 18.0, 0.0056), np.array([-0.1, 0.0])
    tip, shaft = (
        reading(arcs, force, back, 0.3 + wound_rad, np.zeros(3)) for back in (0.0, rig.tracker.shaft_sensor_offset_m)
    )
    found = estimator.estimate(tip, shaft, Actuation(-0.07, 0.3, 18.0, 0, np.array([0.0, 0.0, 1.0])))
    assert found.converged and np.allclose(found.force_N, [0.0, 0.0, 0.1], atol=2e-3)


def test_rig_estimator_takes_the_force_out_of_the_plane_from_the_commanded_direction() -> None:
    """Of a force of 0.1 N, 30 degrees out of the plane, the plane holds 0.087 N; the commanded direction gives the other."""
    estimator = PlanarRigEstimator.from_rig(load_rig(SIMULATED_RIG))
    arcs, in_plane_N = pcar.arcs_of(BLAZER, -0.07, 18.0, 0.0056), 0.1 * math.cos(math.radians(30.0))
    tip, shaft = (reading(arcs, np.array([-in_plane_N, 0.0]), back, 0.0, np.zeros(3)) for back in (0.0, 0.02))
    into = np.array([-math.sin(math.radians(30.0)), 0.0, math.cos(math.radians(30.0))])
    found = estimator.estimate(tip, shaft, Actuation(-0.07, 0.0, 18.0, 0, into, "contact"))
    assert found.converged and np.allclose(found.force_N, 0.1 * into, atol=2e-3)
    _, normal = bending_plane(0.0)
    # Out of the plane: that of the force along the wall, 20 mN over cos 30 degrees, and more by the part in the plane.
    assert normal @ found.covariance_N2 @ normal > (0.02 / math.cos(math.radians(30.0))) ** 2
    straight_out = estimator.estimate(tip, shaft, Actuation(-0.07, 0.0, 18.0, 0, normal, "contact"))
    assert abs(straight_out.force_N @ normal) < 1e-12  # nothing in the plane tells of it
    assert normal @ straight_out.covariance_N2 @ normal >= 1.0  # and this is stated
