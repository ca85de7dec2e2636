"""Forms with memory, each against another formula: adaptive integration, spring and slider, brute force."""

from __future__ import annotations

import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from host.diagnosis.effects import library
from host.diagnosis.effects.dead_time import corner
from host.diagnosis.effects.missed_steps import change_points
from host.diagnosis.effects.reference import table
from host.diagnosis.effects.resonance import from_mode
from host.diagnosis.model import operators as op
from host.diagnosis.model.effect import Scale
from host.diagnosis.model.force_kernel import run_axis, slot_array

Array = np.ndarray
DT = 0.01
T = np.arange(0.0, 6.0, DT)


def swing(t: float | Array) -> Array:
    """A motion of three tones that neither begins nor ends at rest."""
    return np.asarray(np.sin(2.1 * t + 0.4) + 0.4 * np.sin(5.3 * t + 1.0) + 0.2 * np.sin(11.0 * t))


def answer(delay: float, lag: float, inertia: float, begin: float = -8.0) -> Array:
    """The second-order equation behind a dead time by an adaptive integrator, long under way at the first sample."""

    def rates(t: float, y: Array) -> list[float]:
        return [y[1], (float(swing(t - delay)) - y[0] - lag * y[1]) / inertia]

    run = solve_ivp(rates, (begin, T[-1]), [0.0, 0.0], "LSODA", t_eval=T, rtol=1e-8, atol=1e-10, max_step=0.05)
    return np.asarray(run.y[0])


@pytest.mark.parametrize(
    ("delay", "lag", "inertia"),
    [(0.0, 0.05, 0.004), (0.137, 0.05, 0.004), (0.083, 0.4, 0.02), (0.2, 0.3, 1e-4)],
    ids=["rings", "dead time, rings", "dead time, overdamped", "dead time and lag"],
)
def test_dead_time_and_second_order_solve_their_equation(delay: float, lag: float, inertia: float) -> None:
    x, wanted = swing(T), answer(delay, lag, inertia)
    found = op.delayed_second_order(x, DT, delay, lag, inertia, wanted[0] - x[0])
    settled = T > delay + 8.0 * max(lag, 2.0 * inertia / lag)
    assert np.max(np.abs(found - wanted)[settled]) < 2e-3
    rest = op.delayed_second_order(x, DT, delay, lag, inertia)
    first = T < 1.0
    assert np.std((found - wanted)[first]) < 0.5 * np.std((rest - wanted)[first])  # its beginning is that of a motion


def test_corners_of_the_family_have_the_ids_of_the_vocabulary() -> None:
    assert corner(np.array([0.1, 0.001, 0.0]))[0] == "latency"
    assert corner(np.array([0.001, 0.1, 0.0]))[0] == "rate_lag"
    assert corner(np.array([0.02, 0.02, 0.01]))[0] == "resonance"
    assert corner(np.array([0.3, 0.02, 0.01]))[0] == "latency"
    says = corner(np.array([0.1, 0.5, 0.04]))[1]
    assert "0.4 s and 0.1 s" in says and "{delay}" in says


@pytest.mark.parametrize(("band", "fastest"), [(0.15, np.inf), (0.0, 1.2), (0.1, 1.5)])
def test_servo_solves_its_equation(band: float, fastest: float) -> None:
    tau, x = 0.12, swing(T)

    def rates(t: float, y: Array) -> list[float]:
        error = float(np.interp(t, T, x)) - y[0]
        return [float(np.clip(error - np.clip(error, -band, band), -fastest * tau, fastest * tau)) / tau]

    wanted = solve_ivp(rates, (0.0, T[-1]), [x[0] + 0.3], t_eval=T, rtol=1e-8, atol=1e-10, max_step=0.005).y[0]
    assert np.max(np.abs(op.servo(x, DT, tau, band, fastest, 0.3) - wanted)) < 3e-3


