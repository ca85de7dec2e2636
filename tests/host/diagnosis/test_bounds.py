"""A form that ends at a bound that is not nature's is refused, and wider forms at its place are tried."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import LARGEST_AMPLITUDE, Fit, Term, moved
from host.diagnosis.estimation.rules import RULES, Budget
from host.diagnosis.model.effect import Array, Candidate, Parameter, Port, Scale
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from host.diagnosis.selection import search
from host.diagnosis.selection.found import Found
from host.diagnosis.selection.refits import fit_nominal, try_fit
from host.diagnosis.selection.screening import screen
from host.diagnosis.selection.search import with_wider
from host.diagnosis.selection.trial import at_bound, called_for, wider
from tests.host.proof import everyday

PRESS: dict[str, Any] = {
    "name": "press",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"x": {"column": "x", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "press", "input": "x", "output": "f", "terms": ["damping", "stiffness", "offset"]},
}
PORTS = (Port("press", "force", "press", ("f",)), Port("press_reading", "limit+timing", "press", ("f",)))


def one(effect_id: str, form: str = "", port: str = "press") -> Candidate:
    """The candidate of this id and form at a port of the press."""
    every = candidates(PORTS, timed=True)
    return next(c for c in every if (c.effect.id, c.form, c.port.name) == (effect_id, form, port))


def ended(candidate: Candidate, parameters: tuple[Parameter, ...], values: list[float]) -> Fit:
    """A fit whose last effect ended at `values`."""
    return Fit((Term(candidate, parameters),), np.array(values))


@pytest.mark.parametrize(("knee", "refused"), [(0.01, False), (0.2, True), (0.001, False)])
def test_a_knee_may_be_sharp_but_not_wider_than_its_form(knee: float, refused: bool) -> None:
    limit = Parameter("limit", "N", (0.5,), 0.0, 1.0)
    edge = Parameter("knee", "N", (0.01,), 0.001, 0.2, log=True, shape=True)
    assert at_bound(ended(one("saturation", "both", "press_reading"), (limit, edge), [1.0, knee])) is refused


@pytest.mark.parametrize(("share", "refused"), [(0.001, False), (0.33, True), (0.05, False)])
def test_a_friction_that_falls_may_have_a_corner_as_sharp_as_it_likes(share: float, refused: bool) -> None:
    """Stribeck friction of a drive in a loop was refused for it, and Coulomb friction named with 0.93."""
    size = Scale("N", 1.0, -1.0, 1.0, 0.1, 1e-3, 1.0, 1e-2, 10.0, True, "N", motion_unit="m")
    smooth = one("stribeck_friction", "smooth")
    parameters = smooth.effect.parameters(size, "smooth")
    assert at_bound(ended(smooth, parameters, [2.0, 1.0, 0.05, share])) is refused


@pytest.mark.parametrize(("levels", "refused"), [((1.0, 0.5), False), ((-1.0, -0.5), False), ((1.0, -2.0), True)])
def test_friction_never_pushes_along_with_the_motion(levels: tuple[float, float], refused: bool) -> None:
    parts = tuple(Parameter(name, "N", (1.0,), linear=True) for name in ("kinetic_force", "static_excess"))
    assert at_bound(ended(one("stribeck_friction"), parts, list(levels))) is refused


def test_a_wider_form_is_at_the_same_place_and_of_the_same_kind() -> None:
    assert wider(one("presliding_friction", "dahl"), one("coulomb_friction", "bristles"))
    assert wider(one("rate_lag", "dead_time", "press_reading"), one("latency", "", "press_reading"))
    assert not wider(one("presliding_friction", "dahl"), one("gravity_load"))
    assert not wider(one("rate_lag", "dead_time", "press_reading"), one("coulomb_friction", "bristles"))


def pressed(seed: int, friction_N: float, yields_m: float = 0.0, yields_m_per_s: float = 0.0, sign: float = 1.0) -> Any:
    """Force of a press with friction that builds up over a distance (Bouc-Wen's slope) or over a speed."""
    rng = np.random.default_rng(seed)
    t = np.arange(4000) * 0.005
    x = sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for a, f in ((0.01, 0.31), (0.004, 0.83)))
    v = np.gradient(x, t)
    z = np.zeros(t.size)
    if yields_m:
        for i in range(1, t.size):
            dx = x[i] - x[i - 1]
            z[i] = np.clip(z[i - 1] + (dx - abs(dx) * z[i - 1]) / yields_m, -1.0, 1.0)
    else:
        z = np.tanh(v / yields_m_per_s)
    force: Array = 20.0 * v + 300.0 * x + friction_N * z
    return {"t": t, "x": x, "f": sign * force + 0.02 * rng.standard_normal(t.size)}


