"""Linear models of any order: exact sampling, unknown first states, loops with effects inside, and verdicts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import signal

import seldinger as sd
from host.diagnosis.effects import candidates
from host.diagnosis.estimation.fit import FAR, answers_to_begin
from host.diagnosis.model.effect import Array
from host.diagnosis.model.expressions import names_in, value_of
from host.diagnosis.model.model import Begin, Model
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal, refined
from protocol.errors import InputError

DT_S = 0.01
CHANNELS = {"u": {"column": "u", "unit": "N"}, "y": {"column": "y", "unit": "m"}}
THIRD: dict[str, Any] = {  # an oscillator behind a lag: k w^2 / ((tau s + 1)(s^2 + 2 d w s + w^2))
    "name": "third order",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": CHANNELS,
    "linear": {
        "inputs": ["u"],
        "outputs": ["y"],
        "numerator": ["k * w**2"],
        "denominator": ["tau", "1 + 2 * d * w * tau", "2 * d * w + tau * w**2", "w**2"],
        "subsystem": "stage",
    },
    "parameters": {
        "k": 1.0,
        "w": {"value": 6.0, "low": 1.0, "high": 50.0, "unit": "rad/s"},
        "d": {"value": 0.5, "low": 0.01, "high": 2.0},
        "tau": {"value": 0.1, "low": 0.01, "high": 1.0, "unit": "s"},
    },
}
K, W, D, TAU = 0.02, 9.0, 0.3, 0.08
TRUE = signal.TransferFunction([K * W**2], np.convolve([TAU, 1.0], [1.0, 2 * D * W, W**2]))


def tones(seed: int, n: int) -> Array:
    rng = np.random.default_rng(seed)
    t = np.arange(n) * DT_S
    return np.asarray(
        sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for a, f in ((1, 0.23), (0.7, 0.71), (0.5, 1.9)))
    )


def recorded(
    seed: int, u_of: Any = lambda u: u, y_of: Any = lambda y: y, n: int = 2000, noise: float = 2e-5
) -> dict[str, Array]:
    """The true third order, its input held, cut from motion after three seconds."""
    u = tones(seed, n + 300)
    ad, bd, c, d, _ = signal.cont2discrete((TRUE.to_ss().A, TRUE.to_ss().B, TRUE.to_ss().C, TRUE.to_ss().D), DT_S)
    _, y, _ = signal.dlsim((ad, bd, c, d, DT_S), u_of(u))
    y = y[:, 0] + noise * np.random.default_rng(seed + 100).standard_normal(u.size)
    return {"t": np.arange(n) * DT_S, "u": u[300:], "y": y[300:]}


def model_of(nominal: dict[str, Any], *recordings: dict[str, Array]) -> tuple[Model, Any]:
    model, problem, _ = prepare(nominal_of(nominal), [Table(f"r{k}", columns) for k, columns in enumerate(recordings)])
    return model, problem


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_sampling_is_exact(hold: str) -> None:
    nominal = {**THIRD, "linear": {**THIRD["linear"], "hold": hold}}
    columns = recorded(1, n=400)
    model, problem = model_of(nominal, columns)
    segment = problem.segments[0]
    segment.begin.values = np.zeros(3)
    fine = 50
    t = np.arange(400 * fine) * DT_S / fine
    u = np.repeat(columns["u"], fine) if hold == "zero" else np.interp(t, columns["t"], columns["u"])
    _, y, _ = signal.lsim(TRUE, u, t, interp=hold == "linear")
    out = model.simulate(segment, np.array([K, W, D, TAU]), [])
    last = -fine if hold == "linear" else None  # beyond the last sample a straight input is not known
    assert np.max(np.abs(out[0] - y[::fine])[: -1 if last else None]) < 1e-6 * np.max(np.abs(y))


def test_the_first_state_and_the_parameters_are_found_together() -> None:
    _, problem = model_of(THIRD, recorded(1), recorded(2))
    fit = refined(problem, fit_nominal(problem))
    assert fit.values == pytest.approx([K, W, D, TAU], rel=0.02)
    r = np.concatenate([r[0] for r in fit.residuals])
    assert np.nanstd(r) < 1.1 * 2e-5


def test_state_space_discrete_and_transfer_function_agree() -> None:
    columns = recorded(3, n=300)
    space = TRUE.to_ss()
    ad, bd, c, d, _ = signal.cont2discrete((space.A, space.B, space.C, space.D), DT_S)
    matrices = {"A": ad.tolist(), "B": bd.tolist(), "C": c.tolist(), "D": d.tolist()}
    section = {"inputs": ["u"], "outputs": ["y"], "period_s": DT_S, **matrices}
    discrete, problem_d = model_of({**THIRD, "linear": section, "parameters": {}}, columns)
    plain, problem = model_of(THIRD, columns)
    for p in (problem, problem_d):
        p.segments[0].begin.values = np.zeros(3)
    one = discrete.simulate(problem_d.segments[0], np.zeros(0), [])
    assert np.allclose(one, plain.simulate(problem.segments[0], np.array([K, W, D, TAU]), []), atol=1e-12)


LOOP: dict[str, Any] = {
    "name": "loop",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"r": {"column": "r", "unit": "m"}, "y": {"column": "y", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
    "linear": {
        "inputs": ["r"],
        "outputs": ["y", "f"],
        "A": [[0.0, 1.0], [0.0, "-c / m"]],
        "B": [[0.0], ["1 / m"]],
        "C": [[1.0, 0.0]],
        "subsystem": "slide",
        "feedback": {
            "reference": "r",
            "output": "y",
            "numerator": [12.0, 60.0],
            "denominator": [0.02, 1.0],
            "actuation": "f",
        },
    },
    "parameters": {"m": {"value": 1.0, "low": 0.05, "high": 20.0}, "c": {"value": 2.0, "low": 0.0, "high": 50.0}},
}


def loop_recorded(seed: int, limit: float = np.inf, n: int = 2000) -> dict[str, Array]:
    """Slide of 0.5 kg and 3 N s/m under its controller, whose force is limited; sample by sample."""
    rng = np.random.default_rng(seed)
    r = 0.02 * tones(seed, n)
    ad, bd, *_ = signal.cont2discrete(
        (np.array([[0, 1], [0, -6.0]]), np.array([[0], [2.0]]), np.eye(2), np.zeros((2, 1))), DT_S
    )
    ak, bk, ck, dk = signal.tf2ss([12.0, 60.0], [0.02, 1.0])
    akd, bkd, *_ = signal.cont2discrete((ak, bk, ck, dk), DT_S)
    x, z = np.zeros(2), np.zeros(1)
    y, f = np.empty(n), np.empty(n)
    for k in range(n):
        y[k] = x[0]
        error = r[k] - y[k]
        f[k] = np.clip(ck[0] @ z + dk[0, 0] * error, -limit, limit)
        z = akd @ z + bkd[:, 0] * error
        x = ad @ x + bd[:, 0] * f[k]
    noise = 1e-5 * rng.standard_normal(n)
    return {"t": np.arange(n) * DT_S, "r": r, "y": y + noise, "f": f + 1e-3 * rng.standard_normal(n)}


def test_an_effect_inside_the_loop_is_solved_with_it() -> None:
    columns = loop_recorded(1, limit=0.6)
    model, problem = model_of(LOOP, columns)
    segment = problem.segments[0]
    segment.begin.values = np.zeros(3)
    clips = {c.key: c for c in candidates(model.ports, True)}
    sides = {"upper": 0.6, "lower": -0.6}
    limits = [(clips[f"saturation@slide_actuation({side})"], np.array([value])) for side, value in sides.items()]
    out = model.simulate(segment, np.array([0.5, 3.0]), limits)
    assert np.max(np.abs(out[0] - columns["y"])) < 6e-5 and np.max(np.abs(out[1] - columns["f"])) < 6e-3


def test_the_loop_without_effects_is_the_recorded_one() -> None:
    columns = loop_recorded(2)
    model, problem = model_of(LOOP, columns)
    problem.segments[0].begin.values = np.zeros(3)
    out = model.simulate(problem.segments[0], np.array([0.5, 3.0]), [])
    assert np.max(np.abs(out[0] - columns["y"])) < 6e-5


def test_a_transfer_function_has_its_actuation_as_a_second_output() -> None:
    columns = loop_recorded(2)
    states = {key: value for key, value in LOOP["linear"].items() if key not in "ABC"}
    transfer = {**LOOP, "linear": {**states, "numerator": [1.0], "denominator": ["m", "c", 0.0]}}
    model, problem = model_of(transfer, columns)
    problem.segments[0].begin.values = np.zeros(3)
    out = model.simulate(problem.segments[0], np.array([0.5, 3.0]), [])
    assert np.max(np.abs(out[0] - columns["y"])) < 6e-5 and np.max(np.abs(out[1] - columns["f"])) < 6e-3
    with pytest.raises(InputError, match=r"linear.feedback.actuation: found \"f\", wanted one of linear.outputs \(y\)"):
        model_of({**LOOP, "linear": {**transfer["linear"], "outputs": ["y"]}}, columns)


def backlash(u: Array, width: float = 0.3) -> Array:
    y = u.copy()
    for k in range(1, u.size):
        y[k] = min(max(y[k - 1], u[k] - 0.5 * width), u[k] + 0.5 * width)
    return y


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("nothing", []),
        pytest.param("backlash", [("backlash", "u")], marks=pytest.mark.long),
        ("latency", [("latency", "u")]),
    ],
)
def test_verdicts_about_a_third_order(what: str, expected: list[tuple[str, str]]) -> None:
    u_of = {"nothing": lambda u: u, "backlash": backlash, "latency": lambda u: np.concatenate([np.full(7, u[0]), u[:-7]])}[
        what
    ]
    verdict = sd.diagnose([recorded(k, u_of) for k in range(3)], THIRD)
    assert [(e["id"], e["port"]) for e in verdict.effects] == expected


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"numerator": ["k * q"]}, "q"),
        ({"numerator": ["k[0]"]}, "arithmetic"),
        ({"denominator": None}, "either numerator"),
        ({"A": [[1.0]], "B": [[1.0]], "C": [[1.0]]}, "either numerator"),
        ({"numerator": None, "denominator": None, "A": [[1.0, 0.0]], "B": [[1.0]], "C": [[1.0]]}, "linear.A"),
        ({"period_s": 0.5}, "period"),
    ],
)
def test_a_section_that_cannot_be_is_bad_input(change: dict[str, Any], wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        model, problem = model_of({**THIRD, "linear": {**THIRD["linear"], **change}}, recorded(1, n=100))
        model.simulate(problem.segments[0], np.array([K, W, D, TAU]), [])


def test_coefficients_are_arithmetic_of_parameters() -> None:
    assert names_in("-k / m + sqrt(c)", "A") == {"k", "m", "c"}
    assert value_of("-(k / m) ** 2", {"k": 6.0, "m": 2.0}) == -9.0 and np.isnan(value_of("1 / m", {"m": 0.0}))


def oscillator(seed: int, force: Any, n: int = 2000, steps: int = 8) -> dict[str, Array]:
    """y'' + 4 y' + 25 y + 25 force(y, y') = 32.5 u by Runge-Kutta, u straight between samples, noise 2 mm."""
    rng, t = np.random.default_rng(seed), np.arange(n + 300) * DT_S
    hertz = np.geomspace(0.1, 3.0, 8) * rng.uniform(0.9, 1.1, 8)
    u = 0.5 * np.sum(np.sin(2 * np.pi * np.outer(t, hertz) + rng.uniform(0, 6.28, 8)), axis=1)
    y, state = np.empty(u.size), np.zeros(2)

    def rate(x: Array, push: float) -> Array:
        return np.array([x[1], 25.0 * (1.3 * push - x[0] - 0.16 * x[1] - force(x[0], x[1]))])

    for i in range(u.size):
        y[i] = state[0]
        after = u[min(i + 1, u.size - 1)]
        for j in range(steps):
            h, (p, q, r) = DT_S / steps, (u[i] + (after - u[i]) * (j + c) / steps for c in (0.0, 0.5, 1.0))
            a = rate(state, p)
            b = rate(state + 0.5 * h * a, q)
            c = rate(state + 0.5 * h * b, q)
            state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(state + h * c, r))
    y += 2e-3 * np.random.default_rng(seed + 50).standard_normal(u.size)
    return {"t": np.arange(n) * DT_S, "u": u[300:], "y": y[300:]}


SECOND: dict[str, Any] = {
    **THIRD,
    "linear": {
        **THIRD["linear"],
        "numerator": ["k * w**2"],
        "denominator": [1.0, "2 * d * w", "w**2"],
        "hold": "linear",
    },
    "parameters": {name: THIRD["parameters"][name] for name in ("k", "w", "d")},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("force", "verdict"),
    [
        (lambda y, v: 0.0, "nothing_missing"),
        (lambda y, v: 0.06 * y**3, "mismatch_not_identified"),
    ],
    ids=["nothing", "hardening"],
)
def test_a_force_inside_the_plant_is_no_noise(force: Any, verdict: str) -> None:
    """It is as coloured as noise and follows no form of the input, but it follows the plant's own motion."""
    found = sd.diagnose([oscillator(301, force), oscillator(302, force)], SECOND).as_dict()
    assert found["verdict"] == verdict
    assert verdict == "nothing_missing" or "kind axis" in found["next"]


