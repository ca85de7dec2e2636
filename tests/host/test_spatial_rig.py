"""The rig's spatial estimator: exact tangents, forces out of the bending plane, errors of the actuation, true covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from host.estimation.contact_knowledge import ContactKnowledge
from host.estimation.force import estimate_force
from host.estimation.interface import Actuation, PoseReading
from host.estimation.lasting_errors import (
    ALL_JOINTS,
    NOWHERE,
    ActuationKnowledge,
    LastingErrors,
    Prior,
    lasting_part,
)
from host.estimation.planar_rig import PlanarRigEstimator
from host.estimation.rig_estimator import make_estimator
from host.estimation.sensor_noise import TrackedSensors
from host.estimation.spatial_rig import SpatialRigEstimator
from host.estimation.spatial_rig_kernels import TrackedFrame, fit, known_rows, model, new_fit, refit
from host.mechanics.cosserat import solve_cosserat
from host.mechanics.cosserat_kernels import ROW, WORK
from host.mechanics.rod import rod_record
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from host.studies.benchmarks import pose_information
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig, parse_rig
from protocol.topics import Message
from sim.forked_board import forkable_board
from sim.scenario import Scenario
from sim.world import World, simulated_plant

BLAZER = load_catheter("blazer_prime_xp")
OFFSET_m, POSITION_STD_m, ANGLE_STD_rad = 0.020, 0.29e-3, 0.0035
SURE = ActuationKnowledge((1e-6, 1e-4, 1e-5), (1e-6, 1e-4, 1e-5), (1e-6, 1e-4, 1e-5))
UNSURE = ActuationKnowledge((0.8e-3, 0.5, 0.02), (5e-3, 0.1, 0.02), (1e-4, 0.1, 0.005))


def poses(
    force_N: np.ndarray,
    insertion_m: float,
    curvature_per_m: float,
    roll_rad: float,
    rng: np.random.Generator | None = None,
    offsets_m: tuple[float, ...] = (0.0, OFFSET_m),
) -> list[PoseReading]:
    """Poses of the sensors under a force (3,) on the tip in the base frame, by `solve_cosserat`; with noise if `rng`."""
    c, s = math.cos(roll_rad), math.sin(roll_rad)
    turned = np.array([c * force_N[0] + s * force_N[1], c * force_N[1] - s * force_N[0], force_N[2]])
    found = solve_cosserat(BLAZER, insertion_m, curvature_per_m, turned, "base", stations_m=offsets_m)
    assert found.converged
    about = quaternion_of_vector(np.array([0.0, 0.0, roll_rad]))
    out = []
    for p, q in zip(found.station_positions_m, found.station_quaternions_wxyz, strict=True):
        position = np.array([c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]])
        quaternion = quaternion_product(about, q)
        exact = PoseReading(position, quaternion, 0)
        out.append(exact if rng is None else noisy(exact, rng))
    return out


def noisy(pose: PoseReading, rng: np.random.Generator) -> PoseReading:
    """Return `pose` with the tracker's noise."""
    position = np.asarray(pose.position_m) + POSITION_STD_m * rng.standard_normal(3)
    turn = quaternion_of_vector(ANGLE_STD_rad * rng.standard_normal(3))
    return PoseReading(position, quaternion_product(np.asarray(pose.quaternion_wxyz), turn), pose.stamp_ns)


def estimator(knowledge: ActuationKnowledge, **contact: float) -> SpatialRigEstimator:
    sensors = TrackedSensors(OFFSET_m, POSITION_STD_m, ANGLE_STD_rad)
    return SpatialRigEstimator(BLAZER, sensors, knowledge, ContactKnowledge(**contact))


