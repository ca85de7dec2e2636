"""Force from poses: exact without noise, at the Cramer-Rao bound with it, honest where the poses do not tell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from host.estimation import spatial_kernels as kernels
from host.estimation.contact_place import estimate_contact
from host.estimation.position_curve import MOST_ROOTS, STAYS, every_force, force_next_to
from host.estimation.sensor_noise import ORIENTATION_STD_rad, POSITION_STD_m, chi_square_limit
from host.estimation.spatial import LARGEST_FORCE_N, PoseSensor, SpatialEstimate, SurfacePrior, estimate_cosserat, sample
from host.estimation.spatial_batch import ForceTracker, estimate_batch
from host.estimation.spatial_residuals import ROWS_OF_CASE, SENSORS_OF_CASE
from host.mechanics.cosserat import CosseratSolution, PointLoad, solve_cosserat
from host.mechanics.rod import rod_record
from host.mechanics.rotations import quaternion_of_vector, quaternion_product, rotation_matrix
from host.mechanics.tip_shooting import load_number
from host.studies.benchmarks.estimation import RIGHT_N, problem, weights
from host.studies.benchmarks.spatial_cases import random_cases, sensed
from protocol.catheter import Catheter, load_catheter
from protocol.errors import InputError
from tests.host.rod_cases import random_catheter, unit

Array = NDArray[np.float64]

OFFSETS = (0.0, 0.03, 0.05)
LIVEWIRE, STEEROCATH, BLAZER = (load_catheter(name) for name in ("livewire", "steerocath_t", "blazer_prime_xp"))
INSERTION_m = 0.01
INPUTS_OF_A_POSITION = 60


def posed(
    catheter: Catheter, k0: float, force: Array, frame: str = "base", insertion: float = INSERTION_m, roll: float = 0.0
) -> CosseratSolution:
    return solve_cosserat(catheter, insertion, k0, force, frame, stations_m=OFFSETS, roll_rad=roll)


def sensors_of(found: CosseratSolution, noise: np.random.Generator | None = None, **covariances: Array) -> list[PoseSensor]:
    sensors = []
    for i, offset in enumerate(OFFSETS):
        position, quaternion = found.station_positions_m[i], found.station_quaternions_wxyz[i]
        if noise is not None:
            position = position + POSITION_STD_m * noise.normal(size=3)
            quaternion = quaternion_product(quaternion, quaternion_of_vector(ORIENTATION_STD_rad * noise.normal(size=3)))
        sensors.append(PoseSensor(offset, position, quaternion, **covariances))
    return sensors


def thesis_force(size: float, alpha: float) -> Array:
    """Section 5.3.1, put right."""
    return size * np.array([math.cos(alpha) / math.sqrt(2.0), -math.cos(alpha) / math.sqrt(2.0), math.sin(alpha)])


# Without noise


@pytest.mark.parametrize("case", [2, 4, 6])
@pytest.mark.parametrize("size", [0.02, 0.1, 0.2])
def test_noiseless_forces_of_any_direction_are_found_below_a_micronewton(case: int, size: float) -> None:
    for k0 in (10.0, 45.0):
        for alpha in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False):
            force = thesis_force(size, float(alpha))
            found = estimate_cosserat(STEEROCATH, INSERTION_m, k0, case, sensors_of(posed(STEEROCATH, k0, force, "tip")))
            assert found.converged and np.abs(found.force_N - force).max() < 1e-6 and found.residual < 1e-6
            assert found.force_frame == "tip" and found.solutions_N.shape == (1, 3)


@pytest.mark.parametrize("case", [2, 4, 6])
def test_the_soft_catheter_of_the_thesis_too(case: int) -> None:
    for size in (0.02, 0.2):
        for alpha in np.linspace(0.1, 2.0 * math.pi, 6, endpoint=False):
            force = thesis_force(size, float(alpha))
            found = estimate_cosserat(LIVEWIRE, INSERTION_m, 10.0, case, sensors_of(posed(LIVEWIRE, 10.0, force, "tip")))
            assert found.converged and np.abs(found.force_N - force).max() < 1e-6


@pytest.mark.slow
def test_a_soft_catheter_pulled_hard_is_found_on_its_branch() -> None:
    """0.3 N on the softest catheter: the tip-frame force is too sensitive to search for, the base-frame force is not."""
    found = posed(LIVEWIRE, 20.0, np.array([0.1, -0.05, 0.28]), insertion=0.04)
    for case in (2, 4):
        estimate = estimate_cosserat(LIVEWIRE, 0.04, 20.0, case, sensors_of(found))
        assert estimate.converged and np.abs(estimate.force_N - found.force_tip_N).max() < 1e-6


def test_sensitivities_against_differences() -> None:
    rng = np.random.default_rng(0)
    for case in range(1, 7):
        noisy = sensors_of(posed(STEEROCATH, 25.0, np.array([0.05, 0.08, -0.03])), rng)
        prior = SurfacePrior([0.0, 1.0, 1.0], 0.02)
        p = sample(rod_record(STEEROCATH, INSERTION_m, 25.0), case, noisy, prior, 0.2)
        s, m = kernels.new_scratch(len(p.stations)), int(ROWS_OF_CASE[case]) + 2
        x, h = np.array([0.06, 0.05, -0.02]), 1e-4
        kernels.cost_at(p, x, 0.2, True, s)
        exact, numeric = s.A[:m].copy(), np.empty((m, 3))
        for c in range(3):
            values = []
            for share in (1, -1, 2, -2):
                kernels.cost_at(p, x + share * h * np.eye(3)[c], 0.2, False, s)
                values.append(s.z[:m].copy())
            numeric[:, c] = -(8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h)
        assert np.abs(exact - numeric).max() < 1e-8 * np.abs(exact).max()


@pytest.mark.parametrize("insertion", [-0.02, 0.0, 0.03])
def test_any_insertion_even_with_sensors_inside_the_sheath(insertion: float) -> None:
    found = posed(BLAZER, 20.0, np.array([0.03, 0.02, -0.05]), insertion=insertion - 0.05)
    for case in (2, 4, 6):
        estimate = estimate_cosserat(BLAZER, insertion - 0.05, 20.0, case, sensors_of(found))
        assert estimate.converged and np.abs(estimate.force_N - found.force_tip_N).max() < 1e-6


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.floats(-3.0, 3.0))
def test_a_rolled_handle_changes_nothing_in_the_tip_frame(seed: int, roll: float) -> None:
    rng = np.random.default_rng(seed)
    found = posed(STEEROCATH, 20.0, 0.1 * unit(rng), roll=roll)
    estimate = estimate_cosserat(STEEROCATH, INSERTION_m, 20.0, 4, sensors_of(found), roll_rad=roll)
    assert estimate.converged and np.abs(estimate.force_N - found.force_tip_N).max() < 1e-6


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_what_the_relative_cases_do_not_need(seed: int) -> None:
    """Cases 5 and 6 do not see where the catheter is and how it is turned, case 4 not where it is; none sees q from -q."""
    rng = np.random.default_rng(seed)
    found = posed(STEEROCATH, 25.0, 0.08 * unit(rng))
    q, shift = quaternion_of_vector(rng.normal(size=3)), rng.normal(size=3)
    R = rotation_matrix(q)
    plain = sensors_of(found)
    moved = [PoseSensor(s.offset_m, R @ s.position_m + shift, quaternion_product(q, s.quaternion_wxyz)) for s in plain]
    slid = [PoseSensor(s.offset_m, np.asarray(s.position_m) + shift, s.quaternion_wxyz) for s in plain]
    flipped = [PoseSensor(s.offset_m, s.position_m, -np.asarray(s.quaternion_wxyz)) for s in plain]
    for case, other in ((6, moved), (4, slid), (2, flipped), (4, flipped), (6, flipped)):
        a, b = (estimate_cosserat(STEEROCATH, INSERTION_m, 25.0, case, poses) for poses in (plain, other))
        assert a.converged and b.converged and np.abs(a.force_N - b.force_N).max() < 1e-6


# With noise


def tried(case: int, draws: int, seed: int, thesis_weights: bool = False) -> tuple[float, float]:
    """Root mean square error over the bound, and mean squared error over the covariance told, of well-observed inputs."""
    rng = np.random.default_rng(seed)
    ratios, told = [], []
    for _ in range(8):
        catheter, k0 = random_catheter(rng), rng.uniform(15.0, 45.0)
        found = posed(catheter, k0, rng.uniform(0.02, 0.12) * unit(rng), insertion=0.0)
        if not found.converged:
            continue
        exact = sample(rod_record(catheter, 0.0, k0), case, sensors_of(found), None, 0.0)
        s, m = kernels.new_scratch(len(exact.stations)), int(ROWS_OF_CASE[case])
        kernels.cost_at(exact, found.force_tip_N, 0.4, True, s)
        bound = np.linalg.inv(s.A[:m].T @ s.A[:m])
        if math.sqrt(np.linalg.eigvalsh(bound)[-1]) > 0.02:
            continue
        W = np.diag([1.0 / 0.07] * (m if case < 5 else 0) + [0.5] * (0 if case < 5 else m))
        if case in (2, 4):
            W = np.diag([1.0 / 0.07] * 3 + [0.5] * (m - 3))
        square = 0.0
        for _ in range(draws):
            noisy = sample(rod_record(catheter, 0.0, k0), case, sensors_of(found, rng), None, 0.0)
            x = found.force_tip_N.copy()
            settled, _, _ = kernels.estimate(noisy._replace(whitening=W) if thesis_weights else noisy, 1.0, x, s)
            assert settled
            error = x - found.force_tip_N
            square += float(error @ error) / draws
            if not thesis_weights:
                told.append(float(error @ s.information @ error) / 3.0)
        ratios.append(math.sqrt(square / np.trace(bound)))
    assert len(ratios) >= 4
    return float(np.mean(ratios)), float(np.mean(told)) if told else 0.0


@pytest.mark.parametrize("case", [2, 4, 6])
def test_noisy_error_is_within_a_tenth_of_the_bound_and_the_covariance_is_true(case: int) -> None:
    ratio, told = tried(case, 250, case)
    assert abs(ratio - 1.0) < 0.1 and abs(told - 1.0) < 0.15


@pytest.mark.parametrize("case", [2, 4])
def test_the_thesis_unweighted_cost_is_worse(case: int) -> None:
    """A few per cent only: its weights happen to lie near those of the tracker. The same draws on both sides."""
    assert tried(case, 60, case, thesis_weights=True)[0] > tried(case, 60, case)[0] + 0.01


def test_covariance_follows_the_sensors() -> None:
    found = posed(STEEROCATH, 25.0, np.array([0.05, 0.08, -0.03]))
    plain = estimate_cosserat(STEEROCATH, INSERTION_m, 25.0, 2, sensors_of(found))
    worse = estimate_cosserat(
        STEEROCATH,
        INSERTION_m,
        25.0,
        2,
        sensors_of(
            found,
            position_covariance_m2=4.0 * POSITION_STD_m**2 * np.eye(3),
            orientation_covariance_rad2=4.0 * ORIENTATION_STD_rad**2 * np.eye(3),
        ),
    )
    assert np.allclose(worse.covariance_N2, 4.0 * plain.covariance_N2, rtol=1e-2)
    assert np.all(np.linalg.eigvalsh(plain.covariance_N2) > 0.0)
    assert abs(plain.weakest_std_N**2 - np.linalg.eigvalsh(plain.covariance_N2)[-1]) < 1e-12


def test_a_straight_catheter_says_that_the_axial_force_is_not_seen() -> None:
    found = posed(STEEROCATH, 0.0, np.array([0.0, 0.0, 0.0]))
    estimate = estimate_cosserat(STEEROCATH, INSERTION_m, 0.0, 2, sensors_of(found))
    assert estimate.converged and np.all(np.isfinite(estimate.covariance_N2))
    assert abs(estimate.weakest_direction[2]) > 0.999 and estimate.weakest_std_N > 1.0
    assert any("weakly observed" in warning for warning in estimate.warnings)


def test_a_very_wrong_curvature_is_noticed_and_a_somewhat_wrong_one_cannot_be() -> None:
    """A force bends the shaft nearly as curvature does: 3 1/m too little is made up for by 0.06 N, within the noise."""
    found = posed(STEEROCATH, 25.0, np.array([0.02, 0.03, 0.0]))
    slightly, very = (estimate_cosserat(STEEROCATH, INSERTION_m, k0, 2, sensors_of(found)) for k0 in (22.0, 15.0))
    assert any("larger residual" in warning or "no force" in warning for warning in very.warnings)
    assert slightly.converged and np.linalg.norm(slightly.force_N - found.force_tip_N) > 0.03


def test_a_known_surface_normal_sharpens_the_estimate() -> None:
    normal = np.array([0.3, 0.2, -1.0])
    force = 0.1 * normal / np.linalg.norm(normal)
    found = posed(STEEROCATH, 20.0, force)
    plain = estimate_cosserat(STEEROCATH, INSERTION_m, 20.0, 6, sensors_of(found))
    helped = estimate_cosserat(STEEROCATH, INSERTION_m, 20.0, 6, sensors_of(found), prior=SurfacePrior(normal, 0.005))
    assert helped.converged and np.abs(helped.force_N - found.force_tip_N).max() < 1e-5
    assert np.trace(helped.covariance_N2) < 0.8 * np.trace(plain.covariance_N2)


# Several answers, no answer


@pytest.mark.parametrize("case", [1, 3])
def test_a_position_alone_gives_every_force_that_grows_from_zero(case: int) -> None:
    """The truth is among the answers of every input and first in nearly all; from the last force no answer leaps away.

    Near a fold two exact answers lie closer to each other than the last force to either: then one of the two is right.
    """
    rng, first, right = np.random.default_rng(130 + case), 0, 0
    inputs = random_cases(INPUTS_OF_A_POSITION, 130 + case)
    for sample_ in inputs:
        p = problem(case, sample_, *sensed(sample_), weights(case))
        scratch, forces, x = kernels.new_scratch(len(p.stations)), np.empty((MOST_ROOTS, 3)), np.zeros(3)
        count, _ = every_force(p, LARGEST_FORCE_N, kernels.NEGLIGIBLE, forces, scratch)
        apart = np.linalg.norm(forces[:count] - sample_.force_tip_N, axis=1)
        assert count and apart.min() < RIGHT_N
        first += bool(apart[0] < RIGHT_N)
        before = sample_.force_tip_N + 0.02 * np.linalg.norm(sample_.force_tip_N) * unit(rng)
        x[:] = before
        settled, cost, _ = force_next_to(p, LARGEST_FORCE_N, kernels.NEGLIGIBLE, x, scratch)
        near_N = max(STAYS / load_number(p.whole_rod, 1.0), float(np.linalg.norm(sample_.force_tip_N - before)))
        assert settled and cost < kernels.NEGLIGIBLE and np.linalg.norm(x - before) < near_N + RIGHT_N
        right += bool(np.linalg.norm(x - sample_.force_tip_N) < RIGHT_N)
    assert min(first, right) >= 0.95 * len(inputs)


@pytest.mark.parametrize("case", [1, 3, 5])
def test_each_answer_of_a_case_that_is_not_one_to_one_explains_the_poses(case: int) -> None:
    rng = np.random.default_rng(case)
    for _ in range(6):
        k0 = _curvature(rng)
        found = posed(STEEROCATH, k0, rng.uniform(0.02, 0.2) * unit(rng))
        if not found.converged:
            continue
        estimate = estimate_cosserat(STEEROCATH, INSERTION_m, k0, case, sensors_of(found))
        assert estimate.converged and estimate.iterations < 30_000
        for force in estimate.solutions_N:
            again = solve_cosserat(STEEROCATH, INSERTION_m, k0, force, "tip", stations_m=OFFSETS)
            apart = again.station_positions_m - found.station_positions_m
            shown = apart[0] if case == 1 else apart[1] - apart[0]
            assert case == 5 or np.linalg.norm(shown) < 6.0 * math.sqrt(6.0) * POSITION_STD_m
            assert np.linalg.norm(force) <= 1.02 * LARGEST_FORCE_N


def _curvature(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.0, 45.0))


def test_case_5_has_several_answers_the_truth_among_them_and_a_warning() -> None:
    rng, several = np.random.default_rng(1), 0
    for _ in range(10):
        k0 = _curvature(rng)
        found = posed(STEEROCATH, k0, rng.uniform(0.05, 0.2) * unit(rng))
        if not found.converged:
            continue
        estimate = estimate_cosserat(STEEROCATH, INSERTION_m, k0, 5, sensors_of(found))
        apart = np.linalg.norm(estimate.solutions_N - found.force_tip_N, axis=1)
        assert estimate.converged and apart.min() < 2e-3 + 0.05 * estimate.weakest_std_N
        assert (len(estimate.solutions_N) > 1) == any("not one to one" in warning for warning in estimate.warnings)
        several += len(estimate.solutions_N) > 1
    assert several >= 5


@pytest.mark.parametrize("case", [1, 3, 5])
def test_with_the_last_force_known_the_branch_next_to_it_is_kept(case: int) -> None:
    found = posed(STEEROCATH, 30.0, np.array([0.06, 0.05, -0.04]))
    near = found.force_tip_N + np.array([0.002, -0.001, 0.001])
    estimate = estimate_cosserat(STEEROCATH, INSERTION_m, 30.0, case, sensors_of(found), previous_force_N=near)
    assert estimate.converged and np.abs(estimate.force_N - found.force_tip_N).max() < 1e-5
    assert any("not one to one" in warning for warning in estimate.warnings)


@pytest.mark.parametrize("case", range(1, 7))
def test_an_unreachable_pose_is_said_in_bounded_time(case: int) -> None:
    sensors = [
        PoseSensor(offset, [0.1, 0.2 - 1.5 * offset, 0.3], quaternion_of_vector(np.array([0.0, 2.0 + i, 0.0])))
        for i, offset in enumerate(OFFSETS)
    ]
    estimate = estimate_cosserat(STEEROCATH, INSERTION_m, 20.0, case, sensors)
    assert not estimate.converged or case == 5
    assert estimate.residual > 0.05 or case == 5
    assert np.all(np.isfinite(estimate.force_N)) and np.all(np.isfinite(estimate.covariance_N2))
    assert estimate.iterations < 20_000 and (estimate.converged or "no force" in " ".join(estimate.warnings))


def test_a_tip_a_little_beyond_reach_is_said() -> None:
    found = posed(STEEROCATH, 0.0, np.zeros(3))
    for case in (1, 2):
        stretched = [
            PoseSensor(s.offset_m, np.asarray(s.position_m) + [0.0, 0.0, 0.012], s.quaternion_wxyz)
            for s in sensors_of(found)
        ]
        estimate = estimate_cosserat(STEEROCATH, INSERTION_m, 0.0, case, stretched)
        assert not estimate.converged and 0.1 < estimate.residual < 0.3


# Contact away from the tip


@pytest.mark.parametrize(
    ("place", "force"),
    [(0.0, [0.05, 0.08, -0.03]), (0.012, [0.05, 0.08, -0.03]), (0.025, [0.1, 0.05, 0.1]), (0.041, [0.1, 0.2, 0.1])],
)
def test_place_and_force_of_a_contact_from_three_poses(place: float, force: list[float]) -> None:
    found = solve_cosserat(STEEROCATH, INSERTION_m, 25.0, stations_m=OFFSETS, point_loads=[PointLoad(place, force)])
    estimate = estimate_contact(STEEROCATH, INSERTION_m, 25.0, sensors_of(found))
    in_tip = rotation_matrix(found.tip_quaternion_wxyz).T @ np.array(force)
    assert estimate.converged and abs(estimate.contact_offset_m - place) < 1e-7
    assert np.abs(estimate.force_N - in_tip).max() < 1e-6 and 0.0 < estimate.contact_offset_std_m < 0.01


def test_without_contact_the_place_is_not_known_and_a_tip_estimate_of_a_side_contact_warns() -> None:
    free = estimate_contact(STEEROCATH, INSERTION_m, 25.0, sensors_of(posed(STEEROCATH, 25.0, np.zeros(3))))
    assert any("place of the contact" in warning for warning in free.warnings)
    side = solve_cosserat(STEEROCATH, INSERTION_m, 25.0, stations_m=OFFSETS, point_loads=[PointLoad(0.03, [0.1, 0.2, 0.1])])
    at_tip = estimate_cosserat(STEEROCATH, INSERTION_m, 25.0, 4, sensors_of(side))
    assert any("larger residual" in warning or "no force" in warning for warning in at_tip.warnings)


# Streams and recordings


def recording(count: int) -> tuple[Array, Array, Array, Array]:
    """Curvatures (n,), true tip-frame forces (n, 3), positions (n, 3, 3), quaternions (n, 3, 4) of a slow motion."""
    curvature, force, positions, quaternions = [], [], [], []
    for i in range(count):
        t = i / 40.0
        k0 = 20.0 + 5.0 * math.sin(t)
        found = posed(STEEROCATH, k0, np.array([0.03 * math.cos(3 * t), 0.08, -0.05 + 0.02 * math.sin(5 * t)]))
        curvature.append(k0)
        force.append(found.force_tip_N)
        positions.append(found.station_positions_m)
        quaternions.append(found.station_quaternions_wxyz)
    return np.array(curvature), np.array(force), np.array(positions), np.array(quaternions)


@pytest.mark.slow
@pytest.mark.parametrize("case", [1, 2, 3, 4, 5, 6])
def test_tracker_and_batch_follow_a_recording(case: int) -> None:
    curvature, force, positions, quaternions = recording(40)
    count = int(SENSORS_OF_CASE[case])
    args = (OFFSETS[:count], positions[:, :count], quaternions[:, :count])
    ordered = estimate_batch(STEEROCATH, INSERTION_m, curvature, case, *args, ordered=True, workers=1)
    tracker = ForceTracker(STEEROCATH, case, OFFSETS[:count])
    steps = [tracker.update(INSERTION_m, k0, p, q) for k0, p, q in zip(curvature, args[1], args[2], strict=True)]
    assert np.all(ordered.converged) and all(step.converged[0] for step in steps)
    assert np.abs(ordered.force_N - np.concatenate([step.force_N for step in steps])).max() < 1e-9
    if case in (2, 4, 6):
        alone = estimate_batch(STEEROCATH, INSERTION_m, curvature, case, *args, workers=2)
        assert np.abs(alone.force_N - force).max() < 2e-6 and np.abs(ordered.force_N - force).max() < 2e-6
        single = estimate_cosserat(
            STEEROCATH,
            INSERTION_m,
            curvature[7],
            case,
            [PoseSensor(o, positions[7, i], quaternions[7, i]) for i, o in enumerate(OFFSETS)],
        )
        assert np.allclose(single.covariance_N2, alone.covariance_N2[7], rtol=2e-2, atol=1e-9)


def test_a_batch_with_a_bad_sample_marks_that_one() -> None:
    curvature, force, positions, quaternions = recording(12)
    positions[5, :, 1] += 0.1
    found = estimate_batch(STEEROCATH, INSERTION_m, curvature, 2, OFFSETS[:1], positions[:, :1], quaternions[:, :1])
    assert list(np.flatnonzero(~found.converged)) == [5] and found.residual[5] > 0.1
    good = np.arange(12) != 5
    assert np.abs(found.force_N[good] - force[good]).max() < 2e-6


def test_a_tracker_recovers_after_a_gap() -> None:
    curvature, force, positions, quaternions = recording(3)
    tracker = ForceTracker(STEEROCATH, 4, OFFSETS[:2])
    lost = tracker.update(INSERTION_m, curvature[0], positions[0, :2] + [[0.0], [0.1]], quaternions[0, :2])
    assert not lost.converged[0]
    found = tracker.update(INSERTION_m, curvature[1], positions[1, :2], quaternions[1, :2])
    assert found.converged[0] and np.abs(found.force_N[0] - force[1]).max() < 2e-6
    tracker.forget()
    assert tracker.update(INSERTION_m, curvature[2], positions[2, :2], quaternions[2, :2]).converged[0]


def test_chi_square_limits() -> None:
    for freedom, deviations, wanted in ((3, 3.09, 16.3), (6, 3.09, 22.5), (1, 1.645, 3.84)):
        assert abs(chi_square_limit(freedom, deviations) / wanted - 1.0) < 0.04


# Bad input


def attempt(**change: object) -> SpatialEstimate:
    good: dict = {
        "catheter": STEEROCATH,
        "insertion_m": 0.01,
        "curvature_per_m": 20.0,
        "case": 4,
        "sensors": [PoseSensor(0.0, [0.0, 0.0, 0.08], [1, 0, 0, 0]), PoseSensor(0.03, [0, 0, 0.05], [1, 0, 0, 0])],
    }
    return estimate_cosserat(**(good | change))


def second(**change: object) -> list[PoseSensor]:
    return [
        PoseSensor(0.0, [0.0, 0.0, 0.08], [1, 0, 0, 0]),
        PoseSensor(**({"offset_m": 0.03, "position_m": [0, 0, 0.05], "quaternion_wxyz": [1, 0, 0, 0]} | change)),
    ]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"case": 7}, "case"),
        ({"case": True}, "case"),
        ({"case": 6}, "sensors"),
        ({"insertion_m": -0.08}, "insertion_m"),
        ({"curvature_per_m": math.nan}, "curvature_per_m"),
        ({"roll_rad": math.inf}, "roll_rad"),
        ({"sensors": second(quaternion_wxyz=[1, 0.1, 0, 0])}, "sensors.1.quaternion_wxyz"),
        ({"sensors": second(position_m=[0, math.nan, 0])}, "sensors.1.position_m"),
        ({"sensors": second(offset_m=-0.01)}, "sensors.offset_m"),
        ({"sensors": second(offset_m=0.0)}, "sensors.offset_m"),
        ({"sensors": second(position_covariance_m2=-np.eye(3))}, "sensors.1.position_covariance_m2"),
        ({"sensors": second(orientation_covariance_rad2=np.eye(2))}, "sensors.1.orientation_covariance_rad2"),
        ({"previous_force_N": [0.0, math.nan, 0.0]}, "previous_force_N"),
        ({"largest_force_N": 0.0}, "largest_force_N"),
        ({"prior": SurfacePrior([0, 0, 0], 0.1)}, "prior.normal"),
        ({"prior": SurfacePrior([0, 0, 1], 0.0)}, "prior.tangential_std_N"),
    ],
)
def test_bad_input_is_named(change: dict, key: str) -> None:
    with pytest.raises(InputError) as error:
        attempt(**change)
    assert error.value.key == key


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"offsets_m": [0.0]}, "offsets_m"),
        ({"positions_m": np.full((2, 2, 3), math.nan)}, "positions_m"),
        ({"quaternions_wxyz": np.zeros((2, 2, 4))}, "quaternions_wxyz"),
        ({"case": 0}, "case"),
        ({"position_std_m": 0.0}, "position_std_m"),
        ({"quaternions_wxyz": np.zeros((2, 3, 4))}, "quaternions_wxyz"),
    ],
)
def test_bad_batches_are_named(change: dict, key: str) -> None:
    good: dict = {
        "catheter": STEEROCATH,
        "insertion_m": 0.01,
        "curvature_per_m": 20.0,
        "case": 4,
        "offsets_m": [0.0, 0.03],
        "positions_m": np.zeros((2, 2, 3)),
        "quaternions_wxyz": np.tile([1.0, 0.0, 0.0, 0.0], (2, 2, 1)),
    }
    with pytest.raises(InputError) as error:
        estimate_batch(**(good | change))
    assert error.value.key == key
