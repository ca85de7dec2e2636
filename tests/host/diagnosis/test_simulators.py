"""Simulators as nominal models: what they offer competes, they are told where a recording starts, and runs are reused."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numba import njit
from scipy.signal import lfilter
from typer.testing import CliRunner

import seldinger as sd
from host.cli.diagnose import diagnose as diagnose_command
from host.diagnosis.effects import candidates
from host.diagnosis.model.effect import Array
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.models import simulated
from host.diagnosis.problems import candidate_ports, prepare
from host.diagnosis.selection.readings_apart import readings_apart
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.screening import screen
from protocol.errors import InputError
from tests.host.diagnosis import test_forces

DT_S = 0.005


@njit(cache=True)
def slide(u: Array, x0: float, v0: float, mass: float, damping: float, stiffness: float, friction: float) -> Array:
    """Position of a sprung slide with dry friction, force held between samples, 20 steps a sample."""
    out = np.empty(u.size)
    x, v, h = x0, v0, DT_S / 20
    for i in range(u.size):
        out[i] = x
        for _ in range(20):
            v += h * (u[i] - damping * v - stiffness * x) / mass
            held = h * friction / mass
            v = v - held if v > held else v + held if v < -held else 0.0
            x += h * v
    return out


def simulator(inputs: dict[str, Array], p: dict[str, float], time_s: Array, initial: dict[str, float]) -> dict[str, Array]:
    """The slide as a callable; `dry` is nominally off."""
    x = slide(inputs["force"], initial["x"], initial["x_rate"], 0.5, p["damping"], p["stiffness"], p["dry"])
    return {"x": x}


NOMINAL: dict[str, Any] = {
    "name": "slide",
    "kind": "callable",
    "data": {"time": "t"},
    "channels": {"force": {"column": "f", "unit": "N"}, "x": {"column": "x", "unit": "m"}},
    "callable": {
        "function": simulator,
        "inputs": ["force"],
        "outputs": ["x"],
        "ports": {"force": "motor", "x": "scale"},
        "subsystem": "slide",
    },
    "parameters": {
        "damping": {"value": 1.0, "low": 0.0, "high": 50.0, "unit": "N s/m"},
        "stiffness": {"value": 80.0, "low": 1.0, "high": 1000.0, "unit": "N/m"},
    },
    "offer": [{"id": "coulomb_friction", "parameter": "dry", "high": 20.0, "unit": "N"}],
}


def recorded(seed: int, dry: float, samples: int = 1500) -> dict[str, Array]:
    """A recording that is cut from motion: its first two seconds are thrown away."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples + 400) * DT_S
    f = sum(4.0 / (1 + k) * np.sin(2 * np.pi * w * t + rng.uniform(0, 6.28)) for k, w in enumerate((0.37, 0.83, 1.61)))
    x = slide(f, 0.0, 0.0, 0.5, 3.0, 100.0, dry) + 2e-5 * rng.standard_normal(t.size)
    return {"t": t[400:] - t[400], "f": f[400:], "x": x[400:]}


@pytest.mark.slow
def test_a_kept_run_outlives_the_runs_that_push_it_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two recordings, room for one run: the run of the second was kept before, and the first one's took its place."""
    problem = prepare(nominal_of(NOMINAL), [Table(str(seed), recorded(seed, 0.0)) for seed in (1, 2)])[1]
    model, theta = problem.model, np.array([p.grid[0] for p in problem.model.parameters])
    fresh = model.simulate_all(problem.segments, theta, [])
    monkeypatch.setattr(simulated, "KEPT_BYTES", 1)
    model.simulate_all(problem.segments[1:], theta, [])
    again = model.simulate_all(problem.segments, theta, [])
    assert all(np.array_equal(a, b) for a, b in zip(fresh, again, strict=True))


def test_a_parameter_that_the_simulator_offers_is_named() -> None:
    verdict = sd.diagnose([recorded(k, 0.6) for k in range(3)], NOMINAL)
    (effect,) = verdict.effects
    assert (effect["id"], effect["subsystem"], effect["port"]) == ("coulomb_friction", "slide", "dry")
    assert effect["parameters"]["dry_N"]["value"] == pytest.approx(0.6, rel=0.05)
    fitted = verdict.as_dict()["fit"]["nominal_parameters"]
    assert fitted["stiffness_N_per_m"]["value"] == pytest.approx(100.0, rel=0.02)