@pytest.mark.parametrize("insertion_m", [-0.07, 0.01])
def test_tangents_are_those_of_difference_quotients(insertion_m: float) -> None:
    actuation = np.array([insertion_m, 15.0, 0.7])
    tip, shaft = poses(np.array([0.02, -0.01, -0.1]), insertion_m, 15.0, 0.7)
    frame = TrackedFrame(
        rod_record(BLAZER, insertion_m, 15.0)[:6].copy(),
        BLAZER.distal_length_m,
        actuation,
        np.array([0.0, OFFSET_m]),
        np.array([[*pose.position_m, *pose.quaternion_wxyz] for pose in (tip, shaft)]),
        POSITION_STD_m,
        ANGLE_STD_rad,
        np.zeros((0, 9)),
        np.zeros(0),
    )
    rows, work, A, unused = np.zeros((3, ROW)), np.zeros(WORK), np.zeros((2, 6, 6)), np.zeros((2, 6, 6))
    x = np.array([0.015, -0.03, -0.08, 0.4e-3, 0.6, 0.02])
    here, steps = new_fit(2), (1e-6, 1e-6, 1e-6, 1e-7, 1e-4, 1e-6)
    model(frame, x, rows, work, here, A)
    for c, step in enumerate(steps):
        ahead, behind = new_fit(2), new_fit(2)
        model(frame, x + step * np.eye(6)[c], rows, work, ahead, unused)
        model(frame, x - step * np.eye(6)[c], rows, work, behind, unused)
        slope = -(ahead.residual - behind.residual) / (2.0 * step)
        if c == 5:  # the position's residual is in the frame turned by the roll: only its part at the answer is exact
            slope, exact = slope[:, 3:], A[:, 3:, c]
        else:
            exact = A[:, :, c]
        assert np.allclose(slope, exact, rtol=2e-3, atol=2e-4 * np.abs(A[:, :, c]).max())
        by = (ahead.force_N - behind.force_N) / (2.0 * step)
        assert np.allclose(by, here.by_x[:, c], rtol=1e-4, atol=1e-6 * np.abs(here.by_x).max())


@pytest.mark.parametrize("roll_rad", [0.0, 1.2, -2.5])
@pytest.mark.parametrize("force_N", [(0.0, 0.0, -0.15), (0.08, 0.0, -0.13), (-0.12, 0.05, -0.06)])
def test_exact_poses_give_the_force_on_the_tissue_in_space(roll_rad: float, force_N: tuple[float, ...]) -> None:
    on_tip = np.array(force_N)
    tip, shaft = poses(on_tip, -0.07, 18.0, roll_rad)
    for seen in (shaft, None):
        found = estimator(SURE).estimate(tip, seen, Actuation(-0.07, roll_rad, 18.0, 0))
        assert found.converged and found.residual < 1e-3
        # without noise the prior of 1 N draws the weakest direction towards zero a little
        assert np.linalg.norm(found.force_N + on_tip) < 0.08 * np.linalg.norm(on_tip)


def test_a_third_pose_makes_the_force_surer_and_two_answer_as_without_it() -> None:
    on_tip, joints = np.array([0.05, 0.02, -0.1]), Actuation(-0.03, 0.3, 18.0, 0)
    tip, shaft, rear = poses(on_tip, -0.03, 18.0, 0.3, offsets_m=(0.0, OFFSET_m, 0.06))
    sensors = TrackedSensors(OFFSET_m, POSITION_STD_m, ANGLE_STD_rad, 0.06)
    by_three = SpatialRigEstimator(BLAZER, sensors, UNSURE).estimate(tip, shaft, joints, rear)
    by_two, alone = (
        made.estimate(tip, shaft, joints) for made in (SpatialRigEstimator(BLAZER, sensors, UNSURE), estimator(UNSURE))
    )
    assert np.array_equal(by_two.force_N, alone.force_N) and np.array_equal(by_two.covariance_N2, alone.covariance_N2)
    assert by_three.converged and by_three.residual < 1e-2
    assert np.linalg.norm(by_three.force_N + on_tip) < np.linalg.norm(by_two.force_N + on_tip)
    assert np.linalg.det(by_three.covariance_N2) < 0.5 * np.linalg.det(by_two.covariance_N2)
    with pytest.raises(InputError, match="pose_rear"):
        far = rear._replace(position_m=np.array([0.0, 0.0, 5.0]))
        SpatialRigEstimator(BLAZER, sensors, UNSURE).estimate(tip, shaft, joints, far)


