"""A lost step, or a reading that jumps, is put at its instant, also where that lies in samples that are held out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import seldinger as sd
from tests.host.diagnosis import rig_cases
from tests.host.proof.everyday import axis_nominal, spring_nominal

GEAR: dict[str, Any] = {
    "name": "gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"u": {"column": "u", "unit": "rad"}, "y": {"column": "y", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "u", "output": "y"}],
    "parameters": {"gain": 0.22},
}


@pytest.mark.parametrize("lost", [{5.0: 0.02}, {7.3: 0.02}, {11.7: 0.02}, {7.3: 0.02, 13.1: 0.03}])
def test_a_lost_step_has_its_instant_within_a_sample(lost: dict[float, float]) -> None:
    """Blocks of a lone recording are held out by turns: 6 to 8 s, 10 to 12 s, ..."""
    rng, t = np.random.default_rng(913), np.arange(0.0, 20.0, 0.01)
    u = sum(a * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.28)) for f, a in ((0.25, 1.0), (0.7, 0.6)))
    y = 0.25 * u - sum(size * (t >= instant - 1e-9) for instant, size in lost.items())
    (found,) = sd.diagnose([{"t": t, "u": u, "y": y + 5e-4 * rng.standard_normal(t.size)}], GEAR).as_dict()["effects"]
    assert found["id"] == "missed_steps" and found["probability"] > (0.7 if len(lost) == 1 else 0.9)
    assert found["indistinguishable_from"] == (["sensor_bias@gear"] if len(lost) == 1 else [])  # an encoder may have slipped
    instants = {key: value for key, value in found["parameters"].items() if key.startswith("instant")}
    assert [value["value"] for value in instants.values()] == pytest.approx(list(lost), abs=0.01)
    assert all(0.0099 <= value["ci95"][1] - value["ci95"][0] <= 0.03 for value in instants.values())
    sizes = [value["value"] for key, value in found["parameters"].items() if key.startswith("jump")]
    assert sizes == pytest.approx([-4.0 * size for size in lost.values()], rel=0.02)


@pytest.mark.parametrize(
    "nominal, reading, jump, unit",
    [(axis_nominal(), "x", 1e-3, "m"), (spring_nominal(), "f", 0.05, "N"), (spring_nominal(), "f", -0.05, "N")],
)
def test_a_reading_that_jumps_is_a_bias_from_one_instant_on(
    nominal: dict[str, Any], reading: str, jump: float, unit: str
) -> None:
    rng, t = np.random.default_rng(914), np.arange(0.0, 20.0, 0.01)
    parts = [(f, 0.02 / f, rng.uniform(0.0, 6.28)) for f in (0.31, 0.73, 1.37)]
    x, v, a = (
        sum(c * (2 * np.pi * f) ** n * np.sin(2 * np.pi * f * t + phase + 0.5 * np.pi * n) for f, c, phase in parts)
        for n in range(3)
    )
    table = {"t": t, "x": x, "f": 50.0 * x + 3.0 * v + (0.5 * a if "axis" in nominal else 0.0)}
    at = rng.uniform(5.0, 15.0)
    table[reading] = table[reading] + jump * (t > at)
    noisy = {"t": t, "x": table["x"] + 2e-6 * rng.normal(size=t.size), "f": table["f"] + 2e-3 * rng.normal(size=t.size)}
    result = sd.diagnose([noisy], nominal).as_dict()
    (found,) = result["effects"]
    assert found["id"] == "sensor_bias" and found["probability"] > 0.9
    offset, instant = found["parameters"][f"offset_{unit}"], found["parameters"]["instant_s"]
    assert offset["value"] == pytest.approx(jump, rel=0.05)
    assert instant["value"] == pytest.approx(at, abs=0.01) and instant["ci95"][1] - instant["ci95"][0] < 0.05


@pytest.mark.long
def test_a_force_sensor_of_the_rig_whose_zero_jumps(tmp_path: Path) -> None:
    """Three recordings on one clock, 20 s apart; the zero jumps in the second, by three to six times the noise."""
    at, jump = 24.7, np.array([0.012, -0.02, 0.025])
    tables = []
    for number in range(3):
        truth = rig_cases.Truth(force_reading=lambda f, t, n=number: f + np.outer(jump, 20.0 * n + t > at))
        columns = rig_cases.record(truth, 4100 + number, duration_s=15.0)
        tables.append({**columns, "time_s": columns["time_s"] + 20.0 * number})
    nominal = tmp_path / "nominal.toml"
    nominal.write_text(rig_cases.TOML, encoding="utf-8")
    (found,) = sd.diagnose(tables, nominal).as_dict()["effects"]
    assert found["id"] == "sensor_bias" and found["subsystem"] == "force_sensor"
    offsets = [found["parameters"][f"offset_{axis}_N"]["value"] for axis in "xyz"]
    assert np.allclose(offsets, jump, atol=[0.003, 0.003, 0.006])  # the wall's stiffness takes a part of the normal one
    assert found["parameters"]["instant_s"]["value"] == pytest.approx(at, abs=0.15)
