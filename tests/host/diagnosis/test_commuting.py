"""A delay, a lag or an offset on either side of a linear plant is one effect whose place no recording tells."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seldinger as sd
from host.diagnosis.effects import candidates, library
from host.diagnosis.estimation.fit import Fit, Term, finish, minimize, size_of
from host.diagnosis.model.effect import Candidate, Context, Effect, Scale
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import candidate_ports, prepare
from host.diagnosis.selection.refits import fit_nominal, refined
from host.diagnosis.selection.screening import replaced_by, term_of

Array = np.ndarray
DT_S, GAIN, TAU_S, NOISE = 0.01, 2.0, 0.15, 0.005
CHANNELS = {"u": {"column": "u", "unit": "V"}, "y": {"column": "y", "unit": "rad/s"}}
MOTOR: dict[str, Any] = {
    "name": "motor",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": CHANNELS,
    "linear": {
        "inputs": ["u"],
        "outputs": ["y"],
        "numerator": ["k"],
        "denominator": ["tau", 1.0],
        "hold": "linear",
        "subsystem": "motor",
    },
    "parameters": {"k": 1.5, "tau": 0.2},
}


def motor(seed: int, delay_s: float = 0.0, lag_s: float = 0.0, seconds: float = 8.0) -> dict[str, Array]:
    """A first-order motor, its input late or lagged, integrated by an adaptive method and cut from motion."""
    rng = np.random.default_rng([31, seed])
    w, phase = 2.0 * np.pi * np.array([0.13, 0.41, 0.97, 2.3]), rng.uniform(0.0, 6.28, 4)

    def u(t: Any) -> Any:
        return np.sin(np.multiply.outer(t, w) + phase).sum(axis=-1)

    def rates(t: float, state: Array) -> list[float]:
        y, slow = state
        given = slow if lag_s else u(t - delay_s)
        return [(GAIN * given - y) / TAU_S, (u(t) - slow) / (lag_s or 1.0)]

    t = np.arange(-2.0, seconds - 1e-9, DT_S)
    y = solve_ivp(rates, (t[0], t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.02).y[0]
    seen = t > -0.5 * DT_S
    return {"t": t[seen] - t[seen][0], "u": u(t[seen]), "y": y[seen] + NOISE * rng.standard_normal(int(seen.sum()))}


def problem_of(nominal: dict[str, Any], *recordings: dict[str, Array]) -> Any:
    return prepare(nominal_of(nominal), [Table(f"r{k}", columns) for k, columns in enumerate(recordings)])[1]


def bound(problem: Any) -> dict[str, Candidate]:
    return {candidate.key: candidate for candidate in candidates(candidate_ports(problem), True)}


@pytest.mark.parametrize("place", ["u", "y_reading"])
def test_one_delay_explains_all_wherever_it_is_put(place: str) -> None:
    """The first samples come from an input before the recording: no state of the plant is to be blamed for them."""
    problem = problem_of(MOTOR, motor(1, delay_s=0.08), motor(2, delay_s=0.08))
    nominal = fit_nominal(problem)
    term = term_of(problem, bound(problem)[f"latency@{place}"], nominal)
    fit = refined(problem, finish(problem, minimize(problem, (term,), np.array([GAIN, TAU_S, 0.075]))))
    left = np.concatenate([r[0] for r in fit.residuals])
    assert fit.values == pytest.approx([GAIN, TAU_S, 0.08], rel=5e-3)
    assert np.sqrt(np.nanmean(left**2)) < 1.1 * NOISE


def tanh_motor(inputs: dict[str, Array], parameters: dict[str, float], time_s: Array) -> dict[str, Array]:
    keep = float(np.exp(-DT_S / parameters["tau"]))
    y = np.zeros(time_s.size)
    for k in range(1, y.size):
        y[k] = keep * y[k - 1] + (1.0 - keep) * parameters["k"] * parameters["bend"] * np.tanh(
            inputs["u"][k - 1] / parameters["bend"]
        )
    return {"y": y}


def as_function(bend: float) -> dict[str, Any]:
    held = {"value": bend, "free": False}
    return {
        **{key: MOTOR[key] for key in ("name", "data", "channels")},
        "kind": "callable",
        "callable": {"function": tanh_motor, "inputs": ["u"], "outputs": ["y"], "subsystem": "motor"},
        "parameters": {"k": 1.5, "tau": {"value": 0.2, "low": 0.01, "high": 2.0}, "bend": held},
    }


@pytest.mark.parametrize(
    ("nominal", "path"), [(MOTOR, ("u", "y_reading")), (as_function(1e3), ("u", "y_reading")), (as_function(3.0), ())]
)
def test_a_path_is_linear_by_superposition(nominal: dict[str, Any], path: tuple[str, ...]) -> None:
    problem = problem_of(nominal, motor(1))
    assert all(port.path == path for port in candidate_ports(problem))


@pytest.mark.parametrize(
    ("active", "further", "taken"),
    [
        ("latency@u", "latency@y_reading", None),  # the same delay again
        ("latency@u", "rate_lag@y_reading(dead_time)", ("latency@u",)),  # a form that contains it takes its place
        ("rate_lag@y_reading", "rate_lag@u", None),
        ("rate_lag@u(dead_time)", "rate_lag@y_reading", None),
        ("backlash@u", "latency@y_reading", ()),  # backlash does not commute
        ("latency@u", "sensor_bias@y_reading", ()),
    ],
)
def test_an_effect_joins_once_on_a_linear_path(active: str, further: str, taken: tuple[str, ...] | None) -> None:
    known = bound(problem_of(MOTOR, motor(1)))
    assert replaced_by(Fit((Term(known[active], ()),), np.zeros(2)), known[further]) == taken


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay_s", "lag_s", "effect", "key"),
    [
        (0.08, 0.0, "latency", "delay_s"),
        pytest.param(0.0, 0.08, "rate_lag", "time_constant_s", marks=pytest.mark.long),
    ],
)
def test_a_delay_or_lag_is_named_once_with_its_whole_value(delay_s: float, lag_s: float, effect: str, key: str) -> None:
    verdict = sd.diagnose([motor(k, delay_s, lag_s) for k in (1, 2, 3)], MOTOR)
    (found,) = verdict.effects
    assert found["id"] == effect and found["parameters"][key]["value"] == pytest.approx(0.08, rel=0.01)
    assert found["probability"] > 0.8 and "cannot tell whether it acts at u or at y reading" in found["says"]


@pytest.mark.long
def test_places_in_two_subsystems_share_the_probability() -> None:
    nominal = {**MOTOR, "linear": {**MOTOR["linear"], "ports": {"u": "amplifier", "y": "encoder"}}}
    verdict = sd.diagnose([motor(k, delay_s=0.08) for k in (1, 2, 3)], nominal)
    (found,) = verdict.effects
    names = {f"{found['id']}@{found['subsystem']}", *found["indistinguishable_from"]}
    assert {"latency@amplifier", "latency@encoder"} <= names and found["probability_raw"] < 0.5
    assert "Record a signal between u and y reading" in verdict.as_dict()["next"]


def test_effects_that_commute_do_not_depend_on_the_instant() -> None:
    """A signal that comes half a second later is changed alike, half a second later, but for what the beginning leaves."""
    t, late = 0.01 * np.arange(4000), 50
    scale = Scale("rad", 2.0, -1.0, 1.0, 3.0, 1e-3, 0.1, 0.01, 40.0, True)
    signal = np.sin(2.0 * t) + 0.5 * np.sin(5.0 * t + 1.0)

    def answer(effect: Effect, form: str, x: Array) -> Array:
        values = [
            p.grid[len(p.grid) // 2] if p.grid and not p.linear else size_of(p, 0.0) for p in effect.parameters(scale, form)
        ]
        context = Context(t[: x.size], 0.01, x, 1e-3)
        assert effect.apply is not None
        return np.asarray(effect.apply(x, context, np.array(values), form))

    checked = set()
    for effect in library():
        if effect.invariant and effect.apply is not None and not effect.memories and effect.port in PORTS:
            for form in (form for form in effect.forms if effect.parameters(scale, form)):
                moved = answer(effect, form, signal)[late + 3000 :] - answer(effect, form, signal[late:])[3000:]
                assert np.max(np.abs(moved)) < 0.02, (effect.id, form)
                checked.add(effect.id)
    assert not any(effect.invariant for effect in library() if effect.id == "clock_drift")
    assert {"latency", "rate_lag", "resonance", "creep_relaxation", "viscous_friction"} <= checked


PORTS = ("motion", "timing", "mode", "drift", "scale")
SLIDE: dict[str, Any] = {
    "name": "slide",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"f": {"column": "f", "unit": "N"}, "y": {"column": "y", "unit": "m"}},
    "axis": {"subsystem": "slide", "input": "f", "output": "y", "terms": ["mass", "damping", "stiffness"], "hold": "linear"},
    "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
}


@pytest.mark.parametrize("held", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_drifting_clock_has_a_place_where_the_masses_are_known(held: bool) -> None:
    """The reading comes faster. With free rates, an input that comes faster does the same: mass and damping change."""
    rng, t, faster = np.random.default_rng(68), np.arange(0.0, 20.0, 0.01), 1.005
    w, size, phase = 2.0 * np.pi * np.array([0.3, 0.9, 1.6, 2.6]), np.array([3.0, 2.0, 3.0, 2.0]), rng.uniform(0.0, 6.28, 4)
    y = (size / (150.0 - 1.2 * w**2 + 3.0j * w) * np.exp(1j * (np.outer(faster * t, w) + phase))).sum(axis=1).imag
    f = (size * np.sin(np.outer(t, w) + phase)).sum(axis=1)
    known = {"mass": 1.2, "damping": 3.0, "stiffness": 150.0}
    parameters = {key: {"value": value, "free": False} for key, value in known.items()} if held else SLIDE["parameters"]
    recording = {"t": t, "f": f, "y": y + 1e-4 * rng.standard_normal(t.size)}
    (found,) = sd.diagnose([recording], {**SLIDE, "parameters": parameters}).as_dict()["effects"]
    assert found["id"] == "clock_drift"
    assert found["parameters"]["rate_s_per_s"]["value"] == pytest.approx(1.0 - faster, rel=0.05 if held else 0.01)
    if held:
        assert found["port"] == "slide_reading" and "explains as much" not in found["says"]
    else:
        assert "explains as much, with mass 1." in found["says"]
    assert "cannot tell whether" not in found["says"]