def test_errors_of_the_actuation_are_followed_and_stated() -> None:
    rng, on_tip, normal = np.random.default_rng(3), np.array([0.05, 0.0, -0.12]), np.array([-0.05, 0.0, 0.12]) / 0.13
    joints = Actuation(-0.07, 0.3, 18.0, 0, normal)
    one = estimator(UNSURE, tangential_sd_N=0.02)
    stated = []
    for k in range(80):
        tip, shaft = poses(on_tip, -0.07 + 0.6e-3, 18.0, 0.3, rng)
        found = one.estimate(tip, shaft, joints._replace(stamp_ns=k * 25_000_000))
        stated.append(math.sqrt(found.covariance_N2[2, 2]))
    assert found.converged and found.lasting_covariance_N2 is not None
    assert stated[-1] < stated[0]  # insertion is learned
    assert one.errors.mean[0] == pytest.approx(0.6e-3, abs=3.0 * math.sqrt(one.errors.covariance[0, 0]))
    assert one.errors.covariance[0, 0] < 0.1 * 0.8e-3**2
    noise = found.covariance_N2 - found.lasting_covariance_N2
    assert np.linalg.eigvalsh(noise).min() > -1e-12 and np.linalg.eigvalsh(found.lasting_covariance_N2).min() > -1e-12


def test_a_lasting_force_along_the_wall_is_not_taken_for_an_error_of_the_joints() -> None:
    """The wall is tilted: its force along the wall is the same in each pose, 1.5 of its standard deviations.

    If the force is new in each pose the normalized squared error is 49.
    """
    on_tip, normal = np.array([0.0, 0.03, -0.12]), np.array([0.0, 0.0, 1.0])
    unsure = ActuationKnowledge((0.3e-3, 0.5, 0.02), (2e-3, 0.1, 0.02), (1e-4, 0.1, 0.005))
    rng, one, normalized = np.random.default_rng(9), estimator(unsure, tangential_sd_N=0.02), []
    for k in range(240):
        tip, shaft = poses(on_tip, -0.07, 18.0, 0.3, rng)
        found = one.estimate(tip, shaft, Actuation(-0.07, 0.3, 18.0, k * 25_000_000, normal, "contact"))
        error = found.force_N + on_tip
        normalized.append(float(error @ np.linalg.solve(found.covariance_N2, error)))
    assert found.converged
    assert np.mean(normalized[-80:]) < 5.0


def test_a_force_along_the_wall_is_forgotten_without_contact() -> None:
    normal, across = np.array([0.0, 0.0, 1.0]), np.eye(3)[:2]
    errors = LastingErrors(UNSURE, 0.02)
    errors.move_to(Actuation(-0.07, 0.0, 18.0, 0, normal, "contact"))
    known = errors.prior(across, ALL_JOINTS)
    assert np.sqrt(known.covariance[0, 0]) == pytest.approx(0.02)
    errors.learn(known, np.array([0.01, 0.0, 0.0, 0.0, 0.0]), known.covariance * 0.3)
    errors.move_to(Actuation(-0.07, 0.0, 18.0, 25_000_000, normal, "contact"))
    assert errors.prior(across, ALL_JOINTS).mean[0] == pytest.approx(0.009, rel=0.01)  # nine tenths of the variance last
    errors.move_to(Actuation(-0.07, 0.0, 18.0, 50_000_000, normal, "approach"))
    after = errors.prior(across, ALL_JOINTS)
    assert not after.mean[:2].any() and np.sqrt(after.covariance[0, 0]) == pytest.approx(0.02)
    assert np.linalg.eigvalsh(errors.prior(across, ALL_JOINTS).covariance).min() > 0.0


