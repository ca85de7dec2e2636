"""Noise, evidence and intervals on signals whose statistics are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from host.diagnosis.estimation import noise
from host.diagnosis.estimation.evidence import compare, whiteness
from host.diagnosis.estimation.noise import correlation_time
from host.diagnosis.estimation.rules import RULES
from host.diagnosis.estimation.uncertainty import _jackknife
from host.diagnosis.model import readings
from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.model import Segment
from host.diagnosis.selection.locate import inside, joined, windows


def ar1(rng: np.random.Generator, n: int, phi: float, sigma: float = 1.0) -> np.ndarray:
    """First-order autoregression of standard deviation sigma."""
    out = np.zeros(n)
    for i in range(1, n):
        out[i] = phi * out[i - 1] + np.sqrt(1 - phi**2) * rng.normal()
    return sigma * out


def segment(n: int) -> Segment:
    """A recording that is all held out."""
    every = np.ones(n, dtype=bool)
    t = np.arange(n) * 0.01
    return Segment(Recording("r", t, 0.01, True, {}, ~every, every), np.zeros((1, n)), ~every, every, {})


def test_noise_comes_from_the_quiescent_parts() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(6000)
    motion = np.where((t // 1000) % 2 == 0, 0.0, np.sin(t / 20.0)) + 0.0
    y = motion + ar1(rng, t.size, 0.7, 0.02)
    still = noise.quiescent([motion], 0.01, True)
    found = noise.estimate([y], [still])
    assert found.source is noise.NoiseSource.QUIESCENT and found.sigma == pytest.approx(0.02, rel=0.15)
    assert found.correlation_samples == pytest.approx((1 + 0.7) / (1 - 0.7), rel=0.35)


def test_noise_without_rest_says_so() -> None:
    y = np.sin(np.arange(4000) / 30.0) + 0.01 * np.random.default_rng(0).normal(size=4000)
    found = noise.estimate([y], [np.zeros(4000, dtype=bool)])
    assert found.source is noise.NoiseSource.SPECTRUM and found.sigma == pytest.approx(0.01, rel=0.35)


@pytest.mark.parametrize(("step", "source"), [(0.01, noise.NoiseSource.RESOLUTION), (0.0, noise.NoiseSource.CONSTANT)])
def test_noise_below_one_step_was_seen_alone(step: float, source: noise.NoiseSource) -> None:
    """A reading that rests within one of its steps bounds the noise; one without steps that never changes does not."""
    t = np.arange(6000)
    motion = np.where((t // 1000) % 2 == 0, 0.0, np.sin(t / 20.0)) + 0.0
    y = np.round(motion / step) * step if step else motion
    found = noise.estimate([y], [noise.quiescent([motion], 0.01, True)])
    assert found.source is source and found.source.seen_alone is (step > 0.0)
    assert found.sigma == pytest.approx(step / np.sqrt(12.0), abs=1e-9)


def test_whitened_noise_is_white() -> None:
    rng = np.random.default_rng(2)
    y = ar1(rng, 5000, 0.8, 0.5)
    found = noise.estimate([y], [np.ones(5000, dtype=bool)])
    w = found.whiten(ar1(rng, 5000, 0.8, 0.5))
    assert np.nanstd(w) == pytest.approx(1.0, rel=0.06) and correlation_time(w) < 1.3


def test_wild_samples_are_found_and_steps_are_not() -> None:
    y = np.where(np.arange(300) > 150, 1.0, 0.0) + 0.001 * np.random.default_rng(0).normal(size=300)
    y[40] = 9.0
    assert np.flatnonzero(readings.wild(y, 0.001, RULES.data)).tolist() == [40]


@settings(max_examples=8, deadline=None)
@given(st.sampled_from([0.0, 0.5, 0.9]), st.integers(0, 99))
def test_correlation_time_of_an_autoregression(phi: float, seed: int) -> None:
    r = ar1(np.random.default_rng(seed), 20000, phi)
    assert correlation_time(r) == pytest.approx((1 + phi) / (1 - phi), rel=0.35)


def test_nothing_gained_is_not_taken_for_something() -> None:
    """Models that differ by what noise alone makes of a useless regressor: small p-values must be rare."""
    small = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        r = ar1(rng, 3000, 0.9)
        other = r - 0.03 * ar1(rng, 3000, 0.9)
        small += compare([segment(3000)], "heldout", [r[None]], [other[None]], np.array([1.0]), RULES).p_value < 0.01
    assert small <= 3


def test_a_gain_is_counted_by_independent_samples() -> None:
    rng = np.random.default_rng(0)
    r = ar1(rng, 8000, 0.9)
    s = np.sin(np.arange(8000) / 50.0)
    gain = compare([segment(8000)], "heldout", [(r + s)[None]], [r[None]], np.array([1.0]), RULES)
    assert gain.p_value < 1e-6 and gain.share == pytest.approx(1 / 3, abs=0.05)
    assert gain.log_likelihood == pytest.approx(0.5 * 8000 / 19 * np.log(1.5), rel=0.4)


def test_whiteness_tells_noise_from_a_rest_that_is_none() -> None:
    """The tester is tested: it must see a small slow rest, and a scale that is wrong."""
    rng = np.random.default_rng(4)
    every = np.ones(4000, dtype=bool)
    white = rng.normal(size=4000)
    assert whiteness([white], [every]) > 0.01
    assert whiteness([white + 0.4 * np.sin(np.arange(4000) / 40.0)], [every]) < 1e-6
    assert whiteness([1.2 * white], [every]) < 1e-6


def test_windows_follow_their_definition() -> None:
    t = np.arange(0, 20, 0.01)
    m = np.where((t > 5) & (t < 8), 1.0, 0.0) + np.where((t > 8.3) & (t < 9), 1.0, 0.0)
    ((a, b),) = windows(m, t, 0.01, RULES)
    assert a == pytest.approx(5.0, abs=0.3) and b == pytest.approx(9.0, abs=0.3)
    assert inside([(5.0, 9.0)], t).sum() == pytest.approx(400, abs=2)
    assert joined([(3.0, 4.0), (1.0, 2.0), (2.2, 2.4), (6.0, 6.1)], RULES) == [(1.0, 2.4), (3.0, 4.0)]


def test_noise_by_steps_is_not_misled_by_a_slow_signal_or_by_jumps() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(3000) / 40.0
    e = rng.normal(size=t.size + 1)
    rough = 0.05 * (e[1:] + 0.5 * e[:-1]) / np.sqrt(1.25)
    sigma, correlation = noise.by_steps(rough + 0.2 * np.sin(0.3 * t) + 0.5 * (t > 30.0), 1e-4, 1.0)
    assert sigma == pytest.approx(0.05, rel=0.1) and 1.3 < correlation < 2.6
    assert noise.by_steps(rough, 0.3, 4.0) == (0.3, 4.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_jackknife_knows_when_few_blocks_carry_a_parameter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spread, freedom = [], []
    for _ in range(300):
        J = np.column_stack([np.ones(600), np.where(np.arange(600) < 30, 1.0, 0.01)])
        r = rng.standard_normal(600)
        r -= J @ np.linalg.lstsq(J, r, rcond=None)[0]
        blocks = [(J[k : k + 10].T @ J[k : k + 10], J[k : k + 10].T @ r[k : k + 10]) for k in range(0, 600, 10)]
        each = _jackknife(blocks, np.zeros((2, 2)))
        spread.append(each[0])
        freedom.append(each[1])
    true = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    assert np.sqrt(np.mean(np.square(spread), axis=0))[0] == pytest.approx(true[0], rel=0.1)
    assert np.all(np.sqrt(np.mean(np.square(spread), axis=0)) > 0.95 * true)
    assert np.mean(freedom, axis=0)[1] < 5.0 < 40.0 < np.mean(freedom, axis=0)[0]


def test_a_block_with_the_begin_of_a_recording_does_not_leave_its_state_free() -> None:
    """A parameter and the state at the first sample, which dies out within the first of five blocks."""
    rng, n = np.random.default_rng(5), 600
    t = np.arange(n) / n
    J = np.column_stack([0.3 + np.sin(9.0 * t), 2.0 * np.exp(-t / 0.03)])
    prior = np.diag([0.0, 1.0])  # the state was measured to one standard deviation, of which its column is made
    true = np.sqrt(np.linalg.inv(J.T @ J + prior)[0, 0])
    spread = {"known": [], "free": []}
    for _ in range(200):
        state = rng.standard_normal()
        y = J[:, 1] * state + rng.standard_normal(n)
        r = y - J @ np.linalg.solve(J.T @ J + prior, J.T @ y)
        blocks = [(J[k : k + 120].T @ J[k : k + 120], J[k : k + 120].T @ r[k : k + 120]) for k in range(0, n, 120)]
        spread["known"].append(_jackknife(blocks, prior)[0][0])
        spread["free"].append(_jackknife(blocks, np.zeros((2, 2)))[0][0])
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in spread.items()}
    assert 0.9 * true < rms["known"] < 1.5 * true
    assert rms["free"] > 3.0 * true


def test_noise_is_what_does_not_repeat() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(2000) * 0.01
    x = np.sin(2 * np.pi * 0.5 * t) + 0.3 * np.sin(2 * np.pi * 1.5 * t)
    structure = np.sign(np.gradient(x))  # a residual that comes back with every period
    outputs = [structure + 0.02 * rng.standard_normal(t.size) for _ in range(2)]
    nowhere = [np.zeros(t.size, dtype=bool)] * 2
    repeats = noise.repeated([[x], [np.roll(x, 37)]], RULES)
    assert {(a, b) for a, _, b, _ in repeats} == {(0, 0), (1, 1), (0, 1)}
    found = noise.estimate(outputs, nowhere, noise.repeated([[x], [x]], RULES))
    assert found.source is noise.NoiseSource.REPEATS and found.sigma == pytest.approx(0.02, rel=0.05)
    alone = noise.estimate(outputs, nowhere).sigma
    assert alone == pytest.approx(0.02, rel=0.15)  # the spectrum takes the jumps for noise, the middling difference does not
    assert noise.repeated([[x], [rng.standard_normal(t.size)]], RULES)[0][2] == 0


def test_readings_that_are_none_are_found() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(2000) * 0.01
    y = np.sin(2 * np.pi * 0.4 * t) + 0.002 * rng.standard_normal(t.size)
    codes = y.copy()
    for first in (100, 700, 1500):
        codes[first : first + 8] = -5.0
    assert np.flatnonzero(readings.lost(codes, RULES.data)).size == 24 and not readings.lost(y, RULES.data).any()
    assert readings.resolution(np.round(y / 0.2) * 0.2, RULES.data, switched=False) == pytest.approx(0.2)
    assert readings.resolution(np.sign(y), RULES.data, switched=True) == 0.0
    last = y.copy()
    last[-1] = 9.0
    assert np.flatnonzero(readings.wild(last, 0.002, RULES.data)).tolist() == [t.size - 1]
