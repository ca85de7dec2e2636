"""A vehicle whose speed is read: forces along its way are sized by its way, and units are those of the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import seldinger as sd

RATE_HZ = 20.0
STEPS = 4  # of the simulation in one sample
MASS_kg, DAMPING = 1100.0, 45.0
VEHICLE: dict[str, Any] = {
    "name": "vehicle",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"thrust": {"column": "u", "unit": "N"}, "speed": {"column": "v", "unit": "m/s"}},
    "axis": {"subsystem": "vehicle", "input": "thrust", "output": "speed", "terms": ["mass", "damping"],
             "reads": "velocity", "hold": "zero"},
    "parameters": {"mass": 1000.0, "damping": 55.0},
}  # fmt: skip


def drives(force: Callable[[float], float], lowest_N: float) -> list[dict[str, Any]]:
    """Three drives of a minute against `force` (N) of the speed, with thrusts of `lowest_N` to 2500 N that last 4 s."""
    made = []
    for k in range(3):
        rng = np.random.default_rng([61, k])
        t = np.arange(0.0, 60.0, 1.0 / RATE_HZ)
        thrust = np.repeat(rng.uniform(lowest_N, 2500.0, 15), 80)
        speed, v, h = np.empty(t.size), rng.uniform(5.0, 15.0), 1.0 / RATE_HZ / STEPS

        def acceleration(v: float, push: float) -> float:
            return (push - DAMPING * v - force(v)) / MASS_kg

        for i, push in enumerate(thrust):
            speed[i] = v
            for _ in range(STEPS):
                middle = v + 0.5 * h * acceleration(v, push)
                v += h * acceleration(middle, push)
        made.append({"t": t, "u": thrust, "v": speed + 0.03 * rng.standard_normal(t.size)})
    return made


def test_drag_of_the_square_of_the_speed() -> None:
    """Its first step was ten times too long, as that of an acceleration: an equation was named (0.18)."""
    (found,) = sd.diagnose(drives(lambda v: 1.2 * v * abs(v), -500.0), VEHICLE).effects
    assert found["id"] == "viscous_friction" and found["probability"] > 0.5
    assert [name.partition("@")[0] for name in found["indistinguishable_from"]] == ["unlisted"]
    assert found["parameters"]["coefficient_N_s2_per_m2"]["value"] == pytest.approx(1.2, rel=0.05)


def test_a_constant_force_on_a_motion_of_both_directions_is_a_weight() -> None:
    (found,) = sd.diagnose(drives(lambda v: 900.0, -2500.0), VEHICLE).effects
    assert found["id"] == "gravity_load" and found["probability"] > 0.5
    assert found["parameters"]["force_N"]["value"] == pytest.approx(900.0, rel=0.03)


def test_on_a_motion_of_one_direction_it_is_indistinguishable_from_friction() -> None:
    """Only Coulomb friction was named, with a probability of 0.92."""
    (found,) = sd.diagnose(drives(lambda v: 300.0, 600.0), VEHICLE).effects
    assert {found["id"], *(name.partition("@")[0] for name in found["indistinguishable_from"])} >= {
        "coulomb_friction",
        "gravity_load",
    }
    assert found["probability"] < 0.9


def test_channels_that_no_link_reads_are_said() -> None:
    rng = np.random.default_rng(5)
    made = []
    for _ in range(2):
        t = np.arange(0.0, 20.0, 0.02)
        motor, side = (np.interp(t, np.arange(0.0, 21.0), rng.uniform(-1.0, 1.0, 21)) for _ in range(2))
        made.append({"t": t, "m": motor, "w": side, "y": motor + 0.1 * side + 0.003 * rng.standard_normal(t.size)})
    nominal: dict[str, Any] = {
        "name": "link",
        "kind": "transmission",
        "data": {"time": "t"},
        "channels": {name: {"column": name[0], "unit": "rad"} for name in ("motor", "w", "y")},
        "link": [{"subsystem": "link", "input": "motor", "output": "y"}],
    }
    verdict = sd.diagnose(made, nominal)
    assert not verdict.effects and "does not use w." in verdict.as_dict()["next"]
    nominal["link"][0]["others"] = ["w"]
    assert [effect["id"] for effect in sd.diagnose(made, nominal).effects] == ["coupling"]