def test_a_backlash_wider_than_assumed_is_learned_from_its_flanks() -> None:
    on_tip, normal, half_m = np.array([0.0, 0.0, -0.12]), np.array([0.0, 0.0, 1.0]), 0.25e-3
    unsure = ActuationKnowledge((0.8e-3, 0.5, 0.02), (2e-3, 0.1, 0.02), (1e-4, 0.1, 0.005))
    missed_m = {}
    for flank_m in (0.3e-3, 0.0):
        rng, side, off_m = np.random.default_rng(4), 0.0, []
        one = estimator(replace(unsure, flank_m=flank_m), tangential_sd_N=0.02)
        for k in range(200):
            before_m, swing_m = (1e-3 * math.sin(0.06 * math.pi * i) for i in (k - 1, k))
            side = min(max(side + (swing_m - before_m) / half_m, -1.0), 1.0)
            tip, shaft = poses(on_tip, -0.07 + swing_m - half_m * side, 18.0, 0.3, rng)
            found = one.estimate(tip, shaft, Actuation(-0.07 + swing_m, 0.3, 18.0, k * 25_000_000, normal))
            assert found.converged
            off_m.append(one.errors.mean[0] + half_m * side)
        missed_m[flank_m] = float(np.std(off_m[100:]))
        if flank_m:
            learned, sd = one.errors.missing_backlash
            assert learned == pytest.approx(2.0 * half_m, abs=3.0 * sd) and sd < 0.12e-3
    assert missed_m[0.3e-3] < 0.5 * missed_m[0.0]


def test_the_covariance_is_true_when_the_world_is_drawn_from_what_it_states() -> None:
    rng, sd_N, stiffness_sd, normalized, inside = np.random.default_rng(5), 0.02, 0.05, [], []
    for _ in range(150):
        insertion, curvature, roll = rng.uniform(-0.078, -0.065), rng.uniform(8.0, 25.0), rng.uniform(-3.0, 3.0)
        normal = np.array([0.3 * rng.standard_normal(), 0.3 * rng.standard_normal(), 1.0])
        normal /= np.linalg.norm(normal)
        across = np.linalg.svd(normal[None, :])[2][1:]
        on_tip = -rng.uniform(0.02, 0.2) * normal + sd_N * rng.standard_normal(2) @ across
        off = rng.standard_normal(3) * UNSURE.start
        scaled = on_tip / (1.0 + stiffness_sd * rng.standard_normal())
        tip, shaft = poses(scaled, insertion + off[0], curvature + off[1], roll + off[2], rng)
        one = estimator(UNSURE, stiffness_sd=stiffness_sd, tangential_sd_N=sd_N)
        found = one.estimate(tip, shaft, Actuation(insertion, roll, curvature, 0, normal))
        if found.converged:
            error = found.force_N + on_tip
            normalized.append(error @ np.linalg.solve(found.covariance_N2, error))
            inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(found.covariance_N2)))
    assert len(normalized) >= 145
    assert 2.0 < np.mean(normalized) < 4.0
    assert 0.90 <= np.mean(inside) <= 0.98


def test_what_cannot_be_is_refused_by_both_models() -> None:
    rig = load_rig(SIMULATED_RIG)
    tip, shaft = poses(np.array([0.0, 0.0, -0.1]), -0.07, 18.0, 0.0)
    joints = Actuation(-0.07, 0.0, 18.0, 0)
    for made in (SpatialRigEstimator.from_rig(rig), PlanarRigEstimator.from_rig(rig)):
        with pytest.raises(InputError, match=r"pose_tip.position_m: found .*, wanted a position at most"):
            made.estimate(tip._replace(position_m=np.array([0.0, 0.0, 5.0])), shaft, joints)
        with pytest.raises(InputError, match="pose_tip"):
            made.estimate(tip._replace(position_m=np.full(3, np.nan)), shaft, joints)
        with pytest.raises(InputError, match="insertion_m"):
            made.estimate(tip, shaft, joints._replace(insertion_m=-0.2))
        odd = made.estimate(tip._replace(position_m=np.array([0.02, 0.03, -0.01])), None, joints)
        assert not odd.converged and np.isfinite(odd.force_N).all()


