"""Friction that falls with speed, and a mass or damping that changes over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seldinger as sd
from host.diagnosis.model.effect import Array
from host.diagnosis.model.force_kernel import run_axis, slot_array

PRESS: dict[str, Any] = {
    "name": "press",
    "kind": "impedance",
    "data": {"time": "t"},
    "channels": {"x": {"column": "x", "unit": "m"}, "f": {"column": "f", "unit": "N"}},
    "impedance": {"subsystem": "press", "input": "x", "output": "f", "terms": ["mass", "damping", "stiffness", "offset"]},
}
SLIDE: dict[str, Any] = {
    "name": "slide",
    "kind": "axis",
    "data": {"time": "t"},
    "channels": {"u": {"column": "u", "unit": "N"}, "y": {"column": "y", "unit": "m"}},
    "axis": {"subsystem": "slide", "input": "u", "output": "y", "terms": ["mass", "damping", "stiffness"], "hold": "zero"},
    "parameters": {"mass": 1.0, "damping": 3.0, "stiffness": 100.0},
}
Law = Callable[[Array, Array, Array, Array], Array]


def pressed(seed: int, law: Law, noise_N: float = 0.02) -> dict[str, Array]:
    """Force of a press along a motion with the exact speed and acceleration, of 20 s."""
    rng = np.random.default_rng(seed)
    t: Array = np.arange(4000) * 0.005
    x: Array = np.zeros(t.size)
    v: Array = np.zeros(t.size)
    a: Array = np.zeros(t.size)
    for size, hertz in ((0.010, 0.31), (0.006, 0.83), (0.002, 2.3)):
        w, phase = 2.0 * np.pi * hertz, rng.uniform(0.0, 2.0 * np.pi)
        x += size * np.sin(w * t + phase)
        v += size * w * np.cos(w * t + phase)
        a -= size * w**2 * np.sin(w * t + phase)
    force: Array = law(t, x, v, a) + noise_N * rng.normal(size=t.size)
    return {"t": t, "x": x, "f": force}


def plain(t: Array, x: Array, v: Array, a: Array) -> Array:
    """Nominal law of the press."""
    return np.asarray(2.0 * a + 20.0 * v + 300.0 * x + 0.4)


def pushed(at: Array | float) -> Array:
    """Force on a slide: three tones."""
    return np.asarray(sum(np.sin(2.0 * np.pi * hertz * np.asarray(at) + k) for k, hertz in enumerate((0.21, 0.57, 1.3))))


@pytest.mark.parametrize(
    ("slots", "friction", "masses", "least"),
    [
        (
            {"smooth": 0.15, "smooth_excess": 0.3, "stribeck_speed": 0.03, "smooth_speed": 0.05},
            lambda at, v: (0.15 + 0.3 * np.exp(-((v / 0.03) ** 2))) * np.tanh(v / 0.05),
            lambda at: 0.5,
            1e-3,
        ),
        (
            {"mass": 0.5, "mass_rate": -0.03, "damping": 3.0, "damping_rate": 0.05},
            lambda at, v: 3.0 * 0.05 * at * v,
            lambda at: 0.5 * (1.0 - 0.03 * at),
            1e-6,
        ),
    ],
    ids=["friction that falls", "mass and damping"],
)
def test_the_axis_is_simulated_as_by_an_adaptive_integrator(
    slots: dict[str, float], friction: Callable[..., float], masses: Callable[[float], float], least: float
) -> None:
    t, none = 0.01 * np.arange(1500), np.zeros(1500)

    def slope(at: float, state: Array) -> list[float]:
        pull = 3.0 * state[1] + 40.0 * state[0] + friction(at, state[1])
        return [state[1], (float(pushed(at)) - pull) / masses(at)]

    wanted = solve_ivp(slope, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, method="LSODA").y[0]
    stages = pushed(t[:, None, None] + 0.005 * (np.arange(2)[None, :, None] + np.array([0.0, 0.5, 1.0])))
    law = np.array([0.5, 3.0, 40.0, 0.0])
    run = run_axis(stages, 2, 0.01, law, slot_array([slots]), np.zeros(2), none, np.zeros(0), none[None], 0.0, 0.0)
    assert float(np.std(run[0] - wanted)) < least * float(np.std(wanted))


def test_friction_that_falls_with_speed_and_rises_near_rest() -> None:
    """Rounded near rest by another function than the finder's."""

    def law(t: Array, x: Array, v: Array, a: Array) -> Array:
        falls = 0.3 + 0.5 / (1.0 + (v / 0.012) ** 2)
        return np.asarray(plain(t, x, v, a) + falls * v / np.sqrt(v**2 + 0.002**2))

    verdict = sd.diagnose([pressed(seed, law) for seed in range(2)], PRESS).as_dict()
    (effect,) = verdict["effects"]
    assert effect["id"] == "stribeck_friction" and "rise_speed_m_per_s" in effect["parameters"]