def test_where_a_form_ends_at_its_bound_a_wider_one_is_fitted() -> None:
    tables = [Table(f"r{k}", pressed(k, 1.0, yields_m=5e-4)) for k in range(2)]
    model, problem, _ = prepare(nominal_of(PRESS), tables)
    nominal = fit_nominal(problem)
    ranked = screen(problem, nominal, candidates(model.ports, True, model.taken), lambda *_: None)
    dry = next(item for item in ranked if item.candidate.key == "coulomb_friction@press(bristles)")
    refused = try_fit(problem, nominal, dry)
    assert at_bound(refused.fit) and called_for(refused, nominal)
    trials = with_wider(problem, nominal, [refused], ranked)
    assert trials[0].candidate.effect.id == "presliding_friction" and not at_bound(trials[0].fit)
    fine = [trial for trial in trials if not at_bound(trial.fit)]
    assert with_wider(problem, nominal, fine[:1], ranked) == fine[:1]  # nothing at a bound: nothing more to fit


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_that_grows_with_speed_is_not_named_stribeck(sign: float) -> None:
    verdict = sd.diagnose([pressed(k, 1.0, yields_m_per_s=5e-3, sign=sign) for k in range(3)], PRESS)
    ids = [str(effect["id"]) for effect in verdict.effects]
    assert ids and ids[0] in ("coulomb_friction", "presliding_friction") and "stribeck_friction" not in ids


def falling(number: int, kinetic_N: float, excess_N: float, noise_N: float) -> dict[str, Any]:
    """Force of a press whose friction falls with the square of speed (Lorentz' curve; the library's form is Gauss')."""
    rng, t = np.random.default_rng([83, number]), 0.01 * np.arange(1200)
    turn, phase = 2.0 * np.pi * rng.uniform(0.1, 1.0, 4), rng.uniform(0.0, 6.28, 4)
    x, v = 0.01 * np.sin(np.outer(t, turn) + phase).sum(axis=1), 0.01 * np.cos(np.outer(t, turn) + phase) @ turn
    usual = np.std(v)
    level = kinetic_N + excess_N / (1.0 + (v / (0.15 * usual)) ** 2)
    force = 20.0 * v + 300.0 * x + level * np.tanh(v / (1e-3 * usual))
    return {"t": t, "x": x, "f": force + noise_N * rng.standard_normal(t.size)}


@pytest.mark.parametrize(
    ("kinetic_N", "excess_N", "noise_N", "names"),
    [
        (0.05, 0.1, 0.02, ["stribeck_friction"]),
        (0.05, 0.1, 0.1, ["stribeck_friction", "coulomb_friction"]),
        (0.1, 0.0, 0.02, ["coulomb_friction"]),
        (0.1, 0.0, 0.1, ["coulomb_friction"]),
    ],
)
def test_friction_that_falls_with_speed_is_named_or_listed(
    kinetic_N: float, excess_N: float, noise_N: float, names: list[str]
) -> None:
    """With 0.1 N of noise Coulomb friction was named with 0.94, and nothing listed."""
    (effect,) = sd.diagnose([falling(k, kinetic_N, excess_N, noise_N) for k in (1, 2, 3)], PRESS).effects
    listed = effect["indistinguishable_from"]
    assert isinstance(listed, list)
    assert [effect["id"], *(str(name).partition("@")[0] for name in listed)] == names


def test_several_effects_of_one_name_may_leave_together(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = [(Parameter("jump", "N", (size,)),) for size in (1.0, 2.0, 3.0)]
    first, second, other = (Term(one("coulomb_friction"), part) for part in parts)
    found = Found(Fit((), np.zeros(0)), Fit((first, second), np.zeros(2)), [])
    asked = []

    def exchanged(problem: Any, found: Found, term: Term, *more: Any) -> None:
        asked.append(term)
        found.best = Fit((other,), np.zeros(1))

    monkeypatch.setattr(search, "_in_place_of", exchanged)
    problem: Any = SimpleNamespace(rules=RULES, budget=Budget())
    search._exchange(problem, found, [], lambda *_: None)
    assert asked == [first] and found.best.terms == (other,)


def test_amplitudes_that_cancel_each_other_do_not_grow_without_end() -> None:
    jump, most = Parameter("jump", "N", (0.01,), linear=True), 0.01 * LARGEST_AMPLITUDE
    assert moved(jump, 0.0, 1e6, of_effect=True) == most and moved(jump, 0.0, -1e6, of_effect=True) == -most
    assert moved(jump, 3.0 * most, 1e6, of_effect=True) == 3.0 * most, "a start value beyond it is kept"
    assert moved(Parameter("share", "1", (0.1,), 0.0, 1.0, linear=True), 0.5, 70.0, of_effect=True) == 1.0


def test_a_nominal_parameter_may_be_far_from_its_start() -> None:
    stiffness = Parameter("stiffness", "N/m", (0.0,), linear=True)
    assert moved(stiffness, 0.0, 2e5, of_effect=False) == 2e5


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_a_force_in_another_unit_is_fitted(factor: float) -> None:
    """No value of the spring is stated: its parameters may have any size."""
    pressed = [everyday.spring(seed) for seed in (1, 2)]
    verdict = sd.diagnose([{**columns, "f": factor * columns["f"]} for columns in pressed], everyday.spring_nominal())
    assert verdict.verdict == "nothing_missing"
