"""The force kernel and the rig's shape against closed forms and coarse independent computations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import cont2discrete

from host.diagnosis.estimation.fit import free, jacobian, size_of
from host.diagnosis.model.force_kernel import along, run_axis, slot_array
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.models.axis import stages
from host.diagnosis.models.rig_kernel import Handle, Loads, ShaftBuild, Wall, contact, matrices, rotation_logs, shapes
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal
from tests.host.diagnosis import rig_cases


def axis(
    u: np.ndarray, dt: float, linear: list[float], slots: dict[str, float], begin: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Free run with linear interpolation of u."""
    return run_axis(
        stages(u, 2, "linear"),
        2,
        dt,
        np.array(linear),
        slot_array([slots]),
        np.array(begin),
        np.zeros(u.size),
        np.zeros(0),
        np.zeros((1, u.size)),
        0.0,
        0.0,
    )


def test_a_linear_axis_runs_by_one_matrix_as_it_does_step_by_step() -> None:
    """A friction of no size takes the general way."""
    u = np.random.default_rng(4).normal(size=400)
    slots, begin = {"viscous": 0.3, "constant": 0.1}, (0.1, 0.2)
    by_matrix, by_steps = (
        axis(u, 0.01, [0.5, 3.0, 30.0, 0.2], {**slots, "coulomb": friction}, begin) for friction in (0.0, 1e-300)
    )
    np.testing.assert_allclose(by_matrix, by_steps, rtol=0.0, atol=1e-12)


def test_cubic_oscillator_matches_an_adaptive_integrator() -> None:
    dt, t = 0.005, np.arange(0, 4, 0.005)
    u = np.sin(3 * t) + 0.4 * np.sin(7.3 * t)

    def rhs(s: float, y: np.ndarray) -> list[float]:
        return [y[1], np.interp(s, t, u) - 0.3 * y[1] - 20 * y[0] - 60 * y[0] ** 3]

    wanted = solve_ivp(rhs, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    assert np.max(np.abs(axis(u, dt, [1.0, 0.3, 20.0, 0.0], {"cubic": 60.0})[0] - wanted)) < 1e-5


@pytest.mark.parametrize(("hold", "method"), [("zero", "zoh"), ("linear", "foh")])
@pytest.mark.parametrize("row", [0, 1, 2], ids=["position", "velocity", "acceleration"])
def test_run_of_a_linear_axis_is_the_exact_discretization(hold: str, method: str, row: int) -> None:
    m, c, k, dt = 1.3, 2.0, 60.0, 0.01
    u = np.random.default_rng(0).normal(size=400)
    A, B = np.array([[0.0, 1.0], [-k / m, -c / m]]), np.array([[0.0], [1.0 / m]])
    C, D = np.array([[1.0, 0.0], [0.0, 1.0], A[1]]), np.array([[0.0], [0.0], [1.0 / m]])
    Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, C, D), dt, method)
    wanted = np.zeros((3, u.size))
    state = -held_state(A, B, dt) * u[0] if method == "foh" else np.zeros((2, 1))
    for i, value in enumerate(u):
        wanted[:, i] = (Cd @ state + Dd * value)[:, 0]
        state = Ad @ state + Bd * value
    run = run_axis(
        stages(u, 3, hold),
        3,
        dt,
        np.array([m, c, k, 0.0]),
        slot_array([]),
        np.zeros(2),
        np.zeros(u.size),
        np.zeros(0),
        np.zeros((1, u.size)),
        0.0,
        0.0,
    )
    assert np.max(np.abs(run[row] - wanted[row])) < 1e-6 * np.max(np.abs(wanted[row]))


def held_state(A: np.ndarray, B: np.ndarray, dt: float) -> np.ndarray:
    """State of scipy's first-order hold at rest: it holds x - Gamma2 u (Franklin, Powell, Workman 1998, ch. 6)."""
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 2:3], whole[2, 3] = A * dt, B * dt, 1.0
    return np.asarray(expm(whole)[:2, 3:4])


def test_coulomb_friction_holds_without_creeping() -> None:
    out = axis(np.full(2000, 0.9), 0.001, [1.0, 0.0, 0.0, 0.0], {"coulomb": 1.0})
    assert np.max(np.abs(out[0])) == 0.0


