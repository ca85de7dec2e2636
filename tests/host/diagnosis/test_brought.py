"""Kinds of recordings that a stranger brought: noisy motions, speeds and accelerations, random stamps, fitted gains."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, lfilter

import seldinger as sd
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.spectral_line import common_line
from host.diagnosis.model.tables import Table
from host.diagnosis.models.linear import StateSpace, closed_loop, sampled
from host.diagnosis.problems import inspected

Array = np.ndarray
RATE_HZ = 100.0


def stream(number: int) -> np.random.Generator:
    return np.random.default_rng([4711, number])


def sweep(rng: np.random.Generator, t: Array, fastest_Hz: float, size: float) -> Array:
    """Five sines of random phase, the faster ones smaller; RMS about `size`."""
    hertz = fastest_Hz * np.array([0.06, 0.15, 0.31, 0.58, 1.0])
    part = hertz**-0.6 / np.sqrt(0.5 * np.sum(hertz**-1.2))
    return np.asarray(size * np.sin(2.0 * np.pi * np.outer(t, hertz) + rng.uniform(0.0, 6.28, 5)) @ part)


def driven(force: Array, mass: float, damping: float, stiffness: float, hold: str = "foh") -> Array:
    """Position, speed and acceleration (n, 3) under a force that is held or runs straight between samples, exactly."""
    A, B = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]]), np.array([[0.0], [1.0 / mass]])
    C, D = np.array([[1.0, 0.0], [0.0, 1.0], A[1]]), np.array([[0.0], [0.0], [1.0 / mass]])
    return np.asarray(dlsim(cont2discrete((A, B, C, D), 1.0 / RATE_HZ, hold), force)[1])


def axis(terms: list[str], reads: str, hold: str, **parameters: float) -> dict[str, Any]:
    unit = {"position": "m", "velocity": "m/s", "acceleration": "m/s2"}[reads]
    return {
        "name": "slide",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"force": {"column": "f", "unit": "N"}, "slide": {"column": "y", "unit": unit}},
        "axis": {"subsystem": "slide", "input": "force", "output": "slide", "terms": terms, "reads": reads, "hold": hold},
        "parameters": parameters,
    }


def transmission(unit: str, **gain: Any) -> dict[str, Any]:
    return {
        "name": "meter",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {"flow": {"column": "q", "unit": unit}, "meter": {"column": "y", "unit": unit}},
        "link": [{"subsystem": "meter", "input": "flow", "output": "meter"}],
        "parameters": {"gain": gain},
    }


@pytest.mark.parametrize("number", [2, 6])
def test_the_noise_of_a_motion_is_not_cancelled_by_a_second_mass(number: int) -> None:
    """Without the noise that the effect takes out of the balance, a second mass was named: 0.85 and 0.92."""
    rng = stream(number)
    t = np.arange(0.0, 18.0, 1.0 / RATE_HZ)
    force = sweep(rng, t, 1.6, 4.0)
    place = driven(force, 1.8, 3.0, 0.0, "zoh")[:, 0]
    part = slice(300, None)
    recording = {"t": t[part], "f": force[part], "y": place[part] + 1e-4 * rng.standard_normal(t.size)[part]}
    verdict = sd.diagnose([recording], axis(["mass", "damping", "offset"], "position", "zero"))
    assert verdict.verdict == "nothing_missing", verdict.effects


def test_a_slow_axis_starts_anywhere_if_its_position_is_not_read() -> None:
    """An axis of 0.5 Hz that starts 0.3 m from rest: within a scale of 50 ms of its acceleration no start fitted it."""
    recordings = []
    for number in (1, 2):
        rng = stream(10 + number)
        t = np.arange(0.0, 15.0, 1.0 / RATE_HZ)
        force = sweep(rng, t, 4.0, 3.0)
        force[:300] += 4.0  # pushed aside, and let go as the recording begins
        y = driven(force, 1.0, 0.8, 10.0, "foh")[:, 2]
        y = y + 0.01 * np.std(y) * rng.standard_normal(t.size)
        recordings.append({"t": t[300:], "f": force[300:], "y": y[300:]})
    nominal = axis(["mass", "damping", "stiffness"], "acceleration", "linear", mass=1.2, damping=1.0, stiffness=9.0)
    verdict = sd.diagnose(recordings, nominal).as_dict()
    assert verdict["verdict"] == "nothing_missing", verdict["effects"]
    fitted = verdict["fit"]["nominal_parameters"]
    assert next(v["value"] for k, v in fitted.items() if k.startswith("mass")) == pytest.approx(1.0, rel=0.02)


def swung(inputs: dict[str, Array], values: dict[str, float], time_s: Array, start: dict[str, float]) -> dict[str, Array]:
    """A pendulum under a torque that is held between samples, by half-steps of speed and angle (Verlet)."""
    angle, rate, h = start["angle"], start["angle_rate"], float(time_s[1] - time_s[0]) / 5.0
    out = np.empty(time_s.size)
    for k, torque in enumerate(inputs["torque"]):
        out[k] = angle
        for _ in range(5):
            angle += 0.5 * h * rate
            rate += h * (torque - values["damping"] * rate - values["gravity"] * np.sin(angle))
            angle += 0.5 * h * rate
    return {"angle": out}


def test_degrees_that_also_start_a_simulator_are_found() -> None:
    """A pendulum that starts at 20 degrees called radians turns over: nothing alike is simulated from there."""
    t = np.arange(0.0, 11.0, 0.02)
    recordings = []
    for number in (1, 2):
        rng = stream(40 + number)
        torque = sweep(rng, t, 1.2, 4.0)
        angle = swung({"torque": torque}, {"damping": 0.6, "gravity": 18.0}, t, {"angle": 0.0, "angle_rate": 0.0})["angle"]
        degrees = np.rad2deg(angle + 0.005 * rng.standard_normal(t.size))
        recordings.append({"t": t[150:], "u": torque[150:], "y": degrees[150:]})
    pendulum = {
        "name": "pendulum",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {"torque": {"column": "u", "unit": "N m"}, "angle": {"column": "y", "unit": "rad"}},
        "callable": {"function": swung, "inputs": ["torque"], "outputs": ["angle"], "subsystem": "pendulum"},
        "parameters": {
            "gravity": {"value": 16.5, "low": 1.0, "high": 100.0},
            "damping": {"value": 0.7, "low": 0.01, "high": 10.0},
        },
    }
    verdict = sd.diagnose(recordings, pendulum).as_dict()
    assert "57.3" in next(f["says"] for f in verdict["data_findings"] if f["id"] == "unit")
    assert verdict["verdict"] == "nothing_missing"


def metered(factor: float) -> list[dict[str, Array]]:
    recordings = []
    for number in range(3):
        rng = stream(20 + number)
        t = np.arange(0.0, 30.0, 0.05)
        q = 6.0 + sweep(rng, t, 1.0, 1.0)
        recordings.append({"t": t, "q": q, "y": factor * q + 0.05 * rng.standard_normal(t.size)})
    return recordings


def test_a_gain_that_was_fitted_is_stated() -> None:
    verdict = sd.diagnose(metered(1.08), transmission("l/min", value=1.0)).as_dict()
    assert verdict["verdict"] == "nothing_missing"
    assert "gain 1.0" in verdict["next"] and "(stated: 1)" in verdict["next"], verdict["next"]
    verdict = sd.diagnose(metered(1.0), transmission("l/min", value=1.0)).as_dict()
    assert verdict["next"] == "Nothing: the nominal model explains these recordings."


def test_an_offset_near_zero_is_determined_where_the_gain_is_held() -> None:
    """0 +- 0.01 l/min of readings that vary by 1 l/min: there is nothing to record again."""
    verdict = sd.diagnose(metered(1.03), transmission("l/min", value=1.0, free=False)).as_dict()
    assert verdict["effects"][0]["id"] == "sensor_scale"
    assert not [f for f in verdict["data_findings"] if f["id"] == "excitation"], verdict["data_findings"]


def test_random_stamps_are_no_missing_samples() -> None:
    """Samples at random times leave steps of an even grid empty. Every sample that was taken is there."""
    recordings = []
    for number in range(3):
        rng = stream(30 + number)
        t = np.sort(rng.uniform(0.0, 20.0, 2000))
        q = 6.0 + sweep(rng, t, 1.0, 1.0)
        recordings.append({"t": t, "q": q, "y": q + 0.05 * rng.standard_normal(t.size)})
    spec = nominal_of(transmission("l/min", value=1.0))
    findings = inspected(spec, [Table(f"r{k}", r) for k, r in enumerate(recordings)]).findings
    assert "missing" not in {f.id for f in findings}
    assert "% of the steps" in next(f.says for f in findings if "not even" in f.says)
    half = [{**r, "y": np.where(np.arange(2000) % 2 == 0, r["y"], np.nan)} for r in recordings]
    assert "missing" in {f.id for f in inspected(spec, [Table(f"r{k}", r) for k, r in enumerate(half)]).findings}


def hummed(phases: tuple[float, ...], amplitude: float) -> list[dict[str, Array]]:
    recordings = []
    for number, phase in enumerate(phases):
        rng = stream(50 + number)
        t = np.arange(0.0, 20.0, 1.0 / 60.0)
        q = sweep(rng, t, 1.0, 1.0)
        noise = 0.04 * rng.standard_normal(t.size)
        recordings.append({"t": t, "q": q, "y": 2.0 * q + amplitude * np.sin(2.0 * np.pi * 7.3 * t + phase) + noise})
    return recordings


@pytest.mark.parametrize(("amplitude", "stated"), [(0.06, True), (0.0, False)])
def test_a_hum_of_another_phase_in_each_recording_is_stated(amplitude: float, stated: bool) -> None:
    verdict = sd.diagnose(hummed((0.3, 2.9), amplitude), transmission("V", value=2.0)).as_dict()
    assert not verdict["effects"]
    lines = [f["says"] for f in verdict["data_findings"] if f["id"] == "line"]
    assert bool(lines) is stated
    if stated:
        assert "7.3 Hz" in lines[0] and verdict["next"] == lines[0]


def test_a_broad_peak_and_a_tone_of_the_input_are_no_lines() -> None:
    """Noise behind a damped mode has a peak of many bins; a harmonic error of a tone has the frequency of an input."""
    rng = stream(60)
    t = np.arange(0.0, 20.0, 0.01)
    still = [np.zeros(t.size)] * 2
    broad = [lfilter([1.0], [1.0, -1.8, 0.95], rng.standard_normal(t.size)) for _ in range(2)]
    assert common_line(broad, [[], []], still, [0.01, 0.01]) is None
    tone = [np.sin(2.0 * np.pi * 3.0 * t + phase) + 0.1 * rng.standard_normal(t.size) for phase in (0.0, 1.0)]
    assert common_line(tone, [[np.sin(2.0 * np.pi * 3.0 * t)]] * 2, still, [0.01, 0.01]) is None
    line = common_line(tone, [[], []], still, [0.01, 0.01])
    assert (
        line is not None
        and line.frequency_Hz == pytest.approx(3.0, abs=1e-2)
        and line.amplitude == pytest.approx(1.0, rel=0.02)
    )


def test_a_line_is_not_from_an_input_that_hardly_has_it_nor_from_one_that_answers_otherwise() -> None:
    """A trace of the frequency in a recorded force, or in its square, hid a disturbance of a third of the motion."""
    rng = stream(61)
    t = np.arange(0.0, 20.0, 0.01)
    still = [np.zeros(t.size)] * 2
    tone = [np.sin(2.0 * np.pi * 3.0 * t + phase) + 0.1 * rng.standard_normal(t.size) for phase in (0.0, 1.0)]
    slow = 5.0 * np.sin(2.0 * np.pi * 0.3 * t)
    assert common_line(tone, [[slow + 0.002 * np.sin(2.0 * np.pi * 3.0 * t)]] * 2, still, [0.01, 0.01]) is not None
    half = np.sin(2.0 * np.pi * 1.5 * t)
    assert common_line(tone, [[half]] * 2, still, [0.01, 0.01]) is not None  # its square has one phase, the line has two
    in_phase = [-np.cos(2.0 * np.pi * 3.0 * t) + 0.1 * rng.standard_normal(t.size) for _ in range(2)]
    assert common_line(in_phase, [[half]] * 2, still, [0.01, 0.01]) is None


@pytest.mark.parametrize("swapped", [True, False])
@pytest.mark.parametrize("damping", [15.0, 6.0])
def test_exchanged_columns_are_found_by_stated_values_where_stamps_are_uneven(swapped: bool, damping: float) -> None:
    """Interpolated noise leaves 3e-4 and 9e-4 of the two orders: no ratio of ten, but a spring of 529 or of 0.002 N/m.

    With less damping they leave 8e-5 and 4e-5, less than what noise in a closed loop does.
    """
    recordings = []
    for number in range(3):
        rng = stream(70 + number)
        t = np.sort(rng.uniform(0.0, 15.0, 1500))
        hertz, phase = np.array([0.3, 1.1]), rng.uniform(0.0, 6.28, 2)
        angle = 2.0 * np.pi * np.outer(t, hertz) + phase
        place, speed = np.sin(angle) @ [0.02, 0.01], np.cos(angle) @ (2.0 * np.pi * hertz * [0.02, 0.01])
        force = 530.0 * place + damping * speed + 0.05 * rng.standard_normal(t.size)
        recordings.append({"t": t, "x": force if swapped else place, "f": place if swapped else force})
    nominal = {
        "name": "mount",
        "kind": "impedance",
        "data": {"time": "t"},
        "channels": {"motion": {"column": "x", "unit": "m"}, "force": {"column": "f", "unit": "N"}},
        "impedance": {"subsystem": "mount", "input": "motion", "output": "force", "terms": ["stiffness", "damping"]},
        "parameters": {"stiffness": 630.0},
    }
    findings = inspected(nominal_of(nominal), [Table(f"r{k}", r) for k, r in enumerate(recordings)]).findings
    said = [f.says for f in findings if f.id == "swapped"]
    assert len(said) == swapped and all("stated values" in says for says in said)


def test_a_residual_that_rings_where_the_model_does_is_no_line() -> None:
    """A pendulum whose start is a little off rings at its own frequency; that was stated as a hum of 0.7 Hz."""
    rng = stream(80)
    t = np.arange(0.0, 20.0, 0.02)
    own = [np.sin(2.0 * np.pi * 0.7 * t + phase) for phase in (0.2, 1.9)]
    residuals = [0.05 * each + 0.02 * rng.standard_normal(t.size) for each in own]
    assert common_line(residuals, [[], []], own, [0.02, 0.02]) is None
    assert common_line(residuals, [[], []], [0.01 * each for each in own], [0.02, 0.02]) is not None


def test_a_closed_loop_is_simulated_without_a_warning(recwarn: pytest.WarningsRecorder) -> None:
    """numba warned of a slow product on the terminal of everybody who diagnosed a loop."""
    plant = (np.array([[0.0, 1.0], [0.0, -8.0]]), np.array([[0.0], [1.0]]))
    A, B, _ = sampled(*plant, 0.01, "zero")
    assert A.flags.c_contiguous and B.flags.c_contiguous
    controller = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[120.0]]))
    loop = StateSpace(A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    y, _ = closed_loop(loop, controller, 0, np.ones(600), np.zeros((2, 600)), np.zeros(2), np.zeros(0))
    assert y[0, -1] == pytest.approx(1.0, abs=1e-3)
    assert not [w for w in recwarn if "contiguous" in str(w.message)]


def test_torque_steps_at_uneven_stamps_are_no_missing_physics() -> None:
    """A line between two stamps begins a step before it does: its error in speed was named creep, in another draw drift."""
    rng = np.random.default_rng(4)
    inertia, damping, drag, rate, size = 0.0767, 0.0506, 0.39, 150.0, 6.0
    recordings = []
    for _ in range(3):
        t = np.concatenate(([0.0], np.cumsum(1.0 + rng.uniform(-0.5, 0.5, 2999)))) / rate
        changes, levels = np.cumsum(rng.uniform(0.5, 2.5, 60)), rng.uniform(-1.0, 1.0, 61)
        torque = size * (0.3 + levels[np.searchsorted(changes, t)])
        speed, now = np.zeros(t.size), 0.0
        for k in range(1, t.size):
            left = np.exp(-damping / inertia * (t[k] - t[k - 1]))
            now = now * left + (torque[k - 1] - drag) / damping * (1.0 - left)
            speed[k] = now
        recordings.append({"t": t, "u": torque, "v": speed + 0.1 * rng.standard_normal(t.size)})
    nominal = {
        "name": "rotor",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"torque": {"column": "u", "unit": "N m"}, "speed": {"column": "v", "unit": "rad/s"}},
        "axis": {
            "subsystem": "rotor",
            "input": "torque",
            "output": "speed",
            "terms": ["mass", "damping", "offset"],
            "reads": "velocity",
            "hold": "zero",
        },
        "parameters": {"mass": 0.08, "damping": 0.045},
    }
    verdict = sd.diagnose(recordings, nominal).as_dict()
    assert verdict["verdict"] == "nothing_missing"
    assert verdict["fit"]["rmse_before"] < 0.09  # 0.0996 where a line joins two stamps
    assert verdict["fit"]["noise_floor"] < 0.1  # 1.5 by the parts in which the torque rests and the speed does not
