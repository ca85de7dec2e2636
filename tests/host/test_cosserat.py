"""The rod: closed forms, references at 1e-12, Jacobians, branches and their ends, several loads, bad input."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import simpson
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from host.mechanics import pcar
from host.mechanics.base_force import robust_branch, solve_cold, solve_warm
from host.mechanics.branch import CONVERGED, FOLD
from host.mechanics.cosserat import CosseratSolution, PointLoad, solve_cosserat
from host.mechanics.cosserat_kernels import ALL_TANGENTS, EXACT, FINE, POSE, ROW, WORK, sweep
from host.mechanics.rod import rod_record
from host.mechanics.rotations import (
    conjugate,
    quaternion_of_matrix,
    quaternion_of_vector,
    quaternion_product,
    rotation_matrix,
    vector_of_quaternion,
)
from host.mechanics.stability import unstable_modes
from host.mechanics.tip_shooting import QUICK_BELOW, load_number
from protocol.catheter import Catheter, PcarParameters, load_catheter
from protocol.errors import InputError
from tests.host.rod_cases import SPATIAL, random_catheter, rod_of, uniform_catheter, unit
from tests.host.rotation_angle import angle_between
from tests.references import make_spatial

Array = NDArray[np.float64]

REFERENCES = json.loads((Path(make_spatial.__file__).with_name("spatial.json")).read_text(encoding="utf-8"))
STEEROCATH, LIVEWIRE = load_catheter("steerocath_t"), load_catheter("livewire")
NONE = np.zeros(0)


def rows_at(rod: Array, force: Array, stations: Array, bend: float = EXACT) -> Array:
    out = np.zeros((len(stations) + 1, ROW))
    sweep(rod, force, stations, bend, ALL_TANGENTS, out, np.zeros(WORK))
    return out


# Closed forms


@pytest.mark.parametrize("tension", [0.0, 1.0, 20.0])
@pytest.mark.parametrize("name", SPATIAL)
def test_an_unloaded_shaft_is_an_arc_for_any_tension(name: str, tension: float) -> None:
    catheter, k0, back = load_catheter(name), 25.0, np.array([0.0, 0.01, 0.035])
    found = solve_cosserat(catheter, 0.0, k0, tendon_tension_N=tension, stations_m=back)
    s = catheter.distal_length_m - back
    arc = np.column_stack([0.0 * s, -(1.0 - np.cos(k0 * s)) / k0, np.sin(k0 * s) / k0])
    assert np.abs(found.station_positions_m - arc).max() < 1e-12
    assert angle_between(found.tip_quaternion_wxyz, quaternion_of_vector(np.array([k0 * s[0], 0.0, 0.0]))) < 1e-11
    assert np.allclose(found.base_force_N, [0.0, 0.0, -tension]) and np.allclose(found.base_moment_Nm, 0.0)


def test_the_tendon_leaves_the_rod_where_the_body_begins() -> None:
    found = solve_cosserat(STEEROCATH, 0.02, 25.0, [0.01, 0.02, 0.0], tendon_tension_N=5.0)
    assert np.allclose(found.base_force_N, [0.01, 0.02, 0.0])
    bare = solve_cosserat(STEEROCATH, 0.02, 25.0, [0.01, 0.02, 0.0])
    assert np.array_equal(found.tip_position_m, bare.tip_position_m)


def test_the_body_stays_straight_without_load() -> None:
    found = solve_cosserat(STEEROCATH, 0.03, 40.0, stations_m=[0.07, 0.08])
    assert np.abs(found.station_positions_m - [[0.0, 0.0, 0.03], [0.0, 0.0, 0.02]]).max() < 1e-14


@pytest.mark.parametrize("name", SPATIAL)
def test_the_wrench_is_constant_in_space_and_its_moment_is_across_the_force(name: str) -> None:
    rod, force = rod_of(name, 0.02, 30.0), np.array([0.02, -0.03, 0.04])
    for row in rows_at(rod, force, np.linspace(0.0, 0.08, 9)):
        R, rho, n = rotation_matrix(row[6:10]), row[:3], row[3:6]
        moment = np.cross(n, rho)
        assert np.abs(R @ n - force).max() < 1e-12  # the force, seen from the tip
        assert np.abs(R @ moment - np.cross(-(R @ rho), force)).max() < 1e-13  # the moment about the section
        assert abs(moment @ n) < 1e-15


def test_what_is_conserved_along_each_part() -> None:
    rod, force = rod_of("steerocath_t", 0.03, 30.0), np.array([0.05, -0.1, 0.08])

    def energy(row: Array, c: Array, k0: float) -> float:
        m = np.cross(row[3:6], row[:3])
        return float(0.5 * m @ (c * m) + k0 * m[0] + row[5])

    rows = rows_at(rod, force, np.array([0.0, 0.02, 0.05, 0.07, 0.08]))
    shaft = [energy(row, rod[:3], rod[8]) for row in rows[:4]]
    body = [energy(row, rod[3:6], 0.0) for row in rows[3:]]
    assert np.ptp(shaft) < 1e-11 and np.ptp(body) < 1e-11


@pytest.mark.parametrize("slope_deg", [5.0, 40.0, 80.0])
def test_elastica_by_elliptic_integrals(slope_deg: float) -> None:
    """A straight cantilever, dead force across: with tip slope a, F = EI/L2 (K(p) - F(p, phi1))2, 2 p2 = 1 + sin a."""
    length, EI, a = 0.07, 2e-4, math.radians(slope_deg)
    p2 = 0.5 * (1.0 + math.sin(a))
    phi1 = math.asin(1.0 / math.sqrt(2.0 * p2))
    root = ellipk(p2) - ellipkinc(phi1, p2)
    force = EI / length**2 * root**2
    catheter = uniform_catheter(EI, 3e-4, 2e-4, length)
    found = solve_cosserat(catheter, 0.0, 0.0, [0.0, -force, 0.0])
    across = length * (1.0 - 2.0 / root * (ellipe(p2) - ellipeinc(phi1, p2)))
    along = length * math.sqrt(2.0 * math.sin(a)) / root
    assert np.abs(found.tip_position_m - [0.0, -across, along]).max() < 1e-11
    assert abs(angle_between(found.tip_quaternion_wxyz, np.array([1.0, 0.0, 0.0, 0.0])) - a) < 1e-10


def test_small_loads_bend_body_and_shaft_as_beams() -> None:
    p, d, l, F = STEEROCATH.cosserat, 0.04, 0.07, 1e-6
    assert p is not None
    for axis, EI, EbI in ((1, p.EI1, p.EbI1), (0, p.EI2, p.EbI2)):
        force = np.zeros(3)
        force[axis] = F
        tip = solve_cosserat(STEEROCATH, d, 0.0, force).tip_position_m[axis]
        beam = F * l**3 / (3 * EI) + F * ((d + l) ** 3 - l**3) / (3 * EbI)
        assert abs(tip / beam - 1.0) < 1e-7


def test_the_planar_rod_is_the_limit_of_many_arcs() -> None:
    EI, EbI, k0, force = 3e-4, 8e-4, 20.0, np.array([0.06, -0.05])
    catheter = Catheter(
        "both", 0.07, 0.00233, 0.0007, PcarParameters((EbI, EI), (0.07,)), random_catheter(np.random.default_rng(0)).cosserat
    )
    rod = solve_cosserat(_with_bending(catheter, EI, EbI), 0.03, k0, [0.0, -force[1], force[0]]).tip_position_m
    coarse, fine = (pcar.solve(pcar.arcs_of(catheter, 0.03, k0, cut), force).tip_position_m for cut in (0.0005, 0.00025))
    limit = fine + (fine - coarse) / 3.0
    assert np.abs(rod - [0.0, -limit[1], limit[0]]).max() < 1e-8 < np.abs(coarse - limit).max()


def _with_bending(catheter: Catheter, EI1: float, EbI1: float) -> Catheter:

    assert catheter.cosserat is not None
    return replace(catheter, cosserat=replace(catheter.cosserat, EI1=EI1, EbI1=EbI1))


# References at 1e-12, and the branch


def test_300_equilibria_up_to_a_load_number_of_62_are_on_the_references_branch() -> None:
    assert REFERENCES["seed"] == make_spatial.SEED and len(REFERENCES["uniform"]) == 300
    folds = 0
    for (stiffness, k0, force), wanted in zip(make_spatial.uniform_inputs(300), REFERENCES["uniform"], strict=True):
        rod = np.concatenate([1.0 / stiffness, 1.0 / stiffness, [0.07, 0.0, k0]])
        folds += _holds(rod, force, wanted, FINE, 1e-6, 5e-6) == FOLD
    assert folds == sum("fold" in entry for entry in REFERENCES["uniform"]) > 0


def test_whole_catheters_over_the_whole_range() -> None:
    for (name, insertion, k0, force), wanted in zip(make_spatial.catheter_inputs(40), REFERENCES["catheters"], strict=True):
        found = solve_cosserat(load_catheter(name), insertion, k0, force)
        assert found.converged == ("p" in wanted), (name, insertion, k0, force)
        if found.converged:
            assert np.abs(found.tip_position_m - wanted["p"]).max() < 1e-8
            assert angle_between(found.tip_quaternion_wxyz, np.array(wanted["q"])) < 1e-7
            assert found.stable and found.branch == "unloaded"
        else:
            assert abs(found.load_reached - wanted["fold"]) < 1e-4 and np.all(np.isnan(found.tip_position_m))


def _holds(rod: Array, force: Array, wanted: dict, bend: float, metres: float, radians: float) -> int:
    x, out = np.zeros(3), np.zeros((1, ROW))
    status, load, _, _, unstable = solve_cold(rod, force, NONE, bend, x, out, np.zeros(WORK))
    if "fold" in wanted:
        assert status == FOLD and abs(load - wanted["fold"]) < 1e-4
        return int(status)
    assert status == CONVERGED and unstable == 0
    assert np.abs(-out[0, :3] - wanted["p"]).max() < metres
    assert angle_between(conjugate(out[0, 6:10]), np.array(wanted["q"])) < radians
    return int(status)


def test_the_quick_way_and_the_robust_way_agree() -> None:
    rng, x, y, out = np.random.default_rng(3), np.zeros(3), np.zeros(3), np.zeros((1, ROW))
    for _ in range(120):
        rod = rod_record(random_catheter(rng), 0.0, rng.uniform(0.0, 60.0))
        force = rng.uniform(0.0, QUICK_BELOW) / load_number(rod, 1.0) * unit(rng)
        quick = solve_cold(rod, force, NONE, EXACT, x, out, np.zeros(WORK))
        robust = robust_branch(rod, force, NONE, EXACT, y, out)
        assert quick[0] == robust[0]
        assert quick[0] != CONVERGED or np.abs(x - y).max() < 1e-7


def test_a_warm_start_stays_next_to_its_start_or_says_that_it_cannot() -> None:
    rng, out = np.random.default_rng(4), np.zeros((1, ROW))
    stayed = 0
    for _ in range(150):
        rod = rod_record(random_catheter(rng), 0.0, rng.uniform(0.0, 45.0))
        force, cold, warm = rng.uniform(0.02, 0.25) * unit(rng), np.zeros(3), np.zeros(3)
        if solve_cold(rod, force, NONE, EXACT, cold, out, np.zeros(WORK))[0] != CONVERGED:
            continue
        warm[:] = cold + 0.02 * np.linalg.norm(force) * unit(rng)
        done, _ = solve_warm(rod, force, NONE, EXACT, warm, out, np.zeros(WORK))
        stayed += done
        assert not done or np.abs(warm - cold).max() < 1e-6
    assert stayed > 140


def test_start_is_used_and_reported() -> None:
    first = solve_cosserat(STEEROCATH, 0.02, 20.0, [0.05, 0.1, -0.02])
    near = solve_cosserat(STEEROCATH, 0.02, 20.0, [0.051, 0.1, -0.02], start=first)
    cold = solve_cosserat(STEEROCATH, 0.02, 20.0, [0.051, 0.1, -0.02])
    assert near.branch == "start" and cold.branch == "unloaded" and near.iterations < cold.iterations
    assert np.abs(near.tip_position_m - cold.tip_position_m).max() < 1e-10


def test_euler_buckling_is_where_stability_is_lost() -> None:
    """A straight shaft pushed along its axis: unstable from F = pi2 EI / (4 L2) on, in its softest direction."""
    EI, length = 2e-4, 0.07
    critical = math.pi**2 * EI / (4 * length**2)
    catheter = uniform_catheter(EI, 3e-4, 2e-4, length)
    for share, modes in ((0.97, 0), (1.03, 1), (1.45, 1), (1.55, 2)):
        found = solve_cosserat(catheter, 0.0, 0.0, [0.0, 0.0, -share * critical])
        assert found.converged and found.unstable_modes == modes and found.stable == (modes == 0)
        assert np.abs(found.tip_position_m - [0.0, 0.0, length]).max() < 1e-12


def test_equal_stiffness_loses_two_modes_at_once() -> None:
    EI, length = 2e-4, 0.07
    critical = math.pi**2 * EI / (4 * length**2)
    rod = rod_record(uniform_catheter(EI, EI, EI, length), 0.0, 0.0)
    for share, modes in ((0.95, 0), (1.05, 2), (8.9, 2), (9.1, 4)):
        assert unstable_modes(rod, np.array([0.0, 0.0, -share * critical]), np.zeros(WORK)) == modes


def test_a_fold_is_said_and_not_jumped() -> None:
    """Pushed head on while curved, the soft shaft snaps over: before that there is an answer, after it none."""
    index = next(i for i, entry in enumerate(REFERENCES["uniform"]) if "fold" in entry)
    stiffness, k0, force = list(make_spatial.uniform_inputs(300))[index]
    catheter, fold = uniform_catheter(*stiffness), REFERENCES["uniform"][index]["fold"]
    before, after = (solve_cosserat(catheter, 0.0, k0, share * fold * force) for share in (0.999, 1.001))
    assert before.converged and before.stable
    assert not after.converged and "fold" in after.reason and after.branch == "none"
    assert abs(after.load_reached * 1.001 - 1.0) < 1e-3


# Frames, Jacobians, several loads


@settings(max_examples=25)
@given(st.floats(-3.0, 3.0), st.integers(0, 10_000))
def test_rolling_everything_rolls_the_answer(roll: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    force, q = rng.uniform(0.0, 0.1) * unit(rng), quaternion_of_vector(np.array([0.0, 0.0, roll]))
    Z = rotation_matrix(q)
    plain = solve_cosserat(STEEROCATH, 0.01, 20.0, force, stations_m=[0.03])
    rolled = solve_cosserat(STEEROCATH, 0.01, 20.0, Z @ force, stations_m=[0.03], roll_rad=roll)
    assert plain.converged and rolled.converged
    assert np.abs(rolled.tip_position_m - Z @ plain.tip_position_m).max() < 1e-12
    assert np.abs(rolled.station_positions_m - plain.station_positions_m @ Z.T).max() < 1e-12
    assert angle_between(rolled.tip_quaternion_wxyz, quaternion_product(q, plain.tip_quaternion_wxyz)) < 1e-11
    assert np.abs(rolled.force_tip_N - plain.force_tip_N).max() < 1e-12
    assert np.abs(rolled.jacobian_force - np.kron(np.eye(2), Z) @ plain.jacobian_force @ Z.T).max() < 1e-8


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_the_mirror_image_of_a_load_has_the_mirror_image_of_the_shape(seed: int) -> None:
    rng = np.random.default_rng(seed)
    force, mirror = rng.uniform(0.0, 0.15) * unit(rng), np.array([-1.0, 1.0, 1.0])
    here, there = (solve_cosserat(STEEROCATH, 0.02, 30.0, f) for f in (force, mirror * force))
    assert here.converged == there.converged
    assert not here.converged or np.abs(here.tip_position_m - mirror * there.tip_position_m).max() < 1e-9


@pytest.mark.parametrize("frame", ["base", "tip"])
def test_a_force_and_the_same_force_in_the_other_frame_make_one_shape(frame: str) -> None:
    first = solve_cosserat(LIVEWIRE, 0.02, 15.0, [0.004, 0.006, 0.01], frame, stations_m=[0.0, 0.03, 0.08])
    other = "tip" if frame == "base" else "base"
    second = solve_cosserat(
        LIVEWIRE,
        0.02,
        15.0,
        first.force_tip_N if other == "tip" else first.force_base_N,
        other,
        stations_m=[0.0, 0.03, 0.08],
    )
    assert np.abs(first.station_positions_m - second.station_positions_m).max() < 1e-10
    assert np.abs(rotation_matrix(first.tip_quaternion_wxyz) @ first.force_tip_N - first.force_base_N).max() < 1e-10


def _difference(at: Callable[[float], CosseratSolution], h: float) -> Array:
    """Derivative (6,) of tip position and turn by differences of order 4."""
    centre = at(0.0)

    def change(x: float) -> Array:
        there = at(x)
        turn = vector_of_quaternion(quaternion_product(there.tip_quaternion_wxyz, conjugate(centre.tip_quaternion_wxyz)))
        return np.concatenate([there.tip_position_m - centre.tip_position_m, turn])

    return (8.0 * (change(h) - change(-h)) - (change(2 * h) - change(-2 * h))) / (12.0 * h)


LOADS = {"point_loads": [PointLoad(0.02, [0.02, 0.01, 0.0])], "distributed_N_per_m": [0.1, 0.2, 0.1]}
SCENES = [
    ("steerocath_t", 0.03, 25.0, [0.05, 0.1, -0.03], "base", -0.5, {}),
    ("steerocath_t", -0.02, 25.0, [0.05, 0.1, -0.03], "base", 0.7, {}),
    ("livewire", 0.01, 10.0, [0.01, 0.05, 0.02], "tip", 0.3, {}),
    ("steerocath_t", 0.03, 25.0, [0.05, 0.1, -0.03], "base", -0.5, LOADS),
    ("livewire", 0.04, 35.0, [0.02, 0.03, 0.3], "base", 0.0, {}),
]


@pytest.mark.parametrize(("name", "d", "k0", "force", "frame", "roll", "loads"), SCENES)
def test_jacobians_against_differences(
    name: str, d: float, k0: float, force: list[float], frame: str, roll: float, loads: dict
) -> None:
    catheter = load_catheter(name)

    def at(dF: Array = np.zeros(3), dd: float = 0.0, dk: float = 0.0, dr: float = 0.0) -> CosseratSolution:
        return solve_cosserat(catheter, d + dd, k0 + dk, np.array(force) + dF, frame, roll_rad=roll + dr, **loads)

    found = at()
    for i in range(3):
        numeric = _difference(lambda h, i=i: at(dF=h * np.eye(3)[i]), 5e-4)
        assert np.abs(found.jacobian_force[:, i] - numeric).max() < 1e-7 * np.abs(found.jacobian_force).max() + 1e-7
    for i, numeric in enumerate(
        (_difference(lambda h: at(dd=h), 1e-4), _difference(lambda h: at(dr=h), 1e-2), _difference(lambda h: at(dk=h), 0.1))
    ):
        assert np.abs(found.jacobian_actuation[:, i] - numeric).max() < 2e-7 * max(1.0, np.abs(numeric).max())


def test_sweep_tangents_against_differences_of_order_four() -> None:
    rod, force, stations = rod_of("steerocath_t", 0.02, 30.0), np.array([0.05, -0.08, 0.03]), np.array([0.0, 0.03, 0.08])
    rows = rows_at(rod, force, stations, 0.15)
    for lane, h in ((0, 1e-3), (1, 1e-3), (2, 1e-3), (3, 0.5)):

        def moved(x: float, lane: int = lane) -> Array:
            other, push = rod.copy(), force.copy()
            if lane < 3:
                push[lane] += x
            else:
                other[8] += x
            return rows_at(other, push, stations, 0.15)

        numeric = (8.0 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12.0 * h)
        for first, block in ((12, slice(0, 3)), (24, slice(3, 6))):
            assert np.abs(rows[:, first + lane : first + 12 : 4] - numeric[:, block]).max() < 2e-7
        for row, d_row in zip(rows, numeric, strict=True):
            turn = 2.0 * quaternion_product(conjugate(row[6:10]), d_row[6:10])[1:]
            assert np.abs(row[36 + lane : 48 : 4] - turn).max() < 2e-7


@pytest.mark.parametrize("insertion", [-0.03, 0.0, 0.03])
def test_several_loads_balance(insertion: float) -> None:
    """A point load at the tip is a tip force; the reactions at the base balance every load and its moment."""
    loads = [PointLoad(0.015, [0.03, -0.02, 0.01]), PointLoad(0.03, [0.0, 0.02, 0.02])]
    weight, force = np.array([0.2, -0.1, 0.3]), np.array([0.02, 0.03, -0.01])
    total = 0.07 + insertion
    back = np.concatenate([np.linspace(0.0, total, 401)])
    found = solve_cosserat(
        STEEROCATH, insertion, 20.0, force, stations_m=back, point_loads=loads, distributed_N_per_m=weight
    )
    assert np.allclose(found.base_force_N, force + np.sum([p.force_N for p in loads], axis=0) + weight * total, atol=1e-14)
    places = solve_cosserat(
        STEEROCATH, insertion, 20.0, force, stations_m=[0.015, 0.03], point_loads=loads, distributed_N_per_m=weight
    ).station_positions_m
    spread = np.array([simpson(np.cross(found.station_positions_m, weight)[:, i], x=back) for i in range(3)])
    moment = (
        np.cross(found.tip_position_m, force)
        + spread
        + sum(np.cross(r, p.force_N) for r, p in zip(places, loads, strict=True))
    )
    assert np.abs(found.base_moment_Nm - moment).max() < 1e-10

    as_load = solve_cosserat(STEEROCATH, insertion, 20.0, point_loads=[PointLoad(0.0, force)])
    as_force = solve_cosserat(STEEROCATH, insertion, 20.0, force)
    assert np.abs(as_load.tip_position_m - as_force.tip_position_m).max() < 1e-10


def test_a_distributed_load_is_the_limit_of_many_point_loads() -> None:
    weight = np.array([0.3, 0.5, -0.2])

    def split(n: int) -> Array:
        loads = [PointLoad((i + 0.5) * 0.08 / n, weight * 0.08 / n) for i in range(n)]
        return solve_cosserat(STEEROCATH, 0.01, 20.0, point_loads=loads).tip_position_m

    smooth = solve_cosserat(STEEROCATH, 0.01, 20.0, distributed_N_per_m=weight).tip_position_m
    coarse, fine = split(8), split(16)
    assert np.abs(fine + (fine - coarse) / 3.0 - smooth).max() < 2e-7 < np.abs(coarse - smooth).max()


def test_insertion_goes_down_to_zero_and_below_without_a_step() -> None:
    poses = [solve_cosserat(STEEROCATH, d, 20.0, [0.03, 0.05, -0.02]).tip_position_m for d in (-2e-7, -1e-7, 1e-7, 2e-7)]
    steps = np.diff(poses, axis=0)
    assert np.abs(steps).max() < 5e-7
    short = solve_cosserat(STEEROCATH, -0.069, 20.0, [0.03, 0.05, -0.02])
    assert short.converged and 0.0 < short.tip_position_m[2] < 0.001


def test_stations_come_in_the_order_asked_and_lie_straight_inside_the_sheath() -> None:
    force, asked = [0.02, 0.03, 0.0], [0.05, 0.0, 0.1, 0.03]
    found = solve_cosserat(STEEROCATH, 0.01, 20.0, force, stations_m=asked)
    for place, s in enumerate(asked):
        alone = solve_cosserat(STEEROCATH, 0.01, 20.0, force, stations_m=[s])
        assert np.abs(alone.station_positions_m[0] - found.station_positions_m[place]).max() < 1e-12
    assert np.array_equal(found.station_positions_m[1], found.tip_position_m)
    assert np.allclose(found.station_positions_m[2], [0.0, 0.0, -0.02], atol=1e-12)
    assert angle_between(found.station_quaternions_wxyz[2], np.array([1.0, 0.0, 0.0, 0.0])) < 1e-12


def test_a_coarser_sweep_keeps_what_it_promises() -> None:
    rng, out = np.random.default_rng(6), np.zeros((1, ROW))
    worst = 0.0
    for _ in range(200):
        catheter = random_catheter(rng)
        rod, force = rod_record(catheter, 0.0, rng.uniform(0.0, 45.0)), rng.uniform(0.02, 0.25) * unit(rng)
        sweep(rod, force, NONE, FINE, POSE, out, np.zeros(WORK))
        worst = max(worst, float(np.abs(out[0, :3] - rows_at(rod, force, NONE, 0.15)[0, :3]).max()))
    assert worst < 1e-6


def test_quaternions_and_matrices_agree() -> None:
    rng = np.random.default_rng(8)
    for angle in (0.0, 1e-9, 1e-5, 0.5, 2.0, 3.1, math.pi):
        v = angle * unit(rng)
        q = quaternion_of_vector(v)
        assert abs(np.linalg.norm(q) - 1.0) < 1e-15
        assert angle_between(quaternion_of_matrix(rotation_matrix(q)), q) < 1e-7
        assert np.abs(np.abs(vector_of_quaternion(q)) - np.abs(v)).max() < 1e-7


# Bad input


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"insertion_m": -0.07}, "insertion_m"),
        ({"insertion_m": math.nan}, "insertion_m"),
        ({"insertion_m": 5.0}, "insertion_m"),
        ({"curvature_per_m": math.inf}, "curvature_per_m"),
        ({"curvature_per_m": 1e4}, "curvature_per_m"),
        ({"force_N": [0.0, 0.0]}, "force_N"),
        ({"force_N": [0.0, math.nan, 0.0]}, "force_N"),
        ({"force_N": [0, 0, 1e4]}, "force_N"),
        ({"force_N": "x"}, "force_N"),
        ({"force_frame": "world"}, "force_frame"),
        ({"tendon_tension_N": -1.0}, "tendon_tension_N"),
        ({"stations_m": [-0.01]}, "stations_m"),
        ({"stations_m": [math.nan]}, "stations_m"),
        ({"roll_rad": math.nan}, "roll_rad"),
        ({"point_loads": [PointLoad(0.2, [0, 0, 0.1])]}, "point_loads.0.offset_m"),
        ({"point_loads": [PointLoad(0.0, [0, math.nan, 0.1])]}, "point_loads.0.force_N"),
        ({"distributed_N_per_m": [0.0, 0.0]}, "distributed_N_per_m"),
        ({"force_frame": "tip", "distributed_N_per_m": [1.0, 0.0, 0.0]}, "force_frame"),
    ],
)
def test_bad_input_is_named(change: dict, key: str) -> None:
    good: dict = {"catheter": STEEROCATH, "insertion_m": 0.01, "curvature_per_m": 10.0, "force_N": [0.0, 0.05, 0.0]}
    with pytest.raises(InputError) as error:
        solve_cosserat(**(good | change))
    assert error.value.key == key


def test_a_catheter_without_spatial_parameters_is_refused() -> None:
    with pytest.raises(InputError, match="cosserat"):
        solve_cosserat(load_catheter("thermocool_sf"), 0.01, 10.0)
