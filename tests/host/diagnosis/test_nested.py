"""Nested pairs: the simpler effect is named where it suffices, the general one only where it is needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.pipeline import diagnose
from host.diagnosis.report.verdict import as_json
from tests.host.diagnosis import planted
from tests.host.diagnosis.test_examined import LINK, sway


def backlash(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    y = x.copy()
    for i in range(1, x.size):
        y[i] = min(max(y[i - 1], x[i] - 0.02), x[i] + 0.02)
    return y


def presliding(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    z = np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        z[i] = z[i - 1] + dx / 0.05 * (1.0 - np.sign(dx) * z[i - 1]) * abs(1.0 - np.sign(dx) * z[i - 1]) ** 0.3
    return x - 0.02 * z


def dead_zone(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.sign(x) * np.maximum(np.abs(x) - 0.03, 0.0)


def latency(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.interp(t - 0.15, t, x)


def rate_lag(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    y = x.copy()
    fine = 20
    for i in range(1, x.size):
        y[i] = y[i - 1]
        for j in range(fine):
            y[i] += (t[1] - t[0]) / fine / 0.15 * (x[i - 1] + (x[i] - x[i - 1]) * (j + 0.5) / fine - y[i])
    return y


def resonance(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    h, w, y, v, out = (t[1] - t[0]) / 40, 2 * np.pi * 1.5, x[0], 0.0, x.copy()
    for i in range(1, x.size):
        for j in range(40):
            v += h * (w * w * (x[i - 1] + (x[i] - x[i - 1]) * (j + 0.5) / 40 - y) - 2 * 0.15 * w * v)
            y += h * v
        out[i] = y
    return out


@pytest.mark.parametrize("effect", [backlash, presliding, dead_zone, latency, rate_lag, resonance])
def test_each_of_a_pair_is_told_from_the_other(tmp_path: Path, effect) -> None:  # type: ignore[no-untyped-def]
    nominal, files = planted.transmission(tmp_path, "none", 1)
    for k, path in enumerate(files):
        t, motor, load, _ = np.loadtxt(path, delimiter=",", skiprows=1).T
        tip = 0.9 * effect(motor, t) + planted.coloured(np.random.default_rng(10 + k), t.size, 1e-3)
        np.savetxt(path, np.column_stack((t, motor, load, tip)), delimiter=",", header="t,motor,load,tip", comments="")
    found = as_json(diagnose(read_nominal(nominal), files, lambda what, part: None), 0.0)["effects"]
    assert [e["id"] for e in found] == [effect.__name__ + ("_friction" if effect is presliding else "")]


@pytest.mark.parametrize("seed", [0, 2])
def test_a_gap_far_smaller_than_the_travel_is_backlash(seed: int) -> None:
    """0.06 % of the travel, in noise of 0.7 of the gap: named dry or presliding friction where no width began so small."""
    recordings = []
    for k in range(3):
        rng, t = np.random.default_rng([7, seed, k]), np.arange(0.0, 30.0, 0.01)
        x = sway(10 * seed + k, t, 0.5, 0.25)
        width = 6e-4 * float(np.ptp(x))
        y = x.copy()
        for i in range(1, x.size):
            y[i] = min(max(y[i - 1], x[i] - width / 2), x[i] + width / 2)
        recordings.append({"t": t, "x": x, "y": y + 0.7 * width * rng.standard_normal(t.size)})
    (effect,) = sd.diagnose(recordings, LINK).effects
    assert effect["id"] == "backlash"
    assert effect["parameters"]["width_m"]["value"] == pytest.approx(width, rel=0.05)


@pytest.mark.parametrize("step", [3e-4, 1e-3])
def test_an_input_that_is_read_in_steps_lacks_no_physics(step: float) -> None:
    """Steps of this share of the travel, which make three times the noise of the output."""
    recordings = []
    for k in range(3):
        rng, t = np.random.default_rng([7, 1, k]), np.arange(0.0, 30.0, 0.01)
        x = sway(10 + k, t, 0.5, 0.25)
        size = step * float(np.ptp(x))
        recordings.append({"t": t, "x": np.round(x / size) * size, "y": x + 0.1 * size * rng.standard_normal(t.size)})
    assert sd.diagnose(recordings, LINK).verdict == "nothing_missing"
