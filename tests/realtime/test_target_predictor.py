"""The wall foretold: against holding, extrapolating and a filter that knows no heart; wild samples, drop-outs, late ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.rig_file import Rig
from realtime.control import target_predictor
from realtime.control.configure import tick_parameters
from realtime.control.records import TARGET_STATE, new
from realtime.control.target_models import BREATH_RATE, HEART_RATE, LOCAL, PLAY, STEADY, STIFFNESS, position
from sim import heart

AHEAD_S = 0.040
FORCE = {"step_ms": 1, "noise_m": 3e-5}  # the force sensor through the catheter's compliance
POSE = {"step_ms": 25, "noise_m": 2.9e-4}  # the tracker


def wall_motion(seconds: float, seed: int = 3, **changes: float) -> np.ndarray:
    """The simulated heart's displacement (m), a sample a millisecond."""
    parameters, state = heart.parameters(heart.HeartConfig(**changes)), heart.start(seed)  # type: ignore[arg-type]
    return np.array([heart.advance(parameters, state, 1e-3 * k, 1e-3) for k in range(round(seconds * 1000))])


class Run:
    """A predictor fed with noisy samples of a motion; errors are RMS (m) of what was foretold AHEAD_S ahead."""

    def __init__(
        self,
        rig: Rig,
        wall_m: np.ndarray,
        step_ms: int,
        noise_m: float,
        seed: int = 1,
        after_s: float = 8.0,
        jitter_ms: int = 0,
        lost: float = 0.0,
        by_phase: bool = True,
    ) -> None:
        parameters = tick_parameters(rig)[0]
        self.config = parameters.wall.by_force if step_ms < 10 else parameters.wall.by_pose
        self.config.by_phase = int(by_phase and step_ms >= 10)
        self.state, self.wall_m, self.noise_m = new(TARGET_STATE)[0], wall_m, noise_m
        rng = np.random.default_rng(seed)
        times = np.arange(0, len(wall_m) - 60, step_ms)
        times = times + rng.integers(0, jitter_ms + 1, len(times))
        times = times[rng.random(len(times)) >= lost]
        self.samples = wall_m[times] + noise_m * rng.standard_normal(len(times))
        self.times, foretold, local = times, [], []
        for k, value in zip(times, self.samples, strict=True):
            self.feed(int(k), value)
            foretold.append(target_predictor.ahead(self.state, AHEAD_S))
            local.append(position(self.state.x[LOCAL], AHEAD_S))
        self.kept = times > after_s * 1000
        self.truth = wall_m[times + round(AHEAD_S * 1000)]
        self.error, self.no_heart, self.holding = self._rms(foretold), self._rms(local), self._rms(self.samples)
        slope = np.diff(self.samples) / (np.diff(times) * 1e-3)
        self.extrapolated = self._rms(np.append(self.samples[0], self.samples[1:] + AHEAD_S * slope))

    def feed(self, time_ms: int, value_m: float) -> int:
        return target_predictor.apply(
            self.config, self.state, 1_000_000_000 + 1_000_000 * time_ms, value_m, 0.0, 0.0, self.noise_m**2
        )

    def _rms(self, foretold: object) -> float:
        return float(np.sqrt(np.mean((np.asarray(foretold)[self.kept] - self.truth[self.kept]) ** 2)))


@pytest.mark.parametrize("samples", [FORCE, POSE], ids=["force", "pose"])
def test_a_regular_beat_is_foretold_to_a_quarter_of_holding(rig: Rig, samples: dict) -> None:
    run = Run(rig, wall_motion(30.0 if samples is POSE else 12.0), **samples)
    assert run.error < 0.25 * run.holding
    assert run.error < 0.25 * run.no_heart and run.error < 0.25 * run.extrapolated


@pytest.mark.parametrize("beats_per_min", [40, 75, 180])
def test_rates_are_found_within_seconds(rig: Rig, beats_per_min: int) -> None:
    run = Run(rig, wall_motion(12.0, beat_Hz=beats_per_min / 60), **FORCE)
    rates_Hz = run.state.x[STEADY, (HEART_RATE, BREATH_RATE)] / (2 * np.pi)
    assert rates_Hz[0] == pytest.approx(beats_per_min / 60, rel=0.01)
    assert rates_Hz[1] == pytest.approx(0.33, rel=0.1)
    assert run.error < 0.15 * run.holding


def test_an_irregular_beat_is_foretold_to_half_of_holding(rig: Rig) -> None:
    run = Run(rig, wall_motion(20.0, irregularity=0.1, premature_share=0.05), **FORCE)
    assert run.error < 0.5 * run.holding and run.error < 0.7 * run.no_heart


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_irregular_beat_is_foretold_to_half_of_holding_by_poses(rig: Rig, seed: int) -> None:
    wall = wall_motion(40.0, seed, irregularity=0.1, premature_share=0.05)
    run, without = (Run(rig, wall, seed=seed, jitter_ms=2, lost=0.05, by_phase=phased, **POSE) for phased in (True, False))
    assert run.error < 0.5 * run.holding
    assert run.error < 0.9 * without.error
    beat = run.state.beat
    assert beat.share.min() >= 0.0 and beat.share.sum() == pytest.approx(1.0)
    assert np.hypot(*beat.wave_m[:2]) == pytest.approx(0.001, rel=0.15)