@pytest.mark.slow
def test_a_recording_cut_from_motion_is_no_missing_physics() -> None:
    verdict = sd.diagnose([recorded(k, 0.0) for k in range(3)], NOMINAL)
    assert verdict.verdict == "nothing_missing"
    fit = verdict.as_dict()["fit"]
    assert fit["rmse_after"] < 1.2 * 2e-5
    assert fit["nominal_parameters"]["damping_N_s_per_m"]["value"] == pytest.approx(3.0, rel=0.02)


def tables(*recordings: dict[str, Array]) -> list[Table]:
    return [Table(f"r{k}", columns) for k, columns in enumerate(recordings)]


def test_ports_have_subsystems_of_their_own() -> None:
    model, _, _ = prepare(nominal_of(NOMINAL), tables(recorded(1, 0.0, 300)))
    assert {port.name: port.subsystem for port in model.ports} == {"force": "motor", "x_reading": "scale", "dry": "slide"}


def test_the_same_run_is_simulated_once() -> None:
    model, problem, _ = prepare(nominal_of(NOMINAL), tables(recorded(1, 0.0, 300)))
    theta = model.guess(problem.segments)
    first = model.simulate(problem.segments[0], theta, [])
    calls = model.calls  # type: ignore[attr-defined]
    assert np.array_equal(first, model.simulate(problem.segments[0], theta, []))
    assert model.calls == calls  # type: ignore[attr-defined]
    theta[0] *= 1.1
    model.simulate(problem.segments[0], theta, [])
    assert model.calls == calls + 1  # type: ignore[attr-defined]


def test_every_recording_may_have_an_offset_of_its_own() -> None:
    nominal = {**NOMINAL, "channels": {**NOMINAL["channels"], "x": {"column": "x", "unit": "m", "session_offset": True}}}
    given = []
    for k, offset in enumerate((0.01, -0.02)):
        columns = recorded(k, 0.0, 1200)
        given.append({**columns, "x": columns["x"] + offset})
    from host.diagnosis.selection.refits import fit_nominal, refined

    _, problem, _ = prepare(nominal_of(nominal), tables(*given))
    fit = refined(problem, fit_nominal(problem))
    found = [dict(zip(s.begin.names, s.begin.values, strict=True))["offset:x"] for s in problem.segments if s.begin]
    assert found[0] - found[1] == pytest.approx(0.03, abs=2e-4)
    assert dict(zip(("damping", "stiffness"), fit.values, strict=True))["stiffness"] == pytest.approx(100.0, rel=0.03)


def test_what_is_linearized_predicts_a_simulation() -> None:
    from host.diagnosis.effects import candidates

    model, problem, _ = prepare(nominal_of(NOMINAL), tables(recorded(1, 0.0, 800)))
    segment, theta = problem.segments[0], np.array([3.0, 100.0])
    slopes = model.slopes(segment, theta, [])
    late = next(c for c in candidates(model.ports, True) if c.key == "latency@force")
    change = model.change(segment, theta, slopes, late, np.array([0.01]))
    exact = model.simulate(segment, theta, [(late, np.array([0.01]))]) - model.simulate(segment, theta, [])
    assert np.max(np.abs(change - exact)) < 0.01 * np.max(np.abs(exact))


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("offer", [{"id": "glue", "parameter": "dry", "high": 1.0}], "offer.id"),
        ("offer", [{"id": "backlash", "parameter": "dry", "high": -1.0}], "low <= off <= high"),
        ("offer", [{"id": "backlash", "parameter": "damping", "high": 1.0}], "offer.parameter"),
        ("parameters", {"damping": {"value": 3.0, "low": 5.0}}, "low <= value <= high"),
        ("callable", {**NOMINAL["callable"], "ports": {"y": "motor"}}, "ports"),
        ("callable", {**NOMINAL["callable"], "function": 3}, "module:name"),
    ],
)
def test_a_nominal_that_cannot_be_is_bad_input(key: str, value: Any, wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        prepare(nominal_of({**NOMINAL, key: value}), tables(recorded(1, 0.0, 300)))


MODULE = "def reach(inputs, parameters, time_s):\n    return {'y': parameters['gain'] * FACTOR * inputs['u']}\n"
TOML = """
name = "lever"
kind = "callable"
data = {time = "t"}
channels = {u = {column = "u", unit = "m"}, y = {column = "y", unit = "m"}}
callable = {function = "lever:reach", inputs = ["u"], outputs = ["y"], workers = 2}
parameters = {gain = 1.0}
"""


def lever(folder: Path, factor: float) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "lever.py").write_text(MODULE.replace("FACTOR", str(factor)))
    (folder / "lever.toml").write_text(TOML)
    return folder / "lever.toml"