def test_the_rig_file_chooses_the_model() -> None:
    data = load_rig(SIMULATED_RIG).effective()
    for name, kind in (("planar", PlanarRigEstimator), ("spatial", SpatialRigEstimator)):
        bare = {"model": name, "adaptation": False, "contact_watch": False}
        rig = parse_rig({**data, "estimation": {**data["estimation"], **bare}})
        assert isinstance(make_estimator(rig), kind)


def test_uncertainty_grows_with_travel_and_is_bounded_by_the_start() -> None:
    errors = LastingErrors(UNSURE, 0.02)
    errors.move_to(Actuation(-0.07, 0.0, 18.0, 0))
    known = errors.prior(NOWHERE, ALL_JOINTS)
    errors.learn(known, np.array([1e-4, 0.1, 0.0]), np.diag([1e-10, 1e-4, 1e-8]))
    errors.move_to(Actuation(-0.06, 0.0, 18.0, 25_000_000))
    assert errors.covariance[0, 0] == pytest.approx(1e-10 + 5e-3**2 * 0.01 + 1e-4**2 * 0.025)
    assert errors.mean[0] == 1e-4
    for k in range(2, 40):
        errors.move_to(Actuation(-0.06 - 0.01 * (k % 2), 0.0, 18.0, k * 25_000_000))
    assert math.sqrt(errors.covariance[0, 0]) == pytest.approx(0.8e-3)
    errors.move_to(Actuation(-0.06, 0.0, 18.0, 10_000_000_000))
    assert not errors.mean.any()  # after a gap nothing is remembered


def test_a_knob_that_turns_to_and_fro_adds_no_uncertainty_and_one_that_goes_further_does() -> None:
    errors = LastingErrors(UNSURE, 0.02)
    for k in range(80):  # two swings of 4 1/m
        errors.move_to(Actuation(-0.07, 0.0, 18.0 + 2.0 * math.sin(math.pi * k / 20.0), k * 25_000_000))
    known = errors.prior(NOWHERE, ALL_JOINTS)
    errors.learn(known, known.mean, np.diag([1e-10, 1e-4, 1e-8]))
    for k in range(80, 160):
        errors.move_to(Actuation(-0.07, 0.0, 18.0 + 2.0 * math.sin(math.pi * k / 20.0), k * 25_000_000))
    by_time = 1e-4 + UNSURE.by_time[1] ** 2 * 80 * 0.025
    # The visited range is forgotten slowly, so each swing goes a little beyond it: 0.3 of 16 1/m.
    assert by_time < errors.covariance[1, 1] < by_time + UNSURE.by_travel[1] ** 2 * 0.4
    errors.move_to(Actuation(-0.07, 0.0, 21.0, 160 * 25_000_000))
    assert errors.covariance[1, 1] > by_time + UNSURE.by_travel[1] ** 2 * 0.9


def test_a_curvature_that_is_restated_leaves_the_errors_as_if_it_had_been_given_from_the_start() -> None:
    """The error of the curvature is 3 1/m, six standard deviations, of which some poses leave a part."""
    into, seen = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0.3, -0.1, 200.0, 1.0, 0.4]])
    states = []
    for restated in (True, False):
        errors, given_per_m = LastingErrors(UNSURE, 0.02), 18.0 if restated else 21.0
        for k in range(12):
            errors.move_to(Actuation(-0.07 + 2e-4 * k, 0.0, given_per_m - 0.3 * k, k * 25_000_000, into[0], "contact"))
            known = errors.prior(into, ALL_JOINTS)
            # A reading of force along the wall and joints, with a variance of 1; it shows the curvature's error.
            gain = known.covariance @ seen.T / (1.0 + seen @ known.covariance @ seen.T)
            reading = 0.02 * k + (21.0 - given_per_m) * seen[0, 3]
            mean = known.mean + gain[:, 0] * (reading - seen[0] @ known.mean)
            errors.learn(known, mean, known.covariance - gain @ seen @ known.covariance)
        if restated:
            assert 0.3 < errors.mean[1] < 2.7
            errors.restate_curvature(3.0)
        states.append(np.concatenate([errors.mean, errors.prior(into, ()).mean]))
    assert np.allclose(states[0], states[1], atol=1e-9)