def test_the_phase_knows_any_wave(rig: Rig) -> None:
    """A second harmonic as strong as half the first is part of the learned wave."""
    run = Run(rig, wall_motion(40.0, beat_Hz=1.3, second_harmonic=0.5), **POSE)
    first, second = (float(np.hypot(*run.state.beat.wave_m[2 * h : 2 * h + 2])) for h in range(2))
    assert second == pytest.approx(0.5 * first, rel=0.2)


def test_a_change_of_rate_is_followed(rig: Rig) -> None:
    wall = np.concatenate([wall_motion(8.0, beat_Hz=1.2), wall_motion(12.0, beat_Hz=2.2)])
    run = Run(rig, wall, after_s=14.0, **FORCE)
    assert run.error < 0.25 * run.holding


def test_jitter_and_lost_samples_cost_little(rig: Rig) -> None:
    wall = wall_motion(30.0)
    clean, rough = Run(rig, wall, **POSE), Run(rig, wall, jitter_ms=8, lost=0.3, **POSE)
    assert rough.error < 2.0 * clean.error and rough.error < 0.4 * rough.holding


def test_a_still_wall_has_no_heart(rig: Rig) -> None:
    run = Run(rig, np.zeros(6000), after_s=2.0, **FORCE)
    assert run.state.heart_found == 0 and run.error < 1e-4


def test_a_wild_sample_is_refused_and_changes_nothing(rig: Rig) -> None:
    run = Run(rig, wall_motion(5.0), after_s=3.0, **FORCE)
    before = target_predictor.ahead(run.state, AHEAD_S)
    time_ms = int(run.times[-1]) + 1
    assert run.feed(time_ms, 0.010) == target_predictor.REJECTED
    assert run.feed(time_ms, np.nan) == target_predictor.REJECTED
    assert run.state.rejected == 2
    assert target_predictor.ahead(run.state, AHEAD_S - 1e-3) == pytest.approx(before, abs=1e-6)


def test_what_stays_wild_is_a_new_truth(rig: Rig) -> None:
    run = Run(rig, wall_motion(5.0), after_s=3.0, **FORCE)
    last = int(run.times[-1])
    answers = [run.feed(last + k, 0.010) for k in range(1, 400)]
    assert answers[0] == target_predictor.REJECTED and answers[-1] == target_predictor.ACCEPTED
    assert 50 < answers.count(target_predictor.REJECTED) < 250
    assert target_predictor.at(run.state, run.state.time_ns) == pytest.approx(0.010, abs=2e-3)


def test_a_sample_counts_at_the_time_it_was_taken(rig: Rig) -> None:
    """The same samples, each 20 ms after newer ones: the forecast stays as good. Older than 0.1 s they are not used."""
    wall = wall_motion(12.0)
    run, errors = Run(rig, wall[:6000], after_s=4.0, **FORCE), []
    for k in range(6000, 11000, 5):
        run.feed(k, wall[k])
        assert run.feed(k - 20, wall[k - 20]) != target_predictor.NOTHING_NEW
        errors.append(target_predictor.ahead(run.state, AHEAD_S) - wall[k + 40])
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 * run.holding
    assert run.feed(10_800, wall[10_800]) == target_predictor.NOTHING_NEW


def test_stiffness_and_play_are_learned(rig: Rig) -> None:
    """A contact 25 % softer than assumed and a play 0.4 mm narrower, while the body moves otherwise than the wall."""
    parameters, state = tick_parameters(rig)[0], new(TARGET_STATE)[0]
    wall, rng = wall_motion(12.0, irregularity=0.05), np.random.default_rng(2)
    for k in range(1, len(wall)):
        body, flank = 0.0005 * np.sin(5.5e-3 * k), 1.0 if np.cos(5.5e-3 * k) > 0.0 else -1.0
        value = wall[k] + 0.25 * body - 0.0002 * flank + 3e-5 * rng.standard_normal()
        target_predictor.apply(parameters.wall.by_force, state, 1_000_000_000 + 1_000_000 * k, value, body, flank, 9e-10)
    assert state.x[STEADY, STIFFNESS] == pytest.approx(-0.25, abs=0.03)
    assert state.x[STEADY, PLAY] == pytest.approx(0.0002, abs=0.00003)


def test_covariances_stay_covariances(rig: Rig) -> None:
    run = Run(rig, wall_motion(30.0, irregularity=0.1), **FORCE)
    for matrix in run.state.P[1:]:
        assert np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-15)
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        assert np.linalg.eigvalsh(matrix / np.outer(scale, scale)).min() > -1e-6


any_float = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=50)
@given(values=st.lists(st.tuples(any_float, any_float, any_float), min_size=1, max_size=20), step_ms=st.integers(1, 400))
def test_finite_for_any_samples(rig: Rig, values: list, step_ms: int) -> None:
    config, state = tick_parameters(rig)[0].wall.by_force, new(TARGET_STATE)[0]
    for k, (value, travel, flank) in enumerate(values):
        target_predictor.apply(config, state, 10**9 + k * step_ms * 10**6, value, travel, flank, 1e-8)
        assert np.isfinite(target_predictor.ahead(state, 0.1)) and np.all(np.isfinite(state.x))
