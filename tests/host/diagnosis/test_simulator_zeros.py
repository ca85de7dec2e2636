"""Zeros and gains of what goes into a simulator that is not linear, and of what is read: two tanks, an arm."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numba import njit

import seldinger as sd

Array = npt.NDArray[np.float64]
STEPS = 20  # of a sample


@njit(cache=True)
def levels(inflow: Array, upper: float, lower: float, k_upper: float, k_lower: float) -> Array:
    """Levels (2, n) of two tanks of 2 m2, one draining into the other through holes, inflow held for 1 s."""
    out = np.empty((2, inflow.size))
    for i in range(inflow.size):
        out[0, i], out[1, i] = upper, lower
        for _ in range(STEPS):
            between, away = k_upper * np.sqrt(upper), k_lower * np.sqrt(lower)
            upper = max(upper + (inflow[i] - between) / 2.0 / STEPS, 0.0)
            lower = max(lower + (between - away) / 2.0 / STEPS, 0.0)
    return out


def tanks(inputs: dict[str, Array], p: dict[str, float], time_s: Array, initial: dict[str, float]) -> dict[str, Array]:
    """The tanks as a callable."""
    both = levels(inputs["pump"], initial["upper"], initial["lower"], p["k_upper"], p["k_lower"])
    return {"upper": both[0], "lower": both[1]}


TANKS: dict[str, Any] = {
    "name": "tanks",
    "kind": "callable",
    "data": {"time": "t"},
    "channels": {
        "pump": {"column": "pump", "unit": "m3/s"},
        "upper": {"column": "upper", "unit": "m"},
        "lower": {"column": "lower", "unit": "m"},
    },
    "callable": {
        "function": tanks,
        "inputs": ["pump"],
        "outputs": ["upper", "lower"],
        "ports": {"pump": "pump", "upper": "upper gauge", "lower": "lower gauge"},
        "subsystem": "tanks",
    },
    "parameters": {
        "k_upper": {"value": 1.1, "low": 0.1, "high": 5.0},
        "k_lower": {"value": 0.9, "low": 0.1, "high": 5.0},
    },
}


def of_tanks(seed: int, inflow: float = 0.0, zero: float = 0.0, gain: float = 1.0) -> dict[str, Array]:
    """A recording in which the pump gives `inflow` more than is stated, and the lower gauge reads gain*level + zero."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(1.0, 4.0, 15), 20)
    upper, lower = levels(pump + inflow, *rng.uniform(3.0, 8.0, 2), 1.0, 1.0)
    noise = 0.02 * rng.standard_normal((2, pump.size))
    return {
        "t": np.arange(pump.size) * 1.0,
        "pump": pump,
        "upper": upper + noise[0],
        "lower": gain * lower + zero + noise[1],
    }


@pytest.mark.parametrize(
    ("planted", "port", "effect_id", "parameter"),
    [
        ({"inflow": 0.4}, "pump", "sensor_bias", "offset_m3_per_s"),
        ({"zero": 0.8}, "lower_reading", "sensor_bias", "offset_m"),
        ({"gain": 1.15}, "lower_reading", "sensor_scale", "gain_error"),
    ],
)
def test_a_zero_or_gain_is_named_at_its_place(planted: dict[str, float], port: str, effect_id: str, parameter: str) -> None:
    """An inflow that is not recorded was an offset and a drift of the gauges (0.92), a zero a drift, a gain a curve."""
    (effect,) = sd.diagnose([of_tanks(k, **planted) for k in range(3)], TANKS).effects
    assert (effect["id"], effect["port"]) == (effect_id, port)
    (true,) = planted.values()
    assert effect["parameters"][parameter]["value"] == pytest.approx(true - (effect_id == "sensor_scale"), rel=0.02)


def test_nothing_is_missing_in_tanks() -> None:
    assert sd.diagnose([of_tanks(k) for k in range(3)], TANKS).verdict == "nothing_missing"


def weights(inputs: dict[str, Array], p: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Torques of gravity on an arm of two links."""
    upper, fore = np.cos(inputs["shoulder"]), 0.8 * np.cos(inputs["shoulder"] + inputs["elbow"])
    return {"at_shoulder": p["upper"] * upper + p["fore"] * (upper + fore), "at_elbow": p["fore"] * fore}


def test_the_zero_of_an_encoder_of_an_arm_is_named() -> None:
    """It was named a dead zone about an angle beyond the motion (0.92)."""
    units = {"shoulder": "rad", "elbow": "rad", "at_shoulder": "N m", "at_elbow": "N m"}
    nominal = {
        "name": "arm",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {name: {"column": name, "unit": unit} for name, unit in units.items()},
        "callable": {
            "function": weights,
            "inputs": ["shoulder", "elbow"],
            "outputs": ["at_shoulder", "at_elbow"],
            "subsystem": "arm",
        },
        "parameters": {"upper": {"value": 6.0, "low": 0.0, "high": 30.0}, "fore": {"value": 2.5, "low": 0.0, "high": 30.0}},
    }
    recordings = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 30.0, 0.05)
        tones = np.sin(np.outer((0.11, 0.23, 0.41), 2 * np.pi * t) + rng.uniform(0, 2 * np.pi, (2, 3, 1)))
        shoulder, elbow = np.array([[0.6, 0.4, 0.2]]) @ tones[0], np.array([[0.3, 0.5, 0.3]]) @ tones[1]
        angles = {"shoulder": shoulder[0], "elbow": elbow[0]}
        true = weights({**angles, "elbow": angles["elbow"] + 0.08}, {"upper": 5.5, "fore": 3.0}, t)
        read = {name: torque + 0.03 * rng.standard_normal(t.size) for name, torque in true.items()}
        recordings.append({"t": t, **angles, **read})
    (effect,) = sd.diagnose(recordings, nominal).effects
    assert (effect["id"], effect["port"]) == ("sensor_bias", "elbow")
    assert effect["parameters"]["offset_rad"]["value"] == pytest.approx(0.08, abs=0.004)