def run_loop(r: Array, y0: Array, steps: int) -> Array:
    """A second-order plant under a controller with an integrator, both integrated in `steps` of a sample, from `y0`.

    25 / (s^2 + 4 s + 25) under (s + 4) / s: three numbers begin each recording, one of them the controller's.
    """
    y, state, h = np.empty(r.size), y0.astype(float), DT_S / steps
    for k in range(r.size):
        y[k] = state[0]
        for _ in range(steps):
            error = r[k] - state[0]
            command = error + 4.0 * state[2]
            state = state + h * np.array([state[1], 25.0 * (command - state[0]) - 4.0 * state[1], error])
    return y


WITH_INTEGRATOR: dict[str, Any] = {
    "name": "loop",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"r": {"column": "r", "unit": "m"}, "y": {"column": "y", "unit": "m"}},
    "linear": {
        "inputs": ["r"],
        "outputs": ["y"],
        "numerator": ["w**2"],
        "denominator": [1.0, "2 * d * w", "w**2"],
        "subsystem": "slide",
        "feedback": {"reference": "r", "output": "y", "numerator": [1.0, 4.0], "denominator": [1.0, 0.0]},
    },
    "parameters": {"w": {"value": 4.5, "low": 0.5, "high": 50.0}, "d": {"value": 0.5, "low": 0.02, "high": 5.0}},
}


