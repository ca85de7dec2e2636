"""Recordings as other laboratories make them: servos without a spring, tared sessions, clocks of two computers, cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import signal

from host.diagnosis import diagnose
from host.diagnosis.effects import candidates
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.problems import inspected, prepare
from host.diagnosis.selection.readings_apart import readings_apart
from host.diagnosis.selection.refits import fit_nominal
from host.diagnosis.selection.search import search

pytestmark = pytest.mark.slow  # together: each takes some seconds

Array = np.ndarray
SERVO: dict[str, Any] = {
    "name": "servo",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"voltage": {"column": "u", "unit": "V"}, "angle": {"column": "y", "unit": "rad"}},
    "linear": {
        "inputs": ["voltage"],
        "outputs": ["angle"],
        "numerator": ["gain"],
        "denominator": ["tau", 1.0, 0.0],
        "subsystem": "servo",
    },
    "parameters": {"gain": 7.5, "tau": 0.1},
}
FLEXURE: dict[str, Any] = {
    "name": "flexure",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"force": {"column": "u", "unit": "N"}, "position": {"column": "y", "unit": "m"}},
    "linear": {"inputs": ["force"], "outputs": ["position"], "numerator": [1.0], "denominator": ["m", "c", "k"]},
    "parameters": {"m": 0.08, "c": 3.5, "k": 850.0},
}
PAD: dict[str, Any] = {
    "name": "pad",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"depth": {"column": "x", "unit": "m"}, "force": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "pad", "input": "depth", "output": "force", "terms": ["damping", "stiffness", "offset"]},
    "parameters": {"stiffness": 600.0, "damping": 10.0},
}
FINGER: dict[str, Any] = {
    "name": "finger",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"motor": {"column": "m", "unit": "rad"}, "finger": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "tendon", "input": "motor", "output": "finger"}],
    "parameters": {"gain": 0.8},
}


def walk(rng: np.random.Generator, t: Array, fastest_Hz: float, size: float) -> Array:
    """A smooth motion with tones up to `fastest_Hz` and unlike phases."""
    hertz = fastest_Hz * np.array([0.13, 0.29, 0.47, 0.71, 1.0])
    return size * np.sum([np.sin(2 * np.pi * f * t + rng.uniform(0.0, 6.28)) / (1.0 + f) for f in hertz], axis=0)


def turned(u: Array, dt_s: float, gain: float, tau: float, angle: float, speed: float) -> Array:
    """Angle of a motor under held voltages, by the exponential formula of each period."""
    out, fade = np.empty(u.size), np.exp(-dt_s / tau)
    for k, voltage in enumerate(u):
        out[k] = angle
        final = gain * voltage
        angle += final * dt_s + (speed - final) * tau * (1.0 - fade)
        speed = final + (speed - final) * fade
    return out


def ids(content: dict[str, Any]) -> set[str]:
    return {finding["id"] for finding in content["data_findings"]}


def test_a_servo_in_motion_is_fitted_together_with_its_first_speed() -> None:
    rng, runs = np.random.default_rng(11), []
    for speed in (-3.0, 9.0):
        t = 0.01 * np.arange(1200)
        u = np.repeat(rng.choice([-4.0, -2.0, 0.0, 2.0, 4.0], 48), 25)
        y = turned(u, 0.01, 8.0, 0.12, 0.4, speed) + 0.01 * rng.normal(size=t.size)
        runs.append(Table(f"run {speed}", {"t": t, "u": u, "y": y}))
    _, problem, _ = prepare(nominal_of(SERVO), runs)
    fit = fit_nominal(problem)
    assert fit.values == pytest.approx([8.0, 0.12], rel=0.005)
    assert np.std(fit.residuals[0]) == pytest.approx(0.01, rel=0.1)


def coil(rng: np.random.Generator, sign: float, scale: float) -> Table:
    """A voice coil on a flexure, 0.085 kg, 4 N s/m, 900 N/m, from rest."""
    t = 0.002 * np.arange(1500)
    u = walk(rng, t, 12.0, 2.0)
    held = signal.cont2discrete(([1.0], [0.085, 4.0, 900.0]), 0.002, "zoh")
    y = signal.lfilter(held[0].ravel(), held[1], u)
    return Table("coil", {"t": t, "u": u, "y": sign * scale * (y + 2e-5 * rng.normal(size=t.size))})


@pytest.mark.parametrize(
    ("sign", "scale", "wanted"),
    [(1.0, 1.0, set()), (-1.0, 1.0, {"sign"}), (1.0, 1e3, {"unit"}), (-1.0, 1e-3, {"sign", "unit"})],
)
def test_sign_and_unit_of_a_simulated_output_are_put_right(sign: float, scale: float, wanted: set[str]) -> None:
    sources = [coil(np.random.default_rng(12), sign, scale)]
    _, problem, _ = prepare(nominal_of(FLEXURE), sources)
    recordings = [segment.recording for segment in problem.segments]
    right, findings = readings_apart(problem, recordings)
    assert {finding.id for finding in findings} == wanted
    assert right[0].channels["position"] == pytest.approx(sources[0].columns["y"] / (sign * scale))


@pytest.mark.parametrize(("mixed", "found"), [(0.0, True), (0.6, False)])
def test_exchanged_outputs_of_two_links_are_said_to_be(mixed: float, found: bool) -> None:
    """mixed: share of the other axis in each; outputs that follow both inputs are coupled, not exchanged."""
    runs = []
    for seed in (51, 52):
        rng, t = np.random.default_rng(seed), 0.02 * np.arange(1500)
        pan, tilt = walk(rng, t, 0.7, 0.3), walk(rng, t, 0.9, 0.2)
        y, z = (x + 1e-3 * rng.normal(size=t.size) for x in (tilt + mixed * pan, pan + mixed * tilt))
        runs.append(Table(f"r{seed}", {"t": t, "a": pan, "b": tilt, "y": y, "z": z}))
    channels = {name: {"column": name, "unit": "rad"} for name in ("a", "b", "y", "z")}
    links = [{"subsystem": "pan", "input": "a", "output": "y"}, {"subsystem": "tilt", "input": "b", "output": "z"}]
    head = {"name": "head", "kind": "transmission", "data": {"time": "t"}, "channels": channels, "link": links}
    seen = inspected(nominal_of(head), runs)
    assert ("swapped" in {finding.id for finding in seen.findings}) is found
    if found:
        assert seen.recordings[0].channels["y"] == pytest.approx(runs[0].columns["z"])


def test_exchanged_outputs_of_a_simulator_are_said_to_be() -> None:
    rng = np.random.default_rng(13)
    t = 0.01 * np.arange(800)
    left, right = walk(rng, t, 3.0, 0.1), walk(rng, t, 2.0, 0.1)
    nominal = {
        "name": "pair",
        "kind": "linear",
        "data": {"time": "t"},
        "channels": {name: {"column": name, "unit": "m"} for name in ("a", "b", "y", "z")},
        "linear": {
            "inputs": ["a", "b"],
            "outputs": ["y", "z"],
            "A": [["-1 / tau", 0.0], [0.0, "-1 / tau"]],
            "B": [["1 / tau", 0.0], [0.0, "1 / tau"]],
            "C": [[1.0, 0.0], [0.0, 1.0]],
        },
        "parameters": {"tau": 0.05},
    }
    late = [signal.lfilter([0.0, 0.2], [1.0, -0.8], x) + 1e-3 * rng.normal(size=t.size) for x in (left, right)]
    _, problem, _ = prepare(nominal_of(nominal), [Table("run", {"t": t, "a": left, "b": right, "y": late[1], "z": late[0]})])
    changed, findings = readings_apart(problem, [segment.recording for segment in problem.segments])
    assert [finding.id for finding in findings] == ["swapped"]
    assert changed[0].channels["y"] == pytest.approx(late[0])


def pressed(rng: np.random.Generator, lead_s: float, relaxing: float) -> dict[str, Array]:
    """A pad of 650 N/m and 12 N s/m; its force `lead_s` early, or with a branch that relaxes in 0.15 s."""
    t = 0.01 * np.arange(-200, 1800)
    x = walk(rng, t, 1.7, 0.004)
    slow = signal.lfilter([1.0 - np.exp(-0.01 / 0.15)], [1.0, -np.exp(-0.01 / 0.15)], x)
    force = 650.0 * x + 12.0 * np.gradient(x, 0.01) + relaxing * (x - slow) + 0.4
    f = np.interp(t + lead_s, t, force)[200:-200]
    n = f.size
    return {"t": t[200:-200], "x": x[200:-200] + 2e-5 * rng.normal(size=n), "f": f + 0.05 * rng.normal(size=n)}


def test_a_force_that_comes_before_its_motion_is_a_clock() -> None:
    rng = np.random.default_rng(14)
    content = diagnose([pressed(rng, 0.08, 0.0) for _ in range(2)], PAD).as_dict()
    assert ids(content) == {"clock"} and content["verdict"] == "nothing_missing"
    assert "0.08 s before" in content["data_findings"][0]["says"]
    assert content["fit"]["nominal_parameters"]["damping_N_s_per_m"]["value"] == pytest.approx(12.0, abs=1.0)


def test_a_relaxing_pad_is_no_clock() -> None:
    rng = np.random.default_rng(15)
    content = diagnose([pressed(rng, 0.0, 500.0) for _ in range(2)], PAD).as_dict()
    assert "clock" not in ids(content)
    assert [effect["id"] for effect in content["effects"]] == ["creep_relaxation"]


def test_play_before_a_late_camera_is_two_effects_and_no_dead_band_of_a_loop() -> None:
    rng, runs = np.random.default_rng(16), []
    for _ in range(2):
        fine = np.arange(-2.0, 20.0, 0.002)
        motor = walk(rng, fine, 0.6, 0.35)
        slack, at = np.empty_like(motor), motor[0]
        for k, angle in enumerate(motor):
            at = np.clip(at, angle - 0.026, angle + 0.026)
            slack[k] = at
        t = np.arange(0.0, 20.0, 1 / 30)
        seen = 0.8 * np.interp(t - 0.07, fine, slack) + 0.006 * rng.normal(size=t.size)
        runs.append(Table("finger", {"t": t, "m": np.interp(t, fine, motor), "y": seen}))
    model, problem, _ = prepare(nominal_of(FINGER), runs)
    best = search(problem, candidates(model.ports, True, model.taken), lambda what, part: None).best
    found = {term.candidate.effect.id: float(best.values_of(term)[0]) for term in best.terms}
    assert found == {"backlash": pytest.approx(0.052, abs=0.004), "latency": pytest.approx(0.07, abs=0.004)}


def braked(torque: Array, dt_s: float, inertia: float, damping: float, friction: float) -> Array:
    """Speed of a rotor under held torques with Coulomb friction: exponentials between the instants at which it stops."""
    out, w = np.empty(torque.size), 0.0
    for k, drive in enumerate(torque):
        out[k], rest = w, dt_s
        while rest > 0.0:
            side = np.sign(w) or (np.sign(drive) if abs(drive) > friction else 0.0)
            if side == 0.0:
                break
            final, tau = (drive - side * friction) / damping, inertia / damping
            stop = tau * np.log((w - final) / -final) if w != 0.0 and np.sign(final) != side else np.inf
            step = min(rest, stop)
            w = 0.0 if step == stop else final + (w - final) * np.exp(-step / tau)
            rest -= step
    return out


def test_friction_of_a_small_motor_is_found_from_its_tachometer() -> None:
    rng, runs = np.random.default_rng(18), []
    for _ in range(2):
        t = 0.004 * np.arange(1500)
        torque = walk(rng, t, 1.5, 0.02)
        speed = braked(torque, 0.004, 3.1e-4, 2e-3, 0.012) + 0.8 * rng.normal(size=t.size)
        runs.append(Table("motor", {"t": t, "m": torque, "w": speed}))
    nominal = {
        "name": "motor",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"torque": {"column": "m", "unit": "N m"}, "speed": {"column": "w", "unit": "rad/s"}},
        "axis": {
            "subsystem": "motor",
            "input": "torque",
            "output": "speed",
            "terms": ["mass", "damping", "offset"],
            "hold": "zero",
            "reads": "velocity",
        },
        "parameters": {"mass": 3e-4, "damping": 2.5e-3},
    }
    model, problem, _ = prepare(nominal_of(nominal), runs)
    (term,) = search(problem, candidates(model.ports, True, model.taken), lambda what, part: None).best.terms
    assert term.candidate.effect.id == "coulomb_friction"


def tared(inputs: dict[str, Array], parameters: dict[str, float], time_s: Array) -> dict[str, Array]:
    return {"cell": parameters["gain"] * inputs["force"]}


@pytest.mark.parametrize(
    "kind",
    [
        {"kind": "callable", "callable": {"function": tared, "inputs": ["force"], "outputs": ["cell"]}},
        {"kind": "transmission", "link": [{"subsystem": "cell", "input": "force", "output": "cell"}]},
    ],
)
def test_sessions_with_a_tare_of_their_own_lack_nothing(kind: dict[str, Any]) -> None:
    rng, runs = np.random.default_rng(17), []
    for tare in (0.8, -1.7, 0.2):
        t = 0.02 * np.arange(1500)
        force = 50.0 + walk(rng, t, 0.9, 25.0)
        runs.append({"t": t, "f": force, "y": 1.003 * force + tare + 0.3 * rng.normal(size=t.size)})
    nominal = {
        "name": "cell",
        "data": {"time": "t"},
        "channels": {
            "force": {"column": "f", "unit": "N"},
            "cell": {"column": "y", "unit": "N", "session_offset": True},
        },
        "parameters": {"gain": 1.0},
        **kind,
    }
    content = diagnose(runs, nominal).as_dict()
    assert content["verdict"] == "nothing_missing" and not content["effects"]
    assert content["fit"]["nominal_parameters"]["gain"]["value"] == pytest.approx(1.003, abs=0.001)