def test_coulomb_friction_slows_at_a_constant_rate() -> None:
    out = axis(np.zeros(1000), 0.001, [2.0, 0.0, 0.0, 0.0], {"coulomb": 1.0}, (0.0, 0.3))
    assert out[1][400] == pytest.approx(0.3 - 0.5 * 0.4, abs=2e-3)
    assert out[1][-1] == 0.0 and out[0][-1] == pytest.approx(0.3**2 / (2 * 0.5), rel=0.01)


def test_forces_along_a_motion_add_up() -> None:
    t = np.arange(0, 2, 0.01)
    x, v = np.sin(t), np.cos(t)
    one = along(x, v, -x, np.ones(t.size), t, 0.01, 1e-3, 0.0, slot_array([{"viscous": 2.0}]))
    two = along(x, v, -x, np.ones(t.size), t, 0.01, 1e-3, 0.0, slot_array([{"cubic": 3.0}]))
    both = along(x, v, -x, np.ones(t.size), t, 0.01, 1e-3, 0.0, slot_array([{"viscous": 2.0}, {"cubic": 3.0}]))
    assert np.allclose(one + two, both) and np.allclose(one, 2 * v)


@pytest.mark.parametrize("frequency_Hz", [1.0, 4.0, 8.0])
def test_a_second_mass_pulls_along_a_fast_motion_as_its_transfer_function_does(frequency_Hz: float) -> None:
    """A motion that was held for each sample led the mass by half of one: its spring pulled in proportion to the speed."""
    t, omega = np.arange(0, 8, 0.01), 2.0 * np.pi * frequency_Hz
    own, ratio, mass = 2.0 * np.pi * 5.8, 0.2, 0.3
    x, v, a = np.sin(omega * t), omega * np.cos(omega * t), -(omega**2) * np.sin(omega * t)
    p = slot_array([{"second_mass": mass, "second_omega": own, "second_damping": ratio}])
    pull = along(x, v, a, np.zeros(t.size), t, 0.01, 1e-3, 0.0, p)
    s = 1j * omega
    law = mass * s**2 * (2.0 * ratio * own * s + own**2) / (s**2 + 2.0 * ratio * own * s + own**2)
    wanted = np.imag(law * np.exp(s * t))
    assert np.max(np.abs(pull - wanted)[300:]) < 0.004 * np.max(np.abs(wanted))


def shape(
    d: float, roll: float, kappa: float, force: np.ndarray, load: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, ...]:
    """One sample of the kernel."""
    one = np.ones(1)
    return shapes(
        Handle(d * one, roll * one, kappa * one),
        Loads(force[:, None], np.zeros((3, 1)), np.array(load)[:, None], np.zeros((3, 1)), np.zeros(1)),
        ShaftBuild(one / rig_cases.EI, rig_cases.EI / rig_cases.GJ, rig_cases.DISTAL, rig_cases.BEHIND),
        np.array([0.0, 0.0, 1.0]),
    )


def test_straight_shaft_bends_as_a_cantilever() -> None:
    force, L = 0.02, 0.04
    tip, tip_R, *_ = shape(-0.07, 0.0, 1e-9, np.array([0.0, -force, 0.0]))
    assert tip[1, 0] == pytest.approx(-force * L**3 / (3 * rig_cases.EI), rel=1e-6)
    assert rotation_logs(np.eye(3)[:, :, None], tip_R)[0, 0] == pytest.approx(force * L**2 / (2 * rig_cases.EI), rel=1e-6)


def test_straight_shaft_sags_under_an_even_load() -> None:
    weight, L = 0.3, 0.04
    tip, tip_R, *_ = shape(-0.07, 0.0, 1e-9, np.zeros(3), (0.0, -weight, 0.0))
    assert tip[1, 0] == pytest.approx(-weight * L**4 / (8 * rig_cases.EI), rel=1e-6)
    assert rotation_logs(np.eye(3)[:, :, None], tip_R)[0, 0] == pytest.approx(weight * L**3 / (6 * rig_cases.EI), rel=1e-6)


