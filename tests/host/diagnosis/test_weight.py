"""A constant force that acts on a simulated shape in addition to the recorded contact force."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import seldinger as sd
from host.diagnosis.export.module import module_of
from host.diagnosis.model.effect import Array

PERIOD_S, NOISE_M = 0.02, 2e-5
STIFFNESS_Nm2 = 0.01
COLUMNS = {"length_m": "m", "side_N": "N", "axial_N": "N", "side_m": "m", "axial_m": "m"}


def cantilever(inputs: dict[str, Array], parameters: dict[str, float], time_s: Array) -> dict[str, Array]:
    """Tip of a cantilever of varying length under a force at its tip; the axial force bends what is bent already."""
    length, side, axial = inputs["length_m"], inputs["side_N"], inputs["axial_N"]
    bent = side * length**3 / (3.0 * parameters["bending_stiffness_Nm2"])
    bent = bent / (1.0 + 0.4 * axial * length**2 / parameters["bending_stiffness_Nm2"])
    return {"side_m": bent, "axial_m": length - 0.6 * bent**2 / length}


def nominal() -> dict[str, Any]:
    """The cantilever with its stiffness free."""
    section = {
        "function": f"{__name__}:cantilever",
        "inputs": list(COLUMNS)[:3],
        "outputs": list(COLUMNS)[3:],
        "subsystem": "shaft",
    }
    return {
        "name": "shaft",
        "kind": "callable",
        "data": {"time": "t"},
        "channels": {name: {"column": name, "unit": unit} for name, unit in COLUMNS.items()},
        "callable": {**section, "load": ["side_N", "axial_N"]},
        "parameters": {"bending_stiffness_Nm2": 0.012},
    }


def recorded(seed: int, weight_N: tuple[float, float]) -> dict[str, Array]:
    """Length and forces wander; a weight that the recorded forces do not contain; white noise of the readings."""
    rng = np.random.default_rng(seed)
    t = np.arange(900) * PERIOD_S

    def wander(middle: float, reach: float) -> Array:
        tones = (np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) for f in (0.13, 0.37, 0.71))
        return middle + reach / 3.0 * sum(tones, np.zeros(t.size))

    inputs = {"length_m": wander(0.1, 0.04), "side_N": wander(0.1, 0.15), "axial_N": wander(0.2, 0.2)}
    acting = {name: inputs[name] + added for name, added in zip(("side_N", "axial_N"), weight_N, strict=True)}
    out = cantilever({**inputs, **acting}, {"bending_stiffness_Nm2": STIFFNESS_Nm2}, t)
    return {"t": t, **inputs, **{name: row + NOISE_M * rng.standard_normal(t.size) for name, row in out.items()}}


def test_a_weight_next_to_the_recorded_force_is_named_with_both_components() -> None:
    verdict = sd.diagnose([recorded(k, (0.02, 0.05)) for k in range(3)], nominal())
    (effect,) = verdict.effects
    assert (effect["id"], effect["port"]) == ("gravity_load", "weight")
    found = {key: p["value"] for key, p in effect["parameters"].items()}
    assert found["added_side_N"] == pytest.approx(0.02, rel=0.05)
    assert found["added_axial_N"] == pytest.approx(0.05, rel=0.1)
    assert "offset of the force sensor" in effect["says"]


def test_a_weight_along_one_component_may_be_an_offset_of_the_sensor() -> None:
    verdict = sd.diagnose([recorded(k, (0.02, 0.0)) for k in range(3)], nominal())
    (effect,) = verdict.effects
    assert (effect["id"], effect["port"]) == ("gravity_load", "side_N")
    assert "sensor_bias@shaft" in effect["indistinguishable_from"]
    assert effect["probability"] < 0.9
    assert effect["parameters"]["force_N"]["value"] == pytest.approx(0.02, rel=0.05)


def test_no_weight_is_named_where_there_is_none() -> None:
    verdict = sd.diagnose([recorded(k, (0.0, 0.0)) for k in range(3)], nominal())
    assert (verdict.verdict, verdict.effects) == ("nothing_missing", [])


def test_a_model_with_a_weight_is_exported(tmp_path: Path) -> None:
    result = sd.diagnose([recorded(k, (0.02, 0.05)) for k in range(3)], nominal())
    target = tmp_path / "exported.py"
    target.write_text(module_of(result.diagnosis))
    inputs = {name: values for name, values in recorded(5, (0.02, 0.05)).items() if name in list(COLUMNS)[:3]}
    found = runpy.run_path(str(target))["simulate"](inputs, np.arange(900) * PERIOD_S)
    values = {key: p["value"] for key, p in result.effects[0]["parameters"].items()}
    acting = {"side_N": inputs["side_N"] + values["added_side_N"], "axial_N": inputs["axial_N"] + values["added_axial_N"]}
    best = result.diagnosis.found.best.values[:1]
    wanted = cantilever({**inputs, **acting}, {"bending_stiffness_Nm2": float(best[0])}, np.arange(900) * PERIOD_S)
    np.testing.assert_allclose(found["side_m"], wanted["side_m"], rtol=1e-9)