def test_modules_of_one_name_in_two_folders_are_two_and_run_in_parallel(tmp_path: Path) -> None:
    from host.diagnosis.model.nominal import read_nominal

    t = np.arange(100) * 0.01
    for factor in (2.0, 3.0):
        spec = read_nominal(lever(tmp_path / f"f{factor:.0f}", factor))
        model, problem, _ = prepare(spec, tables(*[{"t": t, "u": np.sin(k * t), "y": t} for k in (1, 2, 3)]))
        out = model.simulate_all(problem.segments, np.array([1.0]), [])
        assert np.allclose(out[2][0], factor * np.sin(3 * t))


def test_code_that_others_may_write_is_refused(tmp_path: Path) -> None:
    nominal = lever(tmp_path / "shared", 1.0)
    t = np.arange(100) * 0.01
    np.savez(tmp_path / "r.npz", t=t, u=np.sin(t), y=np.sin(t))
    arguments = [str(tmp_path / "r.npz"), "--nominal", str(nominal), "--json", "--time-budget", "0"]
    app = typer.Typer()
    app.command()(diagnose_command)
    os.chmod(nominal.with_suffix(".py"), 0o666)
    with pytest.raises(InputError, match=r"lever\.py runs code and may be written by every user"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    trusted = CliRunner().invoke(app, [*arguments, "--trust"], catch_exceptions=False)
    assert trusted.exit_code == 0 and "with your rights" in trusted.stderr
    os.chmod(nominal.with_suffix(".py"), 0o644)
    assert CliRunner().invoke(app, arguments, catch_exceptions=False).exit_code == 0


def bent(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """A tip that a knob bends and a roll turns: static, so that the answer to every input is known from one step of it."""
    r = p["gain"] * np.sin(inputs["knob"])
    return {"x": r * np.cos(inputs["roll"]), "y": r * np.sin(inputs["roll"])}


def crept(number: int, slow_share: float) -> Table:
    """Ten seconds cut from motion: a share of the knob's motion follows over 1.5 s (exact for a held input)."""
    rng, dt_s, before = np.random.default_rng(number), 0.02, 1000
    t: Array = dt_s * (np.arange(before + 500) - float(before))
    tones = rng.uniform(0.05, 0.6, 6), rng.uniform(0.0, 6.0, 6)
    knob = 0.5 + 0.08 * np.sum(np.sin(2.0 * np.pi * np.multiply.outer(t, tones[0]) + tones[1]), axis=1)
    roll = 0.8 * np.sin(2.0 * np.pi * 0.17 * t + rng.uniform(0.0, 6.0))
    keep = np.exp(-dt_s / 1.5)
    slow = lfilter([1.0 - keep], [1.0, -keep], knob, zi=[keep * knob[0]])[0]
    moved = (1.0 - slow_share) * knob + slow_share * slow
    tip = bent({"knob": moved, "roll": roll}, {"gain": 0.05}, t)
    columns = {"t": t - t[before], "knob": knob, "roll": roll}
    columns |= {name: row + 2e-4 * rng.standard_normal(t.size) for name, row in tip.items()}
    return Table(f"r{number}", {name: column[before:] for name, column in columns.items()})


def test_a_slow_share_is_screened_with_the_state_that_a_recording_begins_with() -> None:
    """Cut from motion, the slow part begins anywhere: if the first samples tell it, friction promises more."""
    content: dict[str, Any] = {
        "name": "tip",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {n: {"column": n, "unit": u} for n, u in (("knob", "rad"), ("roll", "rad"), ("x", "m"), ("y", "m"))},
        "callable": {"function": bent, "inputs": ["knob", "roll"], "outputs": ["x", "y"], "subsystem": "tip"},
        "parameters": {"gain": {"value": 0.05, "low": 0.01, "high": 0.2, "unit": "m"}},
    }
    _, problem, _ = prepare(nominal_of(content), [crept(k, 0.15) for k in range(3)])
    nominal = fit_nominal(problem)
    ranked = screen(problem, nominal, candidates(candidate_ports(problem), True), lambda *_: None)
    assert ranked[0].candidate.key == "creep_relaxation@knob"
    assert 0.5 < ranked[0].begin[0][1] < 4.0


def fed(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Reach of a rod that is fed in from where `offset` says, and buckles: a function of fed length alone."""
    length = inputs["feed"] + p["offset"]
    return {"x": length - 40.0 * length**2, "z": 2.0 * length**3}


def feeding(function: Any, offset_m: float, **section: Any) -> dict[str, Any]:
    """Nominal model of the rod that is fed in."""
    return {
        "name": "rod",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {n: {"column": n, "unit": "m"} for n in ("feed", "x", "z")},
        "callable": {"function": function, "inputs": ["feed"], "outputs": ["x", "z"], **section},
        "parameters": {"offset": {"value": offset_m, "unit": "m"}},
    }


def feed(number: int, acts: Callable[[Array, Array], Array]) -> dict[str, Array]:
    """Recording of the rod: `acts` makes of time and feed (n,) what is fed in."""
    rng, t = np.random.default_rng(number), np.arange(600) * 0.02
    given = 0.01 * np.sin(2.0 * np.pi * 0.3 * t + number) + 0.005 * np.sin(2.0 * np.pi * 0.71 * t)
    out = fed({"feed": acts(t, given)}, {"offset": 0.1}, t)
    return {"t": t, "feed": given, **{name: row + 1e-4 * rng.standard_normal(t.size) for name, row in out.items()}}


def test_a_start_is_not_made_of_what_a_nominal_parameter_hardly_leaves() -> None:
    """An offset of the feed is a nominal parameter: what differences leave of its response asks for decimetres."""
    runs = [feed(k, lambda t, given: given + 1e-3 * np.sin(2.0 * np.pi * 1.1 * t)) for k in range(2)]
    _, problem, _ = prepare(nominal_of(feeding(fed, 0.1)), tables(*runs))
    nominal = fit_nominal(problem)
    ranked = screen(problem, nominal, candidates(candidate_ports(problem), True), lambda *_: None)
    starts = [begin for item in ranked if item.candidate.key == "sensor_bias@feed" for begin in item.begin]
    assert starts and all(abs(begin[0]) < 0.05 for begin in starts)


def pulled_in(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """A rod as above; one that is pulled in altogether cannot be computed."""
    if float(np.min(inputs["feed"])) + p["offset"] < 0.085:
        raise ValueError("the rod is pulled in")
    return fed(inputs, p, time_s)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_simulator_that_fails_in_some_runs_is_diagnosed(workers: int) -> None:
    function = f"{__name__}:pulled_in"
    recordings = [feed(k, lambda t, given: np.interp(t - 0.05, t, given)) for k in range(3)]
    verdict = sd.diagnose(recordings, feeding(function, 0.11, workers=workers))
    assert verdict.effects[0]["id"] == "latency"
    (failed,) = [f for f in verdict.data_findings if f["id"] == "simulator_failed"]
    assert "the rod is pulled in" in str(failed["says"])
    with pytest.raises(InputError, match="the rod is pulled in"):
        sd.diagnose(recordings, feeding(function, 0.05, workers=workers))


def swung(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Tip of a rod of fed length that turns by an angle."""
    length, angle = inputs["feed"] + p["offset"], p["gain"] * inputs["angle"]
    return {"x": length * np.cos(angle), "z": length * np.sin(angle)}


def swinging(number: int, gap: float = 0.0) -> dict[str, Array]:
    """Feed and angle of several tones; the angle passes a gap."""
    rng, t = np.random.default_rng(number), np.arange(800) * 0.02
    feed = 0.01 * np.sin(2.0 * np.pi * 0.3 * t + number) + 0.005 * np.sin(2.0 * np.pi * 0.71 * t)
    angle, turned = 0.3 * np.sin(2.0 * np.pi * 0.17 * t + 2.0 * number), np.empty(t.size)
    at = angle[0]
    for i, a in enumerate(angle):
        turned[i] = at = min(max(at, a - 0.5 * gap), a + 0.5 * gap)
    out = swung({"feed": feed, "angle": turned}, {"offset": 0.1, "gain": 1.0}, t)
    rows = {name: row + 1e-4 * rng.standard_normal(t.size) for name, row in out.items()}
    return {"t": t, "feed": feed, "angle": angle, **rows}


def swing(function: Any = swung, **parameters: Any) -> dict[str, Any]:
    """Nominal model of the rod that turns."""
    return {
        "name": "rod",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {n: {"column": n, "unit": "rad" if n == "angle" else "m"} for n in ("feed", "angle", "x", "z")},
        "callable": {"function": function, "inputs": ["feed", "angle"], "outputs": ["x", "z"]},
        "parameters": parameters,
    }


FREE = {"offset": {"value": 0.11, "unit": "m"}, "gain": {"value": 0.9, "unit": "1"}}


def test_inputs_that_would_cause_far_more_than_is_measured_are_not_tried() -> None:
    """A simulator of large deflections takes minutes for a thousand times the force, or a feed of metres."""
    most = 0.0

    def watched(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
        nonlocal most
        most = max(most, float(np.max(np.abs(inputs["feed"]))))
        return fed(inputs, p, time_s)

    runs = [feed(k, lambda t, given: given + 0.02 * np.sin(2.0 * np.pi * 1.1 * t)) for k in range(2)]
    _, problem, _ = prepare(nominal_of(feeding(watched, 0.1)), tables(*runs))
    readings_apart(problem, [segment.recording for segment in problem.segments])
    assert most < 1.0


@pytest.mark.parametrize(
    ("channel", "factor"), [("angle", 180.0 / np.pi), ("angle", np.pi / 180.0), ("feed", 1e3), ("feed", 1e-3)]
)
@pytest.mark.parametrize("gap", [0.0, 0.02])
def test_an_input_in_another_unit_is_found_behind_a_simulator_that_is_not_linear(
    channel: str, factor: float, gap: float
) -> None:
    """An angle in degrees called rad: no output shows a factor, and two curves and a coupling were named."""
    recordings = [{**r, channel: factor * r[channel]} for r in (swinging(k, gap) for k in (1, 2, 3))]
    verdict = sd.diagnose(recordings, swing(**FREE))
    assert [(f["id"], f["channel"]) for f in verdict.data_findings] == [("unit", channel)]
    assert [effect["id"] for effect in verdict.effects] == (["backlash"] if gap else [])


JOINTS = ("shoulder_rad", "elbow_rad")


@pytest.mark.parametrize(
    ("mistake", "found"),
    [
        (lambda r: {**r, "shoulder_rad": r["elbow_rad"], "elbow_rad": r["shoulder_rad"]}, ("swapped", "shoulder_rad")),
        (lambda r: {**r, "shoulder_Nm": r["elbow_Nm"], "elbow_Nm": r["shoulder_Nm"]}, ("swapped", "shoulder_Nm")),
        (lambda r: {**r, "elbow_rad": -r["elbow_rad"]}, ("sign", "elbow_rad")),
        (lambda r: {**r, **{n: np.degrees(r[n]) for n in JOINTS}}, ("unit", "shoulder_rad")),
    ],
)
def test_mistakes_in_the_columns_of_an_arm_are_found(mistake: Any, found: tuple[str, str]) -> None:
    verdict = sd.diagnose([mistake(test_forces.recorded(k)) for k in range(3)], test_forces.nominal())
    assert [(f["id"], f["channel"]) for f in verdict.data_findings] == [found]
    assert verdict.effects == []


@pytest.mark.parametrize("gap", [0.0, 0.02])
@pytest.mark.parametrize("held", [False, True])
def test_a_simulator_may_have_no_free_parameter(gap: float, held: bool) -> None:
    exact = {"offset": 0.1, "gain": 1.0}
    nominal = swing(lambda i, p, t: swung(i, exact, t))
    if held:
        nominal = swing(**{name: {"value": value, "free": False} for name, value in exact.items()})
    verdict = sd.diagnose([swinging(k, gap) for k in (1, 2, 3)], nominal)
    assert [effect["id"] for effect in verdict.effects] == (["backlash"] if gap else [])


def test_a_simulator_that_gives_no_numbers_others_each_time_or_one_is_refused() -> None:
    rng = np.random.default_rng(1)

    def shaken(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
        return {name: row + 1e-4 * rng.standard_normal(row.size) for name, row in swung(inputs, p, time_s).items()}

    def lost(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
        return {**swung(inputs, p, time_s), "z": np.full(time_s.size, np.nan)}

    def deaf(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
        return {name: np.full(time_s.size, 0.3) for name in swung(inputs, p, time_s)}

    for function, found in ((shaken, "differs by"), (lost, "no number in z"), (deaf, "stays at 0.3 while its inputs move")):
        with pytest.raises(InputError, match=found):
            sd.diagnose([swinging(k) for k in (1, 2, 3)], swing(function, **FREE))


@njit(cache=True)
def hung(torque: Array, dt_s: float, angle: float, rate: float, damping: float, weight: float) -> Array:
    """Angle of a pendulum of 0.04 kg m2, four steps a sample, the torque straight between samples."""
    out, h = np.empty(torque.size), dt_s / 4
    for i in range(torque.size):
        out[i] = angle
        for j in range(4):
            pull = torque[i] + (torque[min(i + 1, torque.size - 1)] - torque[i]) * j / 4
            rate += h * (pull - damping * rate - weight * np.sin(angle)) / 0.04
            angle += h * rate
    return out


def hanging(inputs: dict[str, Array], p: dict[str, float], time_s: Array, start: dict[str, float]) -> dict[str, Array]:
    dt_s = float(time_s[1] - time_s[0])
    return {"q": hung(inputs["T"], dt_s, start["q"], start["q_rate"], p["damping"], p["weight"])}


def test_a_state_is_found_far_from_where_it_is_measured() -> None:
    """The rate at rest was put 0.08 rad/s off, and a delay was named that hid it. The outputs are not linear in it."""
    rows, t = [], np.arange(0.0, 10.0, 0.01)
    for number in range(2):
        rng = np.random.default_rng([96, number])
        tones = np.sin(2.0 * np.pi * np.outer(t, (0.15, 0.4, 0.9)) + rng.uniform(0.0, 6.28, 3))
        torque = 0.28 * tones @ np.array([1.0, 0.6, 0.4])
        angle = hung(torque, 0.01, 0.0, 0.0, 0.03, 0.7)
        rows.append({"t": t, "T": torque, "q": angle + 2e-3 * rng.standard_normal(t.size)})
    section = {"function": hanging, "inputs": ["T"], "outputs": ["q"]}
    parameters = {"damping": {"value": 0.02, "low": 0.0, "high": 1.0}, "weight": {"value": 0.6, "low": 0.01, "high": 5.0}}
    channels = {"T": {"column": "T", "unit": "N m"}, "q": {"column": "q", "unit": "rad"}}
    nominal = {"name": "pendulum", "kind": "callable", "data": {"time": "t"}, "channels": channels, "callable": section}
    found = sd.diagnose(rows, {**nominal, "parameters": parameters})
    assert found.verdict == "nothing_missing"
    problem = found.diagnosis.problem
    rates = [float(segment.begin.values[1]) for segment in problem.segments if segment.begin is not None]
    assert rates == pytest.approx([0.0, 0.0], abs=0.01)


@njit(cache=True)
def driven(force: Array, dt_s: float, place: float, speed: float, law: tuple[float, ...]) -> Array:
    """Places and speeds (2, n) of a mass; law: mass, damping, stiffness, cubic stiffness, drag (square of the speed)."""
    mass, damping, stiffness, cubic, drag = law
    out, h = np.empty((2, force.size)), dt_s / 8
    for i in range(force.size):
        out[0, i], out[1, i] = place, speed
        for _ in range(8):
            held = damping * speed + stiffness * place + cubic * place**3 + drag * speed * abs(speed)
            speed += h * (force[i] - held) / mass
            place += h * speed
    return out


def sprung(inputs: dict[str, Array], p: dict[str, float], time_s: Array, start: dict[str, float]) -> dict[str, Array]:
    law = (0.5, p["damping"], p["stiffness"], 0.0, 0.0)
    return {"x": driven(inputs["F"], float(time_s[1] - time_s[0]), start["x"], start["x_rate"], law)[0]}


def rolling(inputs: dict[str, Array], p: dict[str, float], time_s: Array, start: dict[str, float]) -> dict[str, Array]:
    law = (p["mass"], p["damping"], 0.0, 0.0, 0.0)
    return {"v": driven(inputs["u"], float(time_s[1] - time_s[0]), 0.0, start["v"], law)[1]}


def pushed(dt_s: float, samples: int, size: float, law: tuple[float, ...]) -> list[tuple[Array, Array]]:
    """Three forces (n,) of several tones, and the motion (2, n) each drives, cut from motion."""
    out, t = [], np.arange(samples + 200) * dt_s
    for number in range(3):
        rng = np.random.default_rng([97, number])
        angle = 2.0 * np.pi * np.outer(t, np.array([0.0012, 0.0027, 0.006, 0.011]) / dt_s) + rng.uniform(0.0, 6.28, 4)
        force = size * np.sin(angle) @ np.array([1.0, 0.7, 0.5, 0.4])
        out.append((force[200:], driven(force, dt_s, 0.0, 0.0, law)[:, 200:]))
    return out


def test_a_hardening_spring_inside_a_simulator_is_found() -> None:
    """A resonance was named (0.48): effects were tried at the input and at the reading only."""
    rng, dt_s, rows = np.random.default_rng(98), 0.005, []
    for force, (place, _) in pushed(dt_s, 2000, 1.5, (0.5, 2.0, 120.0, 4e4, 0.0)):
        reading = place + 2e-4 * rng.standard_normal(place.size)
        rows.append({"t": np.arange(force.size) * dt_s, "F": force, "x": reading})
    nominal = free_of("sprung", sprung, ("F", "N"), ("x", "m"), damping=1.5, stiffness=150.0)
    nominal["callable"]["forces_inside"] = True
    (effect,) = sd.diagnose(rows, nominal).effects
    assert (effect["id"], effect["port"]) == ("nonlinear_stiffness", "F_along_x")
    assert effect["parameters"]["cubic_N_per_m3"]["value"] == pytest.approx(4e4, rel=0.05)


def of_a_cart(drag: float, noise: float, **section: Any) -> Any:
    """Verdict on three recordings of the speed of a cart."""
    rng, dt_s, rows = np.random.default_rng(99), 0.05, []
    for force, (_, speed) in pushed(dt_s, 1200, 1.5, (1.4, 0.5, 0.0, 0.0, drag)):
        reading = speed + noise * rng.standard_normal(speed.size)
        rows.append({"t": np.arange(force.size) * dt_s, "u": force, "v": reading})
    nominal = free_of("cart", rolling, ("u", "N"), ("v", "m/s"), damping=0.4, mass=1.0)
    nominal["callable"] |= section
    return sd.diagnose(rows, nominal)


def test_a_drag_inside_a_simulator_of_a_speed_is_found() -> None:
    """A curve of the input was named (0.53), or nothing."""
    (effect,) = of_a_cart(0.1, 0.01).effects
    assert (effect["id"], effect["port"]) == ("viscous_friction", "u_along_v")
    assert effect["parameters"]["coefficient_N_s2_per_m2"]["value"] == pytest.approx(0.1, rel=0.05)


def test_a_cart_whose_measured_speed_is_noisy_lacks_nothing() -> None:
    """A linear law of the measured speed would be an observer: it takes out noise, and a negative damping was named."""
    assert of_a_cart(0.0, 0.02, forces_inside=True).verdict == "nothing_missing"


def free_of(name: str, function: Any, given: tuple[str, str], read: tuple[str, str], **parameters: float) -> dict[str, Any]:
    """Nominal model of a simulator with one input and one output (name and unit), which offers nothing."""
    return {
        "name": name,
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {column: {"column": column, "unit": unit} for column, unit in (given, read)},
        "callable": {"function": function, "inputs": [given[0]], "outputs": [read[0]]},
        "parameters": {key: {"value": value, "low": 0.0, "high": 1000.0} for key, value in parameters.items()},
    }