def test_an_even_load_on_a_bent_shaft_is_the_sum_of_point_loads() -> None:
    roll, kappa, load = 0.6, 14.0, np.array([0.3, -0.2, 0.1])
    tip, *_, free, _ = shape(-0.06, roll, kappa, np.zeros(3), tuple(load))
    bare, *_ = shape(-0.06, roll, kappa, np.zeros(3))
    length, parts = rig_cases.DISTAL - 0.06, 60
    total = np.zeros(3)
    for k in range(parts):
        share = (k + 0.5) / parts
        at, at_R, *_ = shape(share * length - rig_cases.DISTAL, roll, kappa, load * length / parts)
        rest, rest_R, *_ = shape(share * length - rig_cases.DISTAL, roll, kappa, np.zeros(3))
        turned = at_R[:, :, 0] @ rest_R[:, :, 0].T
        total += at[:, 0] - rest[:, 0] + (turned - np.eye(3)) @ (bare[:, 0] - rest[:, 0])
    assert np.allclose(tip[:, 0] - bare[:, 0], total, rtol=2e-2, atol=1e-7)
    assert np.allclose(free, tip)


@pytest.mark.parametrize("seed", range(4))
def test_bent_and_rolled_shaft_matches_rigid_segments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, roll, kappa, force = rng.uniform(-0.075, -0.06), rng.uniform(-2, 2), rng.uniform(5, 25), rng.uniform(-0.15, 0.15, 3)
    tip, tip_R, shaft, shaft_R, free, _ = shape(d, roll, kappa, force)
    points, frames = rig_cases.shape(d, roll, kappa)
    length = rig_cases.DISTAL + d
    for position, R, upto in ((tip, tip_R, 1.0), (shaft, shaft_R, 1.0 - rig_cases.BEHIND / length)):
        p, frame = rig_cases.bent(points, frames, force, upto)
        assert np.allclose(position[:, 0], p, atol=1e-5)
        assert np.max(np.abs(rotation_logs(R, frame[:, :, None]))) < 2e-3
    assert np.allclose(free[:, 0], points[-1], atol=2e-6)


def test_contact_is_the_equilibrium_of_two_springs() -> None:
    gap = np.array([-1e-3, 0.0, 1e-3, 2e-3])
    force = contact(gap, np.full(4, 0.01), Wall(np.full(4, 500.0), 1.0, 1e-3, 0.0, 0.0, 0.0, 0.0), 0.01)
    assert np.allclose(force, np.maximum(gap, 0) / (1 / 500 + 0.01))
    bent = contact(gap, np.full(4, 0.01), Wall(np.full(4, 500.0), 1.5, 1e-3, 0.0, 0.0, 0.0, 0.0), 0.01)
    depth = gap - 0.01 * bent
    assert np.allclose(bent[2:], 500 * 1e-3 * (depth[2:] / 1e-3) ** 1.5, atol=1e-6)


def test_quaternions_become_rotations() -> None:
    q = np.array([[np.cos(0.2)], [0.0], [0.0], [np.sin(0.2)]])
    assert rotation_logs(np.eye(3)[:, :, None], matrices(q))[:, 0] == pytest.approx([0, 0, 0.4])


def test_slopes_of_the_nominal_parameters_are_those_of_the_smallest_step(tmp_path: Path) -> None:
    nominal, files = rig_cases.write(tmp_path, rig_cases.Truth(), 3, recordings=1)
    model, problem, _ = prepare(read_nominal(nominal), files)
    fit = fit_nominal(problem)
    base = problem.stacked((), fit.values)
    J = jacobian(problem, (), fit.values, base, [size_of(p, v) for p, v in zip(model.parameters, fit.values, strict=True)])
    for name in ("insertion_offset", "wall_distance"):
        index = [p.name for p in model.parameters].index(name)
        moved = fit.values.copy()
        moved[index] += 1e-8
        slope = (base - problem.stacked((), moved)) / 1e-8 * model.parameters[index].step
        place = free(list(model.parameters)).index(index)
        assert np.linalg.norm(J[:, place] - slope) < 0.05 * np.linalg.norm(slope)
