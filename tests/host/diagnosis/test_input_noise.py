"""Noise of a measured input, which the nominal law passes on to its output: to a force, through a gear, a simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import savgol_filter

import seldinger as sd
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.operators import smooth_derivatives
from host.diagnosis.model.tables import Table
from host.diagnosis.models.moved import DEGREE, Moved
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal

Array = npt.NDArray[np.float64]
DT_S = 0.005
SPRING: dict[str, Any] = {
    "name": "spring",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"motion": {"column": "x", "unit": "m"}, "force": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "spring", "input": "motion", "output": "force", "terms": ["mass", "damping", "stiffness"]},
    "parameters": {"mass": 2.6, "damping": 10.0, "stiffness": 600.0},
}


def shaken(seed: int, late_s: float = 0.0) -> dict[str, Array]:
    """2 kg, 15 N s/m and 800 N/m for 15 s; 10 um noise of the motion, 0.05 N of the force, which may be read late."""
    rng, t = np.random.default_rng(seed), DT_S * np.arange(3000)
    turn, phase = 2.0 * np.pi * rng.uniform(0.1, 2.5, 6), rng.uniform(0.0, 6.3, 6)
    wave = 3e-3 * np.exp(1j * (np.outer(t, turn) + phase))
    x = wave.imag.sum(axis=1)
    late = np.exp(-1j * turn * late_s)
    f = (wave * late * (800.0 + 15.0j * turn - 2.0 * turn**2)).imag.sum(axis=1)
    return {"t": t, "x": x + 1e-5 * rng.standard_normal(t.size), "f": f + 0.05 * rng.standard_normal(t.size)}


@pytest.mark.parametrize("first", [0, 10, 20])
def test_noise_that_the_law_passes_on_is_not_an_effect(first: int) -> None:
    """A resonance of nearly all of the mass takes this noise away; it was named with 0.92."""
    content = sd.diagnose([shaken(first), shaken(first + 1)], SPRING).as_dict()
    assert content["verdict"] == "nothing_missing" and content["effects"] == []
    assert content["fit"]["nominal_parameters"]["mass_N_s2_per_m"]["value"] == pytest.approx(2.0, rel=0.02)


def test_a_force_that_is_read_late_is_found_all_the_same() -> None:
    content = sd.diagnose([shaken(30, 0.02), shaken(31, 0.02)], SPRING).as_dict()
    assert content["effects"][0]["id"] == "latency"
    assert content["effects"][0]["parameters"]["delay_s"]["value"] == pytest.approx(0.02, abs=0.001)


def test_the_noise_of_the_force_is_that_of_the_smoothed_motion() -> None:
    noise, law = np.random.default_rng(5).standard_normal(20000), (3.0, 0.2, 0.004)
    moved = Moved(noise, noise, noise, 0.0, 1.0, (11, 21, 31))
    x, v, a = (smooth_derivatives(noise, DT_S, window, DEGREE)[k] for k, window in enumerate(moved.windows))
    measured = float(np.std(law[0] * x + law[1] * v + law[2] * a))
    assert moved.noise_of_force(law, DT_S) == pytest.approx(measured, rel=0.03)


GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"turn": {"column": "u", "unit": "rad"}, "out": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "turn", "output": "out"}],
    "parameters": {"gain": 1.0},
}


def turned(seed: int, read_noise: float, felt_noise: float = 0.0, late_s: float = 0.0) -> dict[str, Array]:
    """A gear of 0.93 for 12 s. The encoder of the input adds noise that the gear never feels, or the motor adds some that
    it does; the output may be read late."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(1200)
    turn, phase = 2.0 * np.pi * rng.uniform(0.1, 0.8, 4), rng.uniform(0.0, 6.3, 4)
    felt = felt_noise * rng.standard_normal(t.size)
    u = 0.4 * np.sin(np.outer(t, turn) + phase).sum(axis=1) + felt
    late = 0.4 * np.sin(np.outer(t - late_s, turn) + phase).sum(axis=1) + felt
    y = 0.93 * late + 0.05 + 0.004 * rng.standard_normal(t.size)
    return {"t": t, "u": u + read_noise * rng.standard_normal(t.size), "y": y}


@pytest.mark.parametrize("seed", [40, 50, 60])
def test_noise_of_an_encoder_before_a_gear_is_not_a_mismatch(seed: int) -> None:
    """The residual is 3.9 times the noise of the output, all of it from the input; it was a mismatch of no known kind."""
    content = sd.diagnose([turned(seed, 0.016), turned(seed + 1, 0.016)], GEAR).as_dict()
    assert content["verdict"] == "nothing_missing" and content["effects"] == []
    assert "noise_passed_on" in [finding["id"] for finding in content["data_findings"]]