def cut_from_motion(seed: int) -> dict[str, Array]:
    """The loop, exact for a held reference, recorded for 15 s from the middle of a motion, 1 mm noise."""
    rng, r = np.random.default_rng(seed), tones(seed, 1900)
    rates = np.array([[0.0, 1.0, 0.0], [-50.0, -4.0, 100.0], [-1.0, 0.0, 0.0]])
    pushed = np.array([[0.0], [25.0], [1.0]])
    step, by, *_ = signal.cont2discrete((rates, pushed, np.eye(3), np.zeros((3, 1))), DT_S)
    y, state = np.empty(r.size), np.zeros(3)
    for k, wanted in enumerate(r):
        y[k], state = state[0], step @ state + by[:, 0] * wanted
    y += 1e-3 * rng.standard_normal(y.size)
    return {"t": DT_S * np.arange(1500), "r": r[400:], "y": y[400:]}


@pytest.mark.long
def test_a_controller_begins_with_a_state_of_its_own_and_works_continuously() -> None:
    """The integrator was begun at zero, and a loop that is integrated was simulated once a sample: a resonance, 0.92."""
    content = sd.diagnose([cut_from_motion(seed) for seed in (1, 2)], WITH_INTEGRATOR).as_dict()
    assert content["verdict"] == "nothing_missing"
    found = content["fit"]["nominal_parameters"]
    assert found["w"]["value"] == pytest.approx(5.0, rel=0.01) and found["d"]["value"] == pytest.approx(0.4, rel=0.02)