def test_a_force_that_lasts_is_not_learned_as_an_error_of_the_joints() -> None:
    """While every pose expected no force to 1 N, exact poses showed 35 mN less than 0.2 N after 20 s."""
    one, into = SpatialRigEstimator.from_rig(load_rig(SIMULATED_RIG)), np.array([0.0, 0.0, 1.0])
    tip, shaft = poses(-0.2 * into, -0.082, 19.5, 0.0)
    for k in range(800):
        joints = Actuation(-0.082, 0.0, 19.5, 25_000_000 * k, into, "contact")
        found = one.estimate(tip._replace(stamp_ns=joints.stamp_ns), shaft._replace(stamp_ns=joints.stamp_ns), joints)
    assert found.force_N[2] == pytest.approx(0.2, abs=1e-3)
    assert np.allclose(one.errors.mean, 0.0, atol=1e-2)


def test_many_noisy_poses_have_no_mean_error_in_what_one_can_hardly_tell() -> None:
    """Information and slope of 1500 poses at the truth, summed. By each answer's own tangents the sum is 6.7 sd off."""
    rng, truth, known_information, off = np.random.default_rng(3), np.zeros(6), np.zeros((6, 6)), []
    exact = poses(np.array([0.0, 0.0, -0.2]), -0.082, 19.5, 0.0)
    prior = Prior(np.eye(3)[:2], ALL_JOINTS, np.zeros(5), np.diag(np.square([0.02, 0.02, 1e-3, 0.2, 0.1])))
    total, slope = {own: np.zeros((6, 6)) for own in (True, False)}, {own: np.zeros(6) for own in (True, False)}
    for k in range(1501):
        seen = exact if k == 0 else [noisy(pose, rng) for pose in exact]
        frame = TrackedFrame(
            rod_record(BLAZER, -0.082, 19.5)[:6].copy(),
            BLAZER.distal_length_m,
            np.array([-0.082, 19.5, 0.0]),
            np.array([0.0, OFFSET_m]),
            np.array([[*pose.position_m, *pose.quaternion_wxyz] for pose in seen]),
            POSITION_STD_m,
            ANGLE_STD_rad,
            *known_rows(prior, 30.0),
        )
        found, at = new_fit(2), new_fit(2)
        found.x[:3] = (0.0, 0.0, -0.2) if k == 0 else truth[:3]
        fit(frame, 1.0, found)
        if k == 0:
            truth, rows = found.x.copy(), frame.known[:, :3] @ found.by_x + frame.known[:, 3:]
            known_information = rows.T @ rows
            continue
        at.x[:] = truth
        refit(frame, found, at)
        for own, answer in ((True, found), (False, at)):
            total[own] += answer.information - known_information
            slope[own] += answer.information @ (answer.x - truth)
    for own in (True, False):
        covariance = np.linalg.inv(total[own] + known_information)
        off.append(float((covariance @ slope[own])[4] / math.sqrt(covariance[4, 4])))  # the curvature's error
    assert abs(off[0]) > 6.0 and abs(off[1]) < 2.5


def test_poses_bound_a_lasting_force_by_what_is_known_of_the_curvature() -> None:
    one = pose_information.of_one_pose()
    by_15_s = {sd: pose_information.deviations(one, 600, pose_information.KnownBefore(0.02, sd))[1] for sd in (0.2, 0.05)}
    assert by_15_s[0.2] == pytest.approx(0.012, rel=0.05) and by_15_s[0.05] == pytest.approx(0.0041, rel=0.05)
    assert pose_information.deviations(one, 600, pose_information.KnownBefore(1e-6, 1e3))[1] < 0.002


