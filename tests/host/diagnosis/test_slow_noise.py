"""Slow noise is no mismatch: handed on by a controller, in rests that are shorter than it, in bursts, and as echoes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

import seldinger as sd
from host.diagnosis.estimation.coloured import structured
from host.diagnosis.estimation.jumps import jumps_of
from host.diagnosis.estimation.noise import NoiseSource, estimate, runs
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.model.readings import scatter, wild
from tests.host.proof.everyday import first_order_nominal, wander

Array = np.ndarray
PLANT = first_order_nominal("1", "1", gain=1.0, tau=1.0)


def regulated(rng: np.random.Generator, noise: Array, late: int) -> tuple[Array, Array]:
    """Input and reading of a plant of first order (2 s) under a controller that reads it with noise, at 20 Hz."""
    keep, wanted = np.exp(-0.05 / 2.0), np.repeat(rng.uniform(-1.0, 1.0, 1 + noise.size // 150), 150)
    u, y, x, total = np.zeros(noise.size), np.zeros(noise.size), 0.0, 0.0
    for row in range(noise.size):
        y[row] = x + noise[row]
        error = wanted[row] - y[max(0, row - late)]
        total += 0.05 * error
        u[row] = 3.0 * error + 1.5 * total
        x = keep * x + (1.0 - keep) * 4.0 * u[row]
    return u, y


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "late"), [(12, 0), (0, 1), (1, 1), (5, 1), (6, 1), (8, 1)])
def test_slow_noise_in_a_loop_is_not_a_mismatch(seed: int, late: int) -> None:
    """The plant's speed follows the noise that the controller hands on, in the same row or the next; nothing is missing."""
    recordings = []
    for k in range(3):
        rng = np.random.default_rng([701, seed, k])
        u, y = regulated(rng, 0.02 * wander(rng, 1200, 6.0), late)
        recordings.append({"t": 0.05 * np.arange(u.size), "u": u, "y": y})
    assert sd.diagnose(recordings, PLANT).verdict == "nothing_missing"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_noise_slower_than_the_rests_is_not_a_mismatch(seed: int) -> None:
    recordings = []
    for k in range(3):
        rng = np.random.default_rng([709, seed, k])
        u = np.concatenate([np.full(int(rng.integers(40, 75)), rng.normal(0.0, 1.0)) for _ in range(11)])
        y = signal.lfilter([0.0, 1.0 - np.exp(-0.1 / 3.0)], [1.0, -np.exp(-0.1 / 3.0)], 2.0 * u)
        recordings.append({"t": 0.1 * np.arange(u.size), "u": u, "y": y + 0.05 * wander(rng, u.size, 70.0)})
    assert sd.diagnose(recordings, PLANT).verdict == "nothing_missing"


@pytest.mark.parametrize(
    ("samples", "rest", "source"), [(60.0, 60, "SHORT_RESTS"), (60.0, 1500, "QUIESCENT"), (0.1, 60, "QUIESCENT")]
)
def test_a_level_is_measured_in_rests_that_are_long_for_the_noise(samples: float, rest: int, source: str) -> None:
    rng = np.random.default_rng(719)
    still = [(np.arange(6000) % (2 * rest)) < rest]
    assert len(runs(still[0], 30)) >= 2
    found = estimate([wander(rng, 6000, samples)], still)
    assert found.source is NoiseSource[source]
    assert (found.sigma < 0.8) is (found.source is NoiseSource.SHORT_RESTS)


def test_bursts_of_noise_are_not_a_structure() -> None:
    """Noise that is large now and then meets a form of the input that is large now and then, by chance alone."""
    found = 0
    for seed in range(40):
        rng, inputs, noise = np.random.default_rng([727, seed]), [], []
        for _ in range(2):
            bursts = 0.02 + np.convolve(rng.random(2000) < 0.001, np.ones(40))[:2000]
            inputs.append([np.cumsum(np.convolve(rng.random(2000) < 0.001, np.ones(40))[:2000])])
            noise.append(bursts * wander(rng, 2000, 20.0))
        found += structured(noise, inputs, [], RULES)
    assert found <= 1


def test_bursts_of_slow_noise_are_not_jumps() -> None:
    """A level that shifts within a burst is noise; one that shifts and stays is a jump."""
    seen = 0
    for seed in range(20):
        rng = np.random.default_rng([739, seed])
        bursts = 0.15 + np.convolve(rng.random(1800) < 0.0015, np.ones(30))[:1800]
        r = bursts * wander(rng, 1800, 5.0)
        assert not jumps_of([r], RULES)
        seen += any(abs(jump.sample - 900) <= 3 for jump in jumps_of([r + 10.0 * (np.arange(1800) >= 900)], RULES))
    assert seen >= 18


def test_three_echoes_of_seven_samples_are_outliers_where_echoes_are_frequent() -> None:
    rng = np.random.default_rng(733)
    values = 0.01 * rng.standard_normal(3000)
    frequent = values.copy()
    frequent[20::60] += 1.0
    for echoes in (values, frequent):
        echoes[[1501, 1503, 1504]] += 1.0
    bad = wild(frequent, scatter(frequent), RULES.data)
    assert bad[[1501, 1503, 1504]].all() and np.count_nonzero(bad) == 53
    assert not wild(values, scatter(values), RULES.data).any()  # three in a row, and no others: a motion
