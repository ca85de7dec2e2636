"""An output that precedes its input is a matter of clocks: it is stated and shifted back before any physics is named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import seldinger as sd
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.nominal import nominal_of
from host.diagnosis.model.tables import Table
from host.diagnosis.pipeline import clocks_put_right
from host.diagnosis.problems import inspected

Array = np.ndarray
Columns = dict[str, Array]
DT_S, TAU_S = 0.05, 0.8
MASS, DAMPING, STIFFNESS = 1.2, 3.0, 150.0
CHANNELS = {"u": {"column": "u", "unit": "V"}, "y": {"column": "y", "unit": "V"}}
FILTER: dict[str, Any] = {
    "name": "filter",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": CHANNELS,
    "linear": {"inputs": ["u"], "outputs": ["y"], "numerator": [1.0], "denominator": ["tau", 1.0], "hold": "zero"},
    "parameters": {"tau": 1.0},
}


def follow(u: Array, tau_s: float, late: int = 0) -> Array:
    """A first-order low pass of a held input, `late` samples later, exact."""
    keep = float(np.exp(-DT_S / tau_s))
    before = np.concatenate((np.zeros(late + 1), u[: u.size - late - 1]))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], before))


def as_function(late: int) -> dict[str, Any]:
    """The low pass as a function with a delay of its own that no parameter changes."""

    def run(inputs: Columns, parameters: dict[str, float], time_s: Array) -> Columns:
        return {"y": follow(inputs["u"], parameters["tau"], late)}

    return {
        **{key: FILTER[key] for key in ("name", "data", "channels")},
        "kind": "callable",
        "callable": {"function": run, "inputs": ["u"], "outputs": ["y"]},
        "parameters": {"tau": {"value": 1.0, "low": 0.05, "high": 5.0}},
    }


def filtered(seed: int, lead: int, late: int = 0, period: int = 0, noise: float = 0.02) -> Columns:
    """A low pass under random steps (of one period if `period` is given, samples), read `lead` samples early."""
    rng, n = np.random.default_rng([66, seed]), 800
    u = np.repeat(rng.uniform(-5.0, 5.0, n // 10), 10)
    u = np.tile(u[:period], n // period + 1)[:n] if period else u
    y = follow(u, TAU_S, late)[lead:] + noise * rng.standard_normal(n - lead)
    return {"t": DT_S * np.arange(n - lead), "u": u[: n - lead], "y": y}


def moved(seed: int, lead_s: float, reads: str) -> Columns:
    """A mass on a spring under tones in steady motion, read `lead_s` early, by its frequency response."""
    rng, t = np.random.default_rng([67, seed]), np.arange(0.0, 20.0, 0.01)
    w, size, phase = 2.0 * np.pi * np.array([0.3, 0.9, 1.6, 2.6]), np.array([3.0, 2.0, 3.0, 2.0]), rng.uniform(0.0, 6.28, 4)
    answer = 1.0 / (STIFFNESS - MASS * w**2 + 1j * DAMPING * w) * (1j * w) ** ("position", "velocity").index(reads)
    y = (size * answer * np.exp(1j * (np.outer(t + lead_s, w) + phase))).sum(axis=1).imag
    f = (size * np.sin(np.outer(t, w) + phase)).sum(axis=1)
    return {"t": t, "f": f, "y": y + 0.005 * np.std(y) * rng.standard_normal(t.size)}


def slide(reads: str) -> dict[str, Any]:
    return {
        "name": "slide",
        "kind": "axis",
        "data": {"time": "t"},
        "channels": {"f": {"column": "f", "unit": "N"}, "y": {"column": "y", "unit": "m" if reads == "position" else "m/s"}},
        "axis": {
            "subsystem": "slide",
            "input": "f",
            "output": "y",
            "terms": ["mass", "damping", "stiffness"],
            "reads": reads,
        },
        "parameters": {"mass": 1.1, "damping": 3.5, "stiffness": 140.0},
    }


def leads_of(nominal: dict[str, Any], *recordings: Columns) -> list[str]:
    """Sentences about clocks, and nothing searched."""
    spec = nominal_of(nominal)
    tables = [Table(f"r{k}", columns) for k, columns in enumerate(recordings)]
    data = clocks_put_right(spec, inspected(spec, tables), frozenset(), RULES)
    return [finding.says for finding in data.findings if finding.id == "clock"]


@pytest.mark.parametrize(
    ("nominal", "recording", "lead", "truth"),
    [
        (FILTER, filtered(1, lead=4), "0.2 s", {"tau": TAU_S}),
        (as_function(0), filtered(2, lead=3), "0.15 s", {"tau": TAU_S}),
        (slide("position"), moved(1, 0.025, "position"), "0.025 s", {"mass": MASS, "damping": DAMPING}),
        (slide("velocity"), moved(2, 0.06, "velocity"), "0.06 s", {"mass": MASS, "damping": DAMPING}),
    ],
)
def test_an_early_output_is_stated_and_no_physics(
    nominal: dict[str, Any], recording: Columns, lead: str, truth: dict[str, float]
) -> None:
    content = sd.diagnose([recording], nominal).as_dict()
    says = [finding["says"] for finding in content["data_findings"] if finding["id"] == "clock"]
    assert content["verdict"] == "nothing_missing" and len(says) == 1 and f"comes {lead} before" in says[0]
    fitted = {key.partition("_")[0]: value["value"] for key, value in content["fit"]["nominal_parameters"].items()}
    assert {key: fitted[key] for key in truth} == pytest.approx(truth, rel=0.02)


@pytest.mark.parametrize(
    ("nominal", "recording"),
    [
        (FILTER, filtered(3, lead=0)),
        (FILTER, filtered(4, lead=0, late=4)),
        (FILTER, filtered(5, lead=4, period=60)),  # early by 0.2 s, or late by 2.8 s
        (as_function(6), filtered(6, lead=0)),  # the model's own delay is too long
        (slide("position"), moved(3, -0.05, "position")),
    ],
)
def test_no_lead_where_none_is_sure(nominal: dict[str, Any], recording: Columns) -> None:
    assert leads_of(nominal, recording) == []


@pytest.mark.parametrize(("noise", "friction"), [(0.001, 0.0), (0.05, 0.0), (0.3, 0.0), (0.02, 0.4)])
def test_a_controller_that_feeds_noise_back_is_no_lead(noise: float, friction: float) -> None:
    """The noise of a reading is in the next inputs, so the output comes before a part of its input."""
    rng, n, keep = np.random.default_rng(9), 1200, float(np.exp(-DT_S / TAU_S))
    wanted, y, u, x = np.repeat(rng.uniform(-2.0, 2.0, n // 40), 40), np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        y[k] = x + noise * rng.standard_normal()
        u[k] = 4.0 * (wanted[k] - y[k])
        x = keep * x + (1.0 - keep) * (u[k] - friction * np.tanh(5.0 * x))
    assert leads_of(FILTER, {"t": DT_S * np.arange(n), "u": u, "y": y}) == []
