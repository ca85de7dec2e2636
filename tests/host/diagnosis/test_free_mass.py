"""A free mass whose position is read: simulated where that agrees down to the noise, else the forces are compared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from host.diagnosis import diagnose
from host.diagnosis.estimation.feedback import common_part
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.effect import Array
from host.diagnosis.model.operators import reading_noise, wander_at_rest, white_level
from host.diagnosis.models.balance import at_rest
from tests.host.proof.everyday import free_nominal

MASS_KG, DAMPING = 0.5, 3.0
STUCK = "the noise hides when the mass sticks: friction of 0.9 N is fitted as 0.71 N, and a dead zone and a mode leave less"
FRICTIONS = {"coulomb_friction", "presliding_friction", "stribeck_friction"}


def slide(
    number: int, loop: str, noise_m: float, coulomb_N: float = 0.0, sensor_force_N: float = 0.0, gain: float = 100.0
) -> dict[str, Any]:
    """A mass and a damper, held force; `loop`: "steps" of a set-point with rests, "smooth" set-points, or open "pulses".

    sensor_force_N: noise of the recorded force, which does not act on the mass.
    """
    rng = np.random.default_rng([79, number])
    t, h = np.arange(2000) / 100.0, 0.01 / 40.0
    tones = np.sin(2.0 * np.pi * np.outer(t, np.geomspace(0.1, 1.0, 7)) + rng.uniform(0.0, 6.28, 7)).sum(axis=1)
    wanted = {"steps": 0.05 * np.repeat(rng.uniform(-1.0, 1.0, 16), 130)[: t.size], "smooth": 0.02 * tones}.get(loop)
    pulses = np.repeat(rng.choice([-2.0, 0.0, 0.0, 2.0], 34) * rng.uniform(0.5, 1.5, 34), 60)[: t.size]
    x = v = before = 0.0
    force, place = np.empty(t.size), np.empty(t.size)
    for i in range(t.size):
        place[i] = x + noise_m * rng.standard_normal()
        force[i] = pulses[i] if wanted is None else gain * (wanted[i] - place[i]) - 3.0 * (place[i] - before) / 0.01
        before = place[i]
        for _ in range(40):
            a = (force[i] - DAMPING * v - coulomb_N * np.tanh(v / 2e-3)) / MASS_KG
            x, v = x + h * v + 0.5 * h * h * a, v + h * a
    return {"t": t, "f": force + sensor_force_N * rng.standard_normal(t.size), "x": place}


@pytest.mark.parametrize(("loop", "noise_m"), [("steps", 1e-4), ("steps", 3e-4), ("smooth", 1e-4), ("pulses", 6e-4)])
def test_nothing_is_missing(loop: str, noise_m: float) -> None:
    """Friction (0.83), a resonance (0.92) or a lag (0.92) was named: at rest and in steps the forces say little."""
    verdict = diagnose([slide(k, loop, noise_m) for k in (1, 2, 3)], free_nominal("zero")).as_dict()
    assert verdict["verdict"] == "nothing_missing"
    found = verdict["fit"]["nominal_parameters"]
    assert found["mass_N_s2_per_m"]["value"] == pytest.approx(MASS_KG, rel=5e-3)
    assert found["damping_N_s_per_m"]["value"] == pytest.approx(DAMPING, rel=5e-3)


@pytest.mark.parametrize(
    ("loop", "noise_m", "friction_N"),
    [
        pytest.param("steps", 5e-5, 0.3, marks=pytest.mark.long),
        pytest.param("steps", 1e-4, 0.6, marks=pytest.mark.long),
        pytest.param("steps", 1.5e-4, 0.9, marks=[pytest.mark.long, pytest.mark.xfail(reason=STUCK, strict=True)]),
        ("smooth", 1e-4, 0.5),
        ("pulses", 6e-4, 0.4),
    ],
)
def test_friction_is_named_alone(loop: str, noise_m: float, friction_N: float) -> None:
    """A mass that sticks was given a dead zone of the drive (0.92) and a resonance (0.90)."""
    verdict = diagnose([slide(k, loop, noise_m, friction_N) for k in (4, 5, 6)], free_nominal("zero")).as_dict()
    assert len(verdict["effects"]) == 1 and verdict["effects"][0]["id"] in FRICTIONS


def test_a_force_that_is_read_with_noise_is_compared_itself() -> None:
    """Its noise does not act on the mass, and integrated twice it leads a simulation away from the recording."""
    runs = [slide(k, "pulses", 2e-6, 0.4, sensor_force_N=0.05) for k in (7, 8, 9)]
    verdict = diagnose(runs, free_nominal("zero")).as_dict()
    assert [effect["id"] for effect in verdict["effects"]] in [[name] for name in FRICTIONS]
    assert list(verdict["fit"]["per_channel"]) == ["f"]


def test_steps_of_an_input_are_no_noise() -> None:
    rng = np.random.default_rng(5)
    steps = np.repeat(rng.uniform(-2.0, 2.0, 40), 50)
    noise = 0.01 * rng.standard_normal(steps.size)
    assert white_level(steps) > 0.03
    assert reading_noise(steps) < 1e-12
    assert reading_noise(steps + noise) == pytest.approx(0.01, rel=0.15)
    assert reading_noise(noise) == white_level(noise)


def test_the_new_part_of_an_input_is_found_next_to_steps() -> None:
    rng = np.random.default_rng(6)
    noise = 0.01 * rng.standard_normal(2000)
    new, steps = common_part(np.repeat(rng.uniform(-2.0, 2.0, 20), 100) + noise, RULES)
    assert np.count_nonzero(steps) < 60
    assert 0.01 < np.std(new[~steps]) < 0.015  # a level is predicted from some noisy samples


def test_noise_at_rest_is_no_movement() -> None:
    from scipy.signal import savgol_filter

    rng = np.random.default_rng(7)
    x = np.concatenate((np.zeros(800), np.linspace(0.0, 1.0, 400))) + 1e-3 * rng.standard_normal(1200)
    smooth = savgol_filter(x, 7, 3)
    tolerance = wander_at_rest(x, smooth, 7)
    rests = at_rest(smooth, tolerance, 15)
    assert np.ptp(smooth[:780]) < 1.4 * tolerance
    assert np.mean(rests[20:760]) > 0.9 and not rests[820:1180].any()


def pushed(number: int, noise_m: float, acts: Callable[[Array], Array], first: int) -> dict[str, Array]:
    """A mass from rest under a held force, of which `acts` acts; recorded from sample `first` on."""
    rng = np.random.default_rng([80, number])
    t, x, v = np.arange(2000) / 100.0, 0.0, 0.0
    force = 1.5 * np.sin(2.0 * np.pi * np.outer(t, np.geomspace(0.1, 1.5, 7)) + rng.uniform(0.0, 6.28, 7)).sum(axis=1)
    place, keep = np.empty(t.size), np.exp(-DAMPING / MASS_KG * 0.01)
    for i, acting in enumerate(acts(force)):
        place[i], steady = x, acting / DAMPING
        x += steady * 0.01 + (v - steady) * (1.0 - keep) * MASS_KG / DAMPING
        v = steady + (v - steady) * keep
    place += noise_m * rng.standard_normal(t.size)
    return {"t": t[: t.size - first], "f": force[first:], "x": place[first:]}


@pytest.mark.parametrize(
    ("late", "noise_m", "first"),
    [
        (5, 2e-4, 300),
        pytest.param(5, 1e-5, 300, marks=pytest.mark.long),
        pytest.param(2, 2e-4, 300, marks=pytest.mark.long),
        (5, 2e-4, 0),
    ],
)
def test_a_delay_of_the_force_is_found(late: int, noise_m: float, first: int) -> None:
    """Cut from motion: a speed that was held to four standard deviations of the first readings could not take up the input
    before them. From rest: the trial ended at 37 ms, held back by the states that belong to no delay.
    """
    runs = [pushed(k, noise_m, lambda f: np.concatenate((np.zeros(late), f[:-late])), first) for k in (1, 2, 3)]
    (found,) = diagnose(runs, free_nominal("zero")).effects
    assert found["id"] == "latency"
    assert found["parameters"]["delay_s"]["value"] == pytest.approx(0.01 * late, rel=0.01)


def test_a_digital_low_pass_of_a_held_force_is_a_lag() -> None:
    """It was computed at points within each sample, as an analogue one is: a mode with a share of the motion was named."""
    keep = np.exp(-0.01 / 0.08)
    runs = [pushed(k, 2e-4, lambda f: lfilter([1.0 - keep], [1.0, -keep], f), 300) for k in (1, 2, 3)]
    (found,) = diagnose(runs, free_nominal("zero")).effects
    assert found["id"] == "rate_lag"
    assert found["parameters"]["time_constant_s"]["value"] == pytest.approx(0.08, rel=0.01)