def test_maxwell_slip_is_springs_on_sliders() -> None:
    x, distance, levels = swing(T), 0.3, np.array([0.1, 0.0, 0.5, 0.4])
    sliders, force = np.full(4, x[0]), []
    for place in np.interp(np.arange(0.0, T[-1], DT / 20), T, x):
        stretch = place - sliders
        reach = distance * np.array([0.25, 0.5, 1.0, 2.0])
        sliders = place - np.clip(stretch, -reach, reach)
        force.append(float(np.sum(levels * (place - sliders) / reach)))
    assert np.max(np.abs(op.maxwell_slip(x, distance, 2.0, levels, 0.0)[: len(force) // 20] - force[:-19:20])) < 1e-9


def test_a_state_that_is_wiped_at_reversals_follows_the_distance_since() -> None:
    x = np.concatenate((np.linspace(0, 1, 101), np.linspace(1, 0.7, 31)[1:], np.linspace(0.7, 1.5, 81)[1:]))
    z = op.wiped_at_reversal(x, 0.2, 1e-3, 0.0)
    assert z[100] == pytest.approx(1.0 - np.exp(-5.0))
    assert z[130] == pytest.approx(-(1.0 - 2.0 * np.exp(-1.5)))  # of full depth, though the loop is small
    assert z[150] == pytest.approx(1.0 - 2.0 * np.exp(-1.0), abs=1e-6)


def test_change_points_are_the_best_of_all() -> None:
    rng = np.random.default_rng(3)
    y = np.concatenate((np.zeros(17), np.full(23, 2.0), np.full(14, -1.0), np.full(30, 0.5))) + 0.3 * rng.normal(size=84)

    def error(places: tuple[int, ...]) -> float:
        edges = (0, *places, y.size)
        return sum(float(np.sum((y[a:b] - y[a:b].mean()) ** 2)) for a, b in pairwise(edges))

    best = min(combinations(range(1, y.size), 2), key=error)
    assert tuple(change_points(y, 2)) == best
    assert change_points(y, 3) == [17, 40, 54]


def test_rows_that_are_cut_from_motion_begin_in_it() -> None:
    x, tau = swing(T), 0.06
    wanted = answer(0.0, tau, 1e-6)
    rows = op.lagged_rows(np.vstack((x, -x)), DT, tau)
    assert np.max(np.abs(rows[0] - wanted)) < 0.15 * np.max(np.abs(op.lag(x, DT, tau) - wanted))
    late = op.shifted_rows(x[None, :], DT, np.full(T.size, tau))[0]
    assert np.max(np.abs(late - swing(T - tau))) < 0.15 * np.max(np.abs(x[:7] - swing(T[:7] - tau)))


def test_every_effect_states_its_traits() -> None:
    for effect in library():
        assert effect.equation and effect.says
        if effect.corner is not None:
            assert effect.id in effect.spans and set(effect.spans) <= set(effect.contains)


def test_the_page_holds_the_table_of_effects() -> None:
    page = Path(__file__).parents[3] / "docs" / "diagnosis.md"
    assert table() in page.read_text(encoding="utf-8")


def test_a_form_with_other_parameters_states_an_equation_of_its_own() -> None:
    """A sentence or an equation that holds for one form only would be false of the other."""
    sized = Scale("N", 2.0, -1.0, 1.0, 5.0, 1e-3, 0.3, DT, 10.0, True, source_unit="N", motion_unit="m")
    for effect in library():
        of_form = {form: {p.name for p in effect.parameters(sized, form)} for form in effect.forms}
        names = of_form[effect.forms[0]]
        assert all(other == names for other in of_form.values()), (effect.id, effect.port, of_form)
        for name in re.findall(r"{(\w+)}", effect.says) if names else ():
            assert name == "source" or name in names, (effect.id, effect.says)


@pytest.mark.parametrize(("rise", "power"), [(0.05, 0.0), (0.001, 0.0), (0.05, 2.0), (0.001, 2.0), (0.01, 0.8)])
def test_friction_that_rises_with_speed_is_simulated_in_long_steps(rise: float, power: float) -> None:
    """Against an adaptive integrator; an explicit step would have to be shorter than rise * mass / force, 1.7 ms."""
    t = 0.01 * np.arange(1500)

    def push(at: Array | float) -> Array:
        return np.asarray(sum(np.sin(2.0 * np.pi * hertz * np.asarray(at) + k) for k, hertz in enumerate((0.21, 0.57, 1.3))))

    def slope(at: float, state: Array) -> list[float]:
        u = state[1] / rise
        share = u / (1.0 + abs(u) ** power) ** (1.0 / power) if power else np.tanh(u)
        return [state[1], (float(push(at)) - 3.0 * state[1] - 40.0 * state[0] - 0.3 * share) / 0.5]

    wanted = solve_ivp(slope, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, method="LSODA").y[0]
    slots = {"smooth": 0.3, "smooth_speed": rise, "smooth_power": power}
    stages = push(t[:, None, None] + 0.005 * (np.arange(2)[None, :, None] + np.array([0.0, 0.5, 1.0])))
    law, none = np.array([0.5, 3.0, 40.0, 0.0]), np.zeros(t.size)
    run = run_axis(stages, 2, 0.01, law, slot_array([slots]), np.zeros(2), none, np.zeros(0), none[None], 0.0, 0.0)
    assert float(np.std(run[0] - wanted)) < 2e-3 * float(np.std(wanted))


@pytest.mark.parametrize(
    ("form", "has"), [("share", True), ("drive", True), ("", True), ("dead_time", False), ("mass", False)]
)
def test_only_a_mode_may_be_taken_for_a_second_mass(form: str, has: bool) -> None:
    """A resonance with a dead time does not state its damping ratio: the comparison ended in a KeyError (suite `ode`)."""
    scale = Scale("N", 2.0, -1.0, 1.0, 1.0, 1e-6, 0.1, 0.01, 10.0, True)
    modes = [effect for effect in library() if "resonance" in (effect.id, *effect.spans) and form in effect.forms]
    modes = [effect for effect in modes if form or effect.slots is None]  # the other is the second mass itself
    assert modes
    for effect in modes:
        begin = from_mode({p.name: p.grid[0] for p in effect.parameters(scale, form)})
        assert (begin is not None) is has