def test_a_press_of_three_seconds_in_hold_is_seen_and_does_not_change_the_next_force() -> None:
    """Where no force was expected in hold, it showed 36 mN of 100, and the contact that followed 160 of 200 mN."""
    into, found, held_N = np.array([0.0, 0.0, 1.0]), {}, {}
    for pressed_N in (0.0, 0.1):
        rng, one, forces = np.random.default_rng(1), SpatialRigEstimator.from_rig(load_rig(SIMULATED_RIG)), []
        phases = [("position", None, 0.0)] * 60 + [("hold", None, pressed_N)] * 120 + [("contact", into, 0.2)] * 60
        for k, (phase, commanded, force_N) in enumerate(phases):
            tip, shaft = poses(-force_N * into, -0.082, 25.0, 0.0, rng)
            answer = one.estimate(tip, shaft, Actuation(-0.082, 0.0, 25.0, 25_000_000 * k, commanded, phase))
            forces.append(float(answer.force_N @ into))
        held_N[pressed_N], found[pressed_N] = float(np.mean(forces[100:180])), float(np.mean(forces[-50:]))
    assert held_N[0.1] - held_N[0.0] == pytest.approx(0.1, abs=0.01)
    assert found[0.1] == pytest.approx(found[0.0], abs=0.005) and found[0.1] == pytest.approx(0.2, abs=0.02)


def test_the_lasting_part_is_what_exceeds_the_scatter_of_a_pose_alone() -> None:
    one = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
    more = np.outer([1.0, 2.0, -1.0], [1.0, 2.0, -1.0])
    assert np.allclose(lasting_part(one + more, one), more)
    assert np.allclose(lasting_part(0.3 * one, one), 0.0)  # the filter's memory alone makes it smaller: nothing lasts
    mixed = one + more - 0.5 * np.outer(one[0], one[0]) / one[0, 0]
    noise = mixed - lasting_part(mixed, one)
    assert np.linalg.eigvalsh(noise).min() > 0.0
    assert np.linalg.eigvalsh(one - noise).min() > -1e-12  # never more than the scatter of a pose alone


def test_a_sensor_out_of_reach_is_bad_input_from_python_too() -> None:
    far, q = np.array([0.0, 0.0, 5.0]), np.array([1.0, 0.0, 0.0, 0.0])
    wanted = r"sensors.0.position_m: found .*wanted a position at most"
    with pytest.raises(InputError, match=wanted):
        estimate_force(BLAZER, -0.07, 18.0, [(0.0, far, q)], case=2)
    with pytest.raises(InputError, match=wanted):
        estimate_force(BLAZER, -0.07, 18.0, [(0.0, far[1:], 0.0)], model="pcar")
    tip, shaft = poses(np.zeros(3), -0.07, 18.0, 0.0)
    rows = np.array([tip.position_m, far]), np.array([tip.quaternion_wxyz, q])
    with pytest.raises(InputError, match=r"sensors.0.position_m.1: found .*wanted a position at most"):
        estimate_force(BLAZER, -0.07, 18.0, [(0.0, *rows)], case=2)
    with pytest.raises(InputError, match=r"sensors.0.position_m.1: found .*wanted a position at most"):
        estimate_force(BLAZER, -0.07, 18.0, [(0.0, rows[0][:, 1:], np.zeros(2))], model="pcar")
    for running in (SpatialRigEstimator, PlanarRigEstimator):
        with pytest.raises(InputError, match=r"pose_shaft\.position_m"):
            actuation = Actuation(-0.07, 0.0, 18.0, tip.stamp_ns)
            running.from_rig(load_rig(SIMULATED_RIG)).estimate(tip, shaft._replace(position_m=far), actuation)


