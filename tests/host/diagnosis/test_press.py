"""A pressed spring: what stands between its drive, its motion and the reading of its force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from host.diagnosis import diagnose
from tests.host.proof.everyday import spring_nominal

RATE_HZ, STIFFNESS, DAMPING, OFFSET = 200.0, 220.0, 3.0, 0.5


def strokes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), and position, speed and acceleration (n,) of five tones of 5 mm."""
    t = np.arange(0.0, 12.0, 1.0 / RATE_HZ)
    w, phase = 2.0 * np.pi * np.array([0.2, 0.45, 0.8, 1.3, 2.0]), rng.uniform(0.0, 6.28, 5)
    angle = np.outer(t, w) + phase
    size = np.full(5, 0.005)
    return t, np.sin(angle) @ size, np.cos(angle) @ (size * w), -np.sin(angle) @ (size * w**2)


def pressed(number: int, gap_m: float = 0.0, rubs: float = 0.0, mass_kg: float = 0.0) -> dict[str, Any]:
    """One recording. gap_m: of a dog clutch that carries the spring; rubs: friction over the force of the spring."""
    rng = np.random.default_rng([91, number])
    t, x, v, a = strokes(rng)
    carried, there = np.empty(t.size), x[0]
    for i, at in enumerate(x):
        if at - there > gap_m / 2:
            there = at - gap_m / 2
        elif there - at > gap_m / 2:
            there = at + gap_m / 2
        carried[i] = there
    spring = STIFFNESS * carried
    force = spring + DAMPING * np.gradient(carried, t) + mass_kg * a + rubs * np.abs(spring) * np.clip(v / 5e-4, -1.0, 1.0)
    return {"t": t, "x": x, "f": force + OFFSET + 0.01 * rng.standard_normal(t.size)}


@pytest.mark.parametrize(
    ("missing", "name", "parameter", "value"),
    [
        ({"gap_m": 0.003}, "backlash", "width_m", 0.003),
        ({"rubs": 0.12}, "load_dependent_friction", "coefficient", 0.12),
        ({"mass_kg": 0.4}, "resonance", "mass_N_s2_per_m", 0.4),
    ],
)
def test_it_is_named_with_its_size(missing: dict[str, float], name: str, parameter: str, value: float) -> None:
    """A gap was named friction of a negative force; this friction Coulomb's or an equation; a mass, one on a spring."""
    (found,) = diagnose([pressed(k, **missing) for k in (1, 2)], spring_nominal()).effects
    assert found["id"] == name
    assert found["probability"] >= 0.9
    assert found["parameters"][parameter]["value"] == pytest.approx(value, rel=0.05)


def behind_a_wrap(number: int, exponent: float) -> dict[str, Any]:
    """The force of a spring under 6 N of tension, read behind a rope round a post (Euler, Eytelwein)."""
    rng = np.random.default_rng([93, number])
    t, x, _, _ = strokes(rng)
    pull = STIFFNESS * x + 6.0
    read, grip = pull.copy(), np.exp(exponent)
    for i in range(1, t.size):
        low, high = sorted((pull[i] / grip, pull[i] * grip))
        read[i] = min(max(read[i - 1], low), high)
    return {"t": t, "x": x, "f": read + 0.01 * rng.standard_normal(t.size)}


def test_a_wrap_before_the_force_sensor_is_named_with_its_exponent() -> None:
    (found,) = diagnose([behind_a_wrap(k, 0.1) for k in (1, 2)], spring_nominal()).effects
    assert found["id"] == "load_dependent_friction"
    assert found["parameters"]["exponent"]["value"] == pytest.approx(0.1, rel=0.02)


def test_a_spring_and_a_damper_miss_nothing() -> None:
    assert diagnose([pressed(k) for k in (1, 2)], spring_nominal()).verdict == "nothing_missing"
