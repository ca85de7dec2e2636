"""Memory operators against definitions written another way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from host.diagnosis.model import operators as op

signals = arrays(np.float64, st.integers(5, 60), elements=st.floats(-3.0, 3.0, width=32))


@settings(max_examples=40, deadline=None)
@given(signals, st.floats(0.01, 2.0))
def test_play_stays_within_its_gap_and_moves_only_at_its_edges(x: np.ndarray, radius: float) -> None:
    y = op.play(x, radius, 0.0)
    assert np.all(np.abs(y - x) <= radius + 1e-12)
    moved = np.flatnonzero(np.abs(np.diff(y)) > 1e-9) + 1
    assert np.allclose(np.abs(x[moved] - y[moved]), radius)


@settings(max_examples=30, deadline=None)
@given(signals, st.floats(0.01, 2.0))
def test_play_does_not_mind_the_speed(x: np.ndarray, radius: float) -> None:
    slow = np.interp(np.arange(0, x.size - 0.999, 0.25), np.arange(x.size), x)
    assert np.allclose(op.play(slow, radius, 0.0)[::4], op.play(x, radius, 0.0), atol=1e-9)


def test_play_starts_where_it_is_told_to() -> None:
    x = np.zeros(4)
    assert op.play(x, 0.5, 0.3)[0] == pytest.approx(0.3)
    assert op.play(x, 0.5, -9.0)[0] == pytest.approx(-0.5)


def test_dahl_solves_its_differential_equation() -> None:
    x = np.concatenate((np.linspace(0, 1, 200), np.linspace(1, 0.2, 160)))
    fine = np.interp(np.arange(0, x.size - 1, 0.002), np.arange(x.size), x)
    z = 0.0
    for dx in np.diff(fine):
        z += (1.0 - z * np.sign(dx)) * dx / 0.3
    assert op.dahl(x, 0.3, 0.0)[-1] == pytest.approx(z, abs=2e-3)


@settings(max_examples=30, deadline=None)
@given(signals, st.floats(0.05, 3.0))
def test_friction_states_stay_within_one(x: np.ndarray, distance: float) -> None:
    quarters = np.full(op.SLIP_ELEMENTS, 1.0 / op.SLIP_ELEMENTS)
    states = (
        op.dahl(x, distance, 0.0),
        op.jenkins(x, distance, 0.0),
        op.maxwell_slip(x, distance, 2.0, quarters, 0.0),
        op.wiped_at_reversal(x, distance, 1e-3, 0.0),
    )
    for state in states:
        assert np.all(np.abs(state) <= 1.0 + 1e-12)


def test_lag_follows_a_step_and_a_ramp_exactly() -> None:
    t = np.arange(0, 2, 0.01)
    ramp = op.lag(t, 0.01, 0.2)
    assert np.allclose(ramp, t - 0.2 * (1 - np.exp(-t / 0.2)), atol=1e-12)


def test_second_order_rings_at_its_frequency() -> None:
    t = np.arange(0, 3, 0.005)
    w, z = 2 * np.pi * 2.0, 0.1
    x = np.where(t > 0, 1.0, 0.0)
    wd = w * np.sqrt(1 - z**2)
    wanted = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    assert np.max(np.abs(op.second_order(x, 0.005, 2 * z / w, w**-2) - wanted)) < 0.04


def test_shift_delays_a_sine_but_for_the_chords_between_samples() -> None:
    t = np.arange(0, 5, 0.02)
    late = op.shift(np.sin(2 * t), 0.02, np.full(t.size, 0.137))
    assert np.max(np.abs(late[20:] - np.sin(2 * (t - 0.137))[20:])) < 0.02**2 / 8 * 4


def test_shift_is_exact_where_the_motion_is_straight_between_samples() -> None:
    t = np.arange(0, 5, 0.02)
    late = op.shift(np.maximum(t - 1.0, 0.0), 0.02, np.full(t.size, 0.137))
    assert np.allclose(late[20:], np.interp(t - 0.137, t, np.maximum(t - 1.0, 0.0))[20:], atol=1e-12)
    assert late.min() == 0.0  # no undershoot before the jump of speed


def test_overload_leaves_a_set_only_beyond_the_yield_level() -> None:
    x = np.array([0.0, 0.9, 0.0, 1.5, 0.0, 1.2, -1.4, 0.0])
    assert np.allclose(op.overload(x, 1.0), [0, 0, 0, 0.5, 0.5, 0.5, 0.1, 0.1])


@settings(max_examples=30, deadline=None)
@given(st.floats(0.05, 2.5), st.floats(-3.0, 3.0))
def test_whip_solves_its_equation_and_jumps_only_when_strong(amplitude: float, phase: float) -> None:
    theta = np.linspace(-6.0, 6.0, 1500)
    y = op.whip(theta, amplitude, phase)
    assert np.max(np.abs(y + amplitude * np.sin(y + phase) - theta)[50:]) < 1e-4
    if amplitude < 0.9:
        assert np.max(np.abs(np.diff(y))) < 0.1


def test_distance_since_reversal() -> None:
    x = np.array([0.0, 0.5, 1.0, 0.8, 0.4, 0.6, 1.4])
    assert np.allclose(op.since_reversal(x, 0.05), [0.0, 0.5, 1.0, 0.2, 0.6, 0.2, 1.0])


def test_direction_is_held_while_still() -> None:
    x = np.array([0.0, 0.2, 0.2, 0.19, 0.2, 0.0, 0.0])
    assert op.direction(x, 0.05).tolist() == [0.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0]


def test_calm_takes_noise_out_and_keeps_a_step() -> None:
    rng = np.random.default_rng(0)
    clean = np.where(np.arange(600) > 300, 1.0, 0.0)
    out = op.calm(clean + 0.05 * rng.normal(size=600), 0.05, 1.0)
    assert np.std((out - clean)[:280]) < 0.015
    assert np.max(np.abs(out - clean)[320:]) < 0.05


@pytest.mark.parametrize("sigma", [0.0, 1e-5, 0.05])
def test_smoothing_takes_noise_and_no_motion(sigma: float) -> None:
    k = np.arange(600)
    clean = np.sin(2.0 * np.pi * k / 25.0) + np.where(k > 300, 3.0, 0.0)
    noise = sigma * np.random.default_rng(0).standard_normal(600)
    off = op.smoothed(clean + noise, sigma) - clean
    assert np.std(off) <= 1.05 * sigma
    off, bend = off[20:280], np.gradient(np.gradient(clean))[20:280]
    along = abs(off @ bend) / np.sqrt(bend @ bend * off.size)
    assert along <= 0.6 * sigma  # `calm` is off by four times as much


def test_fill_bridges_missing_samples() -> None:
    assert op.fill(np.array([np.nan, 1.0, np.nan, 3.0])).tolist() == [1.0, 1.0, 2.0, 3.0]
    assert op.fill(np.full(3, np.nan)).tolist() == [0.0, 0.0, 0.0]


def test_quantum_finds_the_resolution() -> None:
    x = np.round(np.sin(np.linspace(0, 20, 3000)) / 0.01) * 0.01
    assert op.quantum(x) == pytest.approx(0.01, rel=1e-6)
    assert op.quantum(np.random.default_rng(0).normal(size=500)) == 0.0
    for seed in range(20):  # a staircase of ten random levels is none
        levels = np.random.default_rng(seed).uniform(-50.0, 50.0, 10)
        assert op.quantum(np.repeat(levels, 300)) == 0.0
    assert op.quantum(np.repeat(np.array([0.0, 1.0, 2.0, 5.0, 9.0, 30.0, 34.0]), 100)) == 1.0