@pytest.mark.parametrize("case", [3, 4, 5, 6])
def test_sensors_further_apart_than_the_catheter_between_them_are_bad_input(case: int) -> None:
    """Both are within the reach of the catheter: what is wrong is only where they are relative to each other."""
    at, q = np.array([0.0, 0.0, 0.05]), np.array([1.0, 0.0, 0.0, 0.0])
    sensors = [(0.0, at, q), (0.002, -at, q), (0.004, -at, q)]
    catheter, wanted = load_catheter("livewire"), r"sensors.1.position_m.*: found .*mm from the sensor before it"
    with pytest.raises(InputError, match=wanted):
        estimate_force(catheter, 0.01, 10.0, sensors, case=case)
    with pytest.raises(InputError, match=wanted):
        many = [(offset, np.array([position] * 3), np.array([q] * 3)) for offset, position, _ in sensors]
        estimate_force(catheter, 0.01, 10.0, many, case=case)


def test_the_poses_of_one_frame_reach_the_estimator_together() -> None:
    """In lock step the shaft's pose is published before the tip's, which is what asks for an estimate."""
    rig, seen = load_rig(SIMULATED_RIG), []

    def asked(tip: Message, shaft: Message | None, stage: Message, state: Message | None) -> None:
        seen.append(None if shaft is None else tip.stamp_ns - shaft.stamp_ns)

    world = World(rig, simulated_plant(rig, 1), forkable_board("native"), 1)
    Scenario(rig, world, lambda topic, message: None, estimator=asked).run(2.0)
    assert len(seen) > 5 and set(seen[1:]) == {0}


@pytest.mark.parametrize(
    ("tilt_deg", "wound_rad", "share"), [(30.0, 0.0, 0.93), (30.0, 0.5, 0.97), (60.0, 0.0, 0.70), (60.0, 0.5, 0.90)]
)
def test_planar_force_on_a_tilted_wall(tilt_deg: float, wound_rad: float, share: float) -> None:
    """The rod's poses under 0.2 N along a commanded direction out of the plane, the shaft wound up by it or not."""
    tilt = math.radians(tilt_deg)
    into = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
    rig = load_rig(SIMULATED_RIG)
    one = PlanarRigEstimator.from_rig(rig)
    for k, force_N in enumerate([0.0] * 80 + [0.2] * 40):
        tip, shaft = poses(-force_N * into, -0.0778, 27.0, wound_rad if force_N else 0.0)
        found = one.estimate(tip, shaft, Actuation(-0.0778, 0.0, 27.0, 25_000_000 * k, into, "approach"))
    assert found.converged and found.force_N @ into == pytest.approx(0.2 * share, rel=0.03)


@pytest.mark.parametrize(("tilt_deg", "jump_rad", "kept"), [(30.0, 0.2, False), (0.0, 0.0, True)])
def test_the_roll_is_remembered_only_where_the_force_does_not_wind_up_the_shaft(
    tilt_deg: float, jump_rad: float, kept: bool
) -> None:
    """On a tilted wall the shaft turned by 0.2 rad from one pose to the next: the poses were refused, the wall was lost."""
    tilt = math.radians(tilt_deg)
    into = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
    one = SpatialRigEstimator.from_rig(load_rig(SIMULATED_RIG))
    for k, roll_rad in enumerate([0.0] * 80 + [jump_rad]):
        tip, shaft = poses(-0.2 * into, -0.0778, 27.0, roll_rad)
        found = one.estimate(tip, shaft, Actuation(-0.0778, 0.0, 27.0, 25_000_000 * k, into, "contact"))
    assert found.converged and found.force_N @ into == pytest.approx(0.2, rel=0.05)
    one.errors.move_to(Actuation(-0.0778, 0.0, 27.0, 25_000_000 * 81, into, "contact"))
    assert (math.sqrt(one.errors.covariance[2, 2]) < 0.05) == kept
