"""A reading with a constant offset: no drift, no curve of the input, and a drift is still one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import seldinger as sd

Array = np.ndarray
PERIOD_S, GAIN, TAU_S, NOISE_M = 2.0, 1.5, 60.0, 0.004
TANK: dict[str, Any] = {
    "name": "tank",
    "kind": "linear",
    "data": {"time": "t"},
    "channels": {"q": {"column": "q", "unit": "l/s"}, "h": {"column": "h", "unit": "m"}},
    "linear": {
        "inputs": ["q"],
        "outputs": ["h"],
        "numerator": ["k"],
        "denominator": ["tau", 1.0],
        "hold": "zero",
        "subsystem": "tank",
    },
    "parameters": {"k": 2.0, "tau": 40.0},
}
SPRING: dict[str, Any] = {
    "name": "spring",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"x": {"column": "x", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "spring", "input": "x", "output": "f", "terms": ["stiffness", "damping"]},
}


def tank(seed: int, offset_m: float, drift_m_per_s: float = 0.0) -> dict[str, Array]:
    """Level of a tank whose inflow is set once in two minutes: the exact answer to steps, cut from motion."""
    rng, n, lead = np.random.default_rng([23, seed]), 500, 120
    flow = np.repeat(rng.uniform(0.0, 1.0, 12), 60)[: n + lead]
    level, h = GAIN * flow[0], np.empty(n + lead)
    for i in range(n + lead):
        h[i] = level
        level = GAIN * flow[i] + (level - GAIN * flow[i]) * np.exp(-PERIOD_S / TAU_S)
    t = np.arange(n) * PERIOD_S
    return {"t": t, "q": flow[lead:], "h": h[lead:] + offset_m + drift_m_per_s * t + NOISE_M * rng.standard_normal(n)}


def spring(seed: int, offset_N: float) -> dict[str, Array]:
    rng, t = np.random.default_rng([29, seed]), np.arange(0.0, 15.0, 0.01)
    w, phase = 2.0 * np.pi * np.array([0.17, 0.43, 1.1]), rng.uniform(0.0, 6.28, 3)
    x = 0.01 * np.sin(np.outer(t, w) + phase).sum(axis=1)
    v = 0.01 * (np.cos(np.outer(t, w) + phase) * w).sum(axis=1)
    return {"t": t, "x": x, "f": 200.0 * x + 4.0 * v + offset_N + 0.02 * rng.standard_normal(t.size)}


@pytest.mark.parametrize(
    ("offset_m", "drift_m_per_s", "named"),
    [
        pytest.param(0.12, 0.0, {"sensor_bias"}, marks=pytest.mark.long),
        pytest.param(0.0, 2e-4, {"sensor_drift"}, marks=pytest.mark.slow),
        pytest.param(0.12, 2e-4, {"sensor_bias", "sensor_drift"}, marks=pytest.mark.long),
        pytest.param(-0.3, 3e-4, {"sensor_bias", "sensor_drift"}, marks=pytest.mark.long),
    ],
)
def test_an_offset_of_a_level_is_a_bias_and_a_ramp_is_a_drift(
    offset_m: float, drift_m_per_s: float, named: set[str]
) -> None:
    effects = sd.diagnose([tank(k, offset_m, drift_m_per_s) for k in (1, 2, 3)], TANK).effects
    assert {effect["id"] for effect in effects} == named
    for effect in effects:
        if effect["id"] == "sensor_bias":
            assert effect["parameters"]["offset_m"]["value"] == pytest.approx(offset_m, rel=0.05)


@pytest.mark.long
def test_a_force_that_no_term_of_the_model_offsets_is_a_bias() -> None:
    (found,) = sd.diagnose([spring(k, 0.3) for k in (1, 2)], SPRING).effects
    assert found["id"] == "sensor_bias" and found["parameters"]["offset_N"]["value"] == pytest.approx(0.3, rel=0.03)
