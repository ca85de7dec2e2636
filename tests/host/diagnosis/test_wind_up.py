"""Wind-up tests of a compliant mechanism with a locked output: torque in, deflection out, integrated as two masses."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from host.diagnosis import diagnose
from host.diagnosis.export.module import module_of
from host.diagnosis.model import operators as op
from host.diagnosis.model.nominal import nominal_of
from tests.host.diagnosis.test_export import found, simulated

Array = np.ndarray
WIND_UP: dict[str, Any] = {
    "name": "wind-up test of a gear",
    "kind": "transmission",
    "data": {"time": "t"},
    "channels": {"torque": {"column": "torque", "unit": "N m"}, "deflection": {"column": "q", "unit": "rad"}},
    "link": [{"subsystem": "gear", "input": "torque", "output": "deflection"}],
}
DT, SECONDS, NOISE = 0.04, 24.0, 2e-4
T = np.arange(0.0, SECONDS, DT)
STIFFNESS, GAP, FRICTION = 400.0, 0.05, 2.0
MOTOR, DISC, CONTACT, DAMPING = 0.02, 0.02, 2e4, 1.0


def ramps(top: float, period: float, phase: float) -> Callable[[float | Array], Array]:
    """A triangle wave of torque, 0 at time 0 where `phase` is 0."""
    return lambda t: np.asarray(top * 2.0 / np.pi * np.arcsin(0.999 * np.sin(2.0 * np.pi * np.asarray(t) / period + phase)))


def deflection(torque: Callable[[float | Array], Array], gap: float, friction: float, per_load: float = 0.0) -> Array:
    """Angle of a motor with dry friction that drives a disc across a gap; the disc is held by the spring."""

    def rates(t: float, s: Array) -> list[float]:
        q, v, d, u = s
        apart = q - d
        pressed = CONTACT * (apart - np.clip(apart, -0.5 * gap, 0.5 * gap))
        rubbed = (friction + per_load * abs(pressed)) * np.tanh(v / 2e-3)
        motor = (float(torque(t)) - rubbed - DAMPING * v - pressed) / MOTOR
        return [v, motor, u, (pressed - STIFFNESS * d - DAMPING * u) / DISC]

    run = solve_ivp(rates, (-6.0, T[-1]), np.zeros(4), "LSODA", t_eval=T, rtol=1e-6, atol=1e-8, max_step=0.02)
    return np.asarray(run.y[0])


def wound_up(gap: float, friction: float, per_load: float = 0.0) -> list[dict[str, Array]]:
    """Three recordings, each of another torque."""
    rng, runs = np.random.default_rng(4), []
    for top, period, phase in ((30.0, 12.0, 0.0), (12.0, 8.0, 0.7), (24.0, 9.0, 1.4)):
        torque = ramps(top, period, phase)
        q = deflection(torque, gap, friction, per_load) + 0.01
        runs.append({"t": T, "torque": torque(T), "q": q + NOISE * rng.normal(size=T.size)})
    return runs


def named(runs: list[dict[str, Array]]) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """Verdict, and the values of each effect's parameters by its id."""
    verdict = diagnose(runs, WIND_UP).as_dict()
    return verdict, {e["id"]: {k: p["value"] for k, p in e["parameters"].items()} for e in verdict["effects"]}


@pytest.mark.slow
def test_a_gap_behind_dry_friction() -> None:
    verdict, effects = named(wound_up(GAP, FRICTION))
    assert verdict["verdict"] == "missing_physics"
    assert effects["backlash"]["width_rad"] == pytest.approx(GAP, rel=0.05)
    friction = next(e for e in verdict["effects"] if e["id"].endswith("friction"))  # a small third effect is named, too
    assert "coulomb_friction" in (friction["id"], *(name.split("@")[0] for name in friction["indistinguishable_from"]))
    assert verdict["fit"]["rmse_after"] < 0.2 * verdict["fit"]["rmse_before"]


@pytest.mark.long
def test_a_gap_behind_friction_that_grows_with_the_load() -> None:
    verdict, effects = named(wound_up(GAP, 1.0, 0.25))
    assert set(effects) == {"backlash", "load_dependent_friction"} and verdict["verdict"] == "missing_physics"
    assert effects["backlash"]["width_rad"] == pytest.approx(GAP, rel=0.05)
    assert effects["load_dependent_friction"]["coefficient"] > 0.1


@pytest.mark.slow
def test_friction_alone_is_no_gap() -> None:
    _, effects = named(wound_up(0.0, FRICTION))
    assert "backlash" not in effects
    assert any(name.endswith("friction") for name in effects)  # damping over stiffness is a lag of 5 ms, named as well


@pytest.mark.slow
def test_a_curved_spring_is_no_gap() -> None:
    runs = wound_up(0.0, 0.0)
    for run in runs:
        run["q"] = run["q"] + 1.5e-7 * run["torque"] ** 3
    _, effects = named(runs)
    assert effects and "backlash" not in effects


def test_friction_holds_a_load_until_it_has_to_move() -> None:
    x = 9.0 * np.sin(T) + 3.0 * np.sin(3.3 * T)
    F = op.pressed(x, 1.0, 0.25, 0.0)
    assert np.all(np.abs(F - x) <= 1.0 + 0.25 * np.abs(F) + 1e-12)
    moved = np.abs(np.diff(F)) > 0.0
    assert np.allclose((np.abs(F - x) - 0.25 * np.abs(F))[1:][moved], 1.0)
    assert np.all(((x - F)[1:] * np.diff(F))[moved] > 0.0)  # what moves is pulled by the load
    assert np.allclose(op.pressed(x, 1.0, 0.0, 0.3), op.play(x, 1.0, 0.3))


@pytest.mark.slow  # exported kernels are compiled anew
def test_an_exported_gap_behind_friction_equals_the_simulation(tmp_path: Path) -> None:
    torque = ramps(30.0, 12.0, 0.4)(T)
    columns = {"t": T, "torque": torque, "q": op.play(torque, FRICTION, 0.0) / STIFFNESS}
    result = found(
        nominal_of(WIND_UP, tmp_path), columns, ("load_dependent_friction@gear_friction(held)", "backlash@gear_spring")
    )
    segment = result.problem.segments[0]
    segment.start = {"gear_friction": 0.4}
    (tmp_path / "extended.py").write_text(module_of(result))
    simulate = runpy.run_path(str(tmp_path / "extended.py"))["simulate"]
    out = simulate({"torque": torque}, segment.recording.time_s, None, segment.start)
    assert np.max(np.abs(out["deflection"] - simulated(result)[0])) <= 1e-9 * np.max(np.abs(out["deflection"]))