@pytest.mark.parametrize(("reach", "expected"), [(10.0, -2.0), (0.5, -2.0), (0.0, 0.0)])
def test_a_state_from_which_a_loop_runs_away_moves_less_or_not_at_all(reach: float, expected: float) -> None:
    """Residuals of 1 - 2 x as far as `reach`, beyond it the loop runs away. That ended in a LinAlgError."""
    begin = Begin(("x",), np.zeros(1), np.ones(1), np.zeros(1))

    class OneState:
        """A model that begins with x."""

        def begins_with(self, segment: Any, theta: Any, active: Any) -> npt.NDArray[np.intp]:
            """Return the index of x."""
            return np.zeros(1, dtype=np.intp)

    class Loop:
        """A problem whose only state is x."""

        model = OneState()

        def parted(self, terms: Any, values: Any) -> tuple[Any, list[Any]]:
            """The values are nominal parameters alone: nothing acts."""
            return values, []

        def stacked(self, terms: Any, values: Any) -> Array:
            """Return 3 residuals, cut where the simulation ran away."""
            x = float(begin.values[0])
            return np.full(3, 1.0 - 2.0 * x if abs(x) <= reach else FAR)

    problem: Any = Loop()
    segment: Any = SimpleNamespace(begin=begin)
    ((index, column),) = answers_to_begin(problem, (), np.zeros(0), problem.stacked((), ()), segment)
    assert index == 0 and np.allclose(-column, expected) and np.all(begin.values == 0.0)