def test_friction_whose_fall_looks_like_less_damping_is_not_excluded() -> None:
    """The speeds are below that at which it would have fallen: dry friction and a smaller damping do as well."""

    def law(t: Array, x: Array, v: Array, a: Array) -> Array:
        return np.asarray(plain(t, x, v, a) + (0.1 + 0.1 * np.exp(-((v / 0.09) ** 2))) * np.sign(v))

    verdict = sd.diagnose([pressed(seed, law, noise_N=0.15) for seed in range(2)], PRESS).as_dict()
    (effect,) = verdict["effects"]
    assert effect["id"] == "stribeck_friction" or "stribeck_friction@press" in effect["indistinguishable_from"]
    assert effect["probability"] < 0.9


def test_plain_dry_friction_excludes_one_that_falls() -> None:
    def law(t: Array, x: Array, v: Array, a: Array) -> Array:
        return np.asarray(plain(t, x, v, a) + 0.4 * np.sign(v))

    verdict = sd.diagnose([pressed(seed, law) for seed in range(2)], PRESS).as_dict()
    (effect,) = verdict["effects"]
    assert effect["id"] == "coulomb_friction" and "stribeck_friction@press" not in effect["indistinguishable_from"]
    assert effect["probability"] > 0.9


@pytest.mark.parametrize("part", ["mass", "damping"])
def test_a_part_of_a_measured_law_that_changes_over_time(part: str) -> None:
    def law(t: Array, x: Array, v: Array, a: Array) -> Array:
        falls = {"mass": 2.0 * a, "damping": 20.0 * v}[part]
        return np.asarray(plain(t, x, v, a) - 0.015 * t * falls)

    verdict = sd.diagnose([pressed(seed, law) for seed in range(2)], PRESS).as_dict()
    (effect,) = verdict["effects"]
    low, high = effect["parameters"]["rate_per_s"]["ci95"]
    assert effect["says"].startswith(f"The {part} changes over time") and low < -0.015 < high


@pytest.mark.slow
def test_the_mass_of_an_axis_falls() -> None:
    """A tank that empties; the stiffness would do half as well, and is screened before it."""

    def run(seed: int) -> dict[str, Array]:
        rng = np.random.default_rng(seed)
        t = np.arange(2000) * 0.01
        tones = [(3.0 / hertz**0.5, hertz, rng.uniform(0.0, 6.28)) for hertz in (0.2, 0.45, 1.1, 1.9, 3.1)]
        u = np.asarray(sum(size * np.sin(2.0 * np.pi * hertz * t + phase) for size, hertz, phase in tones))

        def slope(at: float, state: Array) -> list[float]:
            held = u[min(int(at / 0.01 + 1e-9), t.size - 1)]
            return [state[1], (held - 3.0 * state[1] - 100.0 * state[0]) / (1.0 - 0.006 * at)]

        y = solve_ivp(slope, (0.0, t[-1]), [0.0, 0.0], "RK45", t_eval=t, rtol=1e-7, atol=1e-9, max_step=0.01).y[0]
        return {"t": t, "u": u, "y": y + 0.06 * float(np.std(y)) * rng.normal(size=t.size)}

    verdict = sd.diagnose([run(seed) for seed in range(2)], SLIDE).as_dict()
    (effect,) = verdict["effects"]
    low, high = effect["parameters"]["rate_per_s"]["ci95"]
    assert effect["says"].startswith("The mass changes over time") and low < -0.006 < high