def test_noise_that_the_gear_felt_makes_nothing_of_the_residual() -> None:
    felt, read = (
        [Table(str(seed), turned(seed, own, at_motor)) for seed in (70, 71)]
        for own, at_motor in ((0.0, 0.016), (0.016, 0.0))
    )
    assert max(passed_on(felt)) < 0.002
    assert passed_on(read) == pytest.approx([0.93 * 0.016] * 2, rel=0.15)


def passed_on(tables: list[Table]) -> list[float]:
    """Noise of the output that the gear's input makes, of each recording."""
    problem = prepare(nominal_of(GEAR), tables)[1]
    fit = fit_nominal(problem)
    return [float(problem.model.noise_of_inputs(segment, fit.values)[0]) for segment in problem.segments]


def test_a_delay_behind_a_noisy_encoder_is_found() -> None:
    content = sd.diagnose([turned(80, 0.004, late_s=0.03), turned(81, 0.004, late_s=0.03)], GEAR).as_dict()
    assert content["effects"][0]["id"] in ("latency", "rate_lag")


def swung(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Torque of an arm; the user's simulator differentiates the measured angle."""
    q = inputs["angle"]
    v, a = (savgol_filter(q, 11, 4, deriv=order, delta=DT_S) for order in (1, 2))
    return {"torque": p["inertia"] * a + p["damping"] * v + p["weight"] * np.cos(q)}


ARM: dict[str, Any] = {
    "name": "arm",
    "kind": "callable",
    "data": {"time": "t"},
    "channels": {"angle": {"column": "q", "unit": "rad"}, "torque": {"column": "tau", "unit": "N m"}},
    "callable": {"function": swung, "inputs": ["angle"], "outputs": ["torque"], "subsystem": "arm"},
    "parameters": {
        "inertia": {"value": 0.1, "low": 0.01, "high": 5.0},
        "damping": {"value": 0.1, "low": 0.0, "high": 5.0},
        "weight": {"value": 2.0, "low": 0.1, "high": 50.0},
    },
}


@pytest.mark.parametrize("seed", [5, 7])
def test_noise_that_a_simulator_differentiates_is_not_an_effect(seed: int) -> None:
    """The acceleration makes 0.04 N m of 20 urad; a lag of 2 ms was named with 0.88, and a drifting clock with 0.93."""
    recordings = []
    for number in (seed, seed + 1):
        rng, t = np.random.default_rng(number), DT_S * np.arange(1200)
        turn, phase = 2.0 * np.pi * np.array([0.3, 0.8, 1.3]), rng.uniform(0.0, 6.3, 3)
        wave = np.array([0.5, 0.3, 0.15]) * np.exp(1j * (np.outer(t, turn) + phase))
        q, v, a = (wave * (1j * turn) ** order for order in range(3))
        q, v, a = q.imag.sum(axis=1), v.imag.sum(axis=1), a.imag.sum(axis=1)
        tau = 0.3 * a + 0.15 * v + 3.0 * np.cos(q) + 0.04 * rng.standard_normal(t.size)
        recordings.append({"t": t, "q": q + 2e-5 * rng.standard_normal(t.size), "tau": tau})
    content = sd.diagnose(recordings, ARM).as_dict()
    assert content["verdict"] == "nothing_missing" and content["effects"] == []


def test_a_free_decay_determines_ratios_only() -> None:
    """A mass of 19 kg instead of 1.2 kg was stated, with an interval that took the noise of the force for an exact input."""
    rng, t = np.random.default_rng(303), 0.01 * np.arange(2000)
    roots = np.roots([1.2, 3.0, 150.0])
    weights = np.linalg.solve(np.array([[1.0, 1.0], roots]), [0.08, 0.0])
    x = np.real(np.exp(np.outer(t, roots)) @ weights)
    axis = {
        "subsystem": "stage",
        "input": "f",
        "output": "x",
        "terms": ["mass", "damping", "stiffness"],
        "reads": "position",
    }
    nominal = {
        "name": "stage",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"f": {"column": "f", "unit": "N"}, "x": {"column": "x", "unit": "m"}},
        "axis": axis,
        "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
    }
    table = {"t": t, "f": 0.01 * rng.standard_normal(t.size), "x": x + 1e-4 * rng.standard_normal(t.size)}
    content = sd.diagnose([table], nominal).as_dict()
    assert [f["channel"] for f in content["data_findings"] if f["id"] == "excitation"] == ["f"]
    assert content["next"].startswith("Column f moves the output by less than noise")