@pytest.mark.parametrize("hold", ["linear", "held_reference"])
def test_a_continuous_loop_is_the_integrated_one(hold: str) -> None:
    """Of a reference that is constant from the second sample on, straight and held are alike."""
    r = np.full(400, 0.7)
    y = run_loop(r, np.array([0.2, -0.3, 0.05]), 400)
    section = {**WITH_INTEGRATOR["linear"], "hold": hold}
    model, problem = model_of({**WITH_INTEGRATOR, "linear": section}, {"t": DT_S * np.arange(400), "r": r, "y": y})
    segment = problem.segments[0]
    rate = model.rate_of(segment)
    segment.begin.values = np.array([0.2, -0.3 / rate, 4.0 * 0.05])
    assert segment.begin.names == ("y_0", "y_1", "command_0")
    assert np.max(np.abs(model.simulate(segment, np.array([5.0, 0.4]), [])[0] - y)) < 1e-3


def test_parameters_that_take_each_others_place_hide_no_drift() -> None:
    """A gain a b: its flat direction widened the interval of the drift until it contained zero, and nothing was named."""
    runs = []
    for seed in (1, 2, 3):
        rng, t = np.random.default_rng(seed), 0.04 * np.arange(1000)
        u = np.repeat(rng.uniform(-1.0, 1.0, 40), 25)
        y = signal.lfilter([1.0 - np.exp(-0.04 / 0.7)], [1.0, -np.exp(-0.04 / 0.7)], np.concatenate(([0.0], u[:-1])))
        runs.append({"t": t, "u": u, "y": 1.5 * y + 0.002 * t + 0.02 * rng.standard_normal(t.size)})
    section = {"inputs": ["u"], "outputs": ["y"], "numerator": ["a * b"], "denominator": ["tau", 1.0], "subsystem": "stage"}
    bounds = {name: {"value": 1.0, "low": 0.1, "high": 10.0} for name in ("a", "b", "tau")}
    content = sd.diagnose(runs, {**THIRD, "linear": section, "parameters": bounds}).as_dict()
    (effect,) = content["effects"]
    assert effect["id"] == "sensor_drift"
    low, high = effect["parameters"]["rate_m_per_s"]["ci95"]
    assert 0.001 < low < 0.002 < high < 0.003
    assert {f["channel"] for f in content["data_findings"] if f["id"] == "excitation"} == {"a", "b"}
