"""Noise of a measured motion, which mass and damping of the nominal law pass on to the force."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import seldinger as sd
from host.diagnosis.model.operators import smooth_derivatives
from host.diagnosis.models.moved import DEGREE, Moved

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
