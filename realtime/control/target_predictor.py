"""Prediction of the wall's motion: Kalman filters learn heart beat and breath from delayed, noisy samples.

Up to four models of the same motion run in parallel. They are averaged with weights from their recent prediction errors
`horizon_s` ahead (model averaging):

- local: position and speed only.
- steady: harmonics of a heart beat and a breath whose rates change slowly.
- restless: rate and strength of the beat may change from beat to beat.
- phased, for slow streams of samples: one waveform and the probability of its phase (`beat_phase`).
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control import beat_phase, frequency_bank, target_models
from realtime.control.declare import Floats, Matrix
from realtime.control.frequency_bank import STEP_S
from realtime.control.records import (
    BEAT_HARMONICS,
    BEAT_RATES,
    BREATH_HARMONICS,
    HEART_HARMONICS,
    Bank,
    TargetParams,
    TargetState,
)
from realtime.control.target_models import (
    BREATH,
    BREATH_RATE,
    HEART,
    HEART_RATE,
    LEVEL,
    LOCAL,
    MODELS,
    PHASED,
    PLAY,
    RESTLESS,
    SPEED,
    STEADY,
    STIFFNESS,
    N,
)

ACCEPTED, REJECTED, NOTHING_NEW = 1, -1, 0

_RESTART_AFTER_S = 0.1  # samples rejected for this long are accepted: the wall has moved
_SMALLEST_M = 5e-5  # a peak of the spectrum below this is noise
_TAKE_OVER_S = 2.0  # the steady model restarts from a restless one that was better for this long
_RANGE_m = 10.0  # samples beyond this are not plausible
_MEAN_RATE_S = 5.0
# Errors are averaged over this share of the time since the harmonics began, but not over less than _LEAST_MEMORY_S.
_RECENT_SHARE, _LEAST_MEMORY_S = 0.4, 0.5
_BREATHLESS = 100.0  # factor of the squared acceleration of a slow stream's level while its breath is unknown


@njit(cache=True)
def start(config: TargetParams, state: TargetState, stamp_ns: int, level_m: float) -> None:
    """Start at `stamp_ns` with the wall at `level_m` and its motion unknown."""
    state.started, state.time_ns, state.shot_ns = 1, stamp_ns, stamp_ns
    state.heart_found = state.breath_found = state.agreed = state.rejected = 0
    state.rejected_s = state.worse_s = state.scored_s = state.mean_rate = state.last_heart_Hz = 0.0
    state.bank_value, state.bank_s, state.bank_n, state.noise_m2 = 0.0, 0.0, 0, 0.0
    frequency_bank.start(state.heart_bank, config.heart_min_Hz, config.heart_max_Hz, 0.8, level_m)
    frequency_bank.start(state.breath_bank, config.breath_min_Hz, config.breath_max_Hz, 3.0, level_m)
    for m in range(MODELS):
        state.score_m2[m], state.weight[m] = 1e-6, 1.0 if m == LOCAL else 0.0
        for i in range(N):
            state.x[m, i] = state.shot[m, i] = 0.0
            for j in range(N):
                state.P[m, i, j] = 0.0
        state.x[m, LEVEL] = state.shot[m, LEVEL] = level_m
        state.P[m, LEVEL, LEVEL], state.P[m, SPEED, SPEED] = 1e-6, 4e-4
        if m != LOCAL:
            state.P[m, STIFFNESS, STIFFNESS] = config.stiffness_sd**2
            state.P[m, PLAY, PLAY] = config.play_sd_m**2


@njit(cache=True)
def ahead(state: TargetState, ahead_s: float) -> float:
    """Return the wall's position (m) `ahead_s` after the state's time: the weighted mean of the models' predictions."""
    value = 0.0
    for m in range(MODELS):
        if state.weight[m] > 1e-3:
            value += state.weight[m] * _position(state, m, ahead_s)
    return value


@njit(cache=True)
def _position(state: TargetState, m: int, ahead_s: float) -> float:
    """Return the position (m) by model `m`, `ahead_s` after (or before) the state's time."""
    value = target_models.position(state.x[m], ahead_s)
    return value + beat_phase.ahead(state.beat.moment_m, state.mean_rate, ahead_s) if m == PHASED else value


@njit(cache=True)
def _in_use(config: TargetParams, state: TargetState) -> int:
    """Return the number of models that run now, counted in their order."""
    if state.heart_found == 0 and state.breath_found == 0:
        return 1
    return PHASED + 1 if config.by_phase != 0 and state.heart_found != 0 else PHASED


@njit(cache=True)
def at(state: TargetState, time_ns: int) -> float:
    """Return the wall's position (m) at `time_ns`; constant from half a second after the last sample on."""
    return ahead(state, min((time_ns - state.time_ns) * 1e-9, 0.5))


@njit(cache=True)
def shift(state: TargetState, by_m: float) -> None:
    """Move the wall by `by_m` (m) in all models, to search for it while no force is measured."""
    for m in range(MODELS):
        state.x[m, LEVEL] += by_m
        state.shot[m, LEVEL] += by_m


@njit(cache=True)
def variance_ahead(state: TargetState) -> float:
    """Return the recent variance (m2) of predictions `horizon_s` ahead, with the noise of the samples."""
    value = 0.0
    for m in range(MODELS):
        value += state.weight[m] * state.score_m2[m]
    return value


@njit(cache=True)
def least_score(state: TargetState) -> float:
    """Return the recent mean square error (m2) of the best model's predictions."""
    least_m2 = min(state.score_m2[LOCAL], state.score_m2[STEADY], state.score_m2[RESTLESS])
    return min(least_m2, state.score_m2[PHASED]) if state.weight[PHASED] > 0.0 else least_m2


@njit(cache=True)
def rates_Hz(state: TargetState) -> tuple[float, float]:
    """Return heart and breath rate (Hz) now; 0 for a rate that is not found yet."""
    best = STEADY if state.weight[STEADY] >= state.weight[RESTLESS] else RESTLESS
    heart = state.x[best, HEART_RATE] / (2.0 * math.pi) if state.heart_found else 0.0
    breath = state.x[best, BREATH_RATE] / (2.0 * math.pi) if state.breath_found else 0.0
    return heart, breath


@njit(cache=True)
def stiffer(state: TargetState) -> float:
    """Return the learned relative error of the stiffness, catheter and tissue in series; positive: stiffer than assumed."""
    return _learned(state, STIFFNESS)


@njit(cache=True)
def play(state: TargetState) -> float:
    """Return the learned error (m) of half the backlash; positive: narrower than assumed."""
    return _learned(state, PLAY)


@njit(cache=True)
def _learned(state: TargetState, what: int) -> float:
    steady, restless = state.weight[STEADY], state.weight[RESTLESS]
    if steady + restless < 1e-6:
        return state.x[STEADY, what]
    return (steady * state.x[STEADY, what] + restless * state.x[RESTLESS, what]) / (steady + restless)


@njit(cache=True)
def subtract_play(state: TargetState, part_m: float) -> None:
    """Subtract `part_m` (m) from the learned error of half the backlash, after the assumed width was corrected by it."""
    for m in (STEADY, RESTLESS):
        state.x[m, PLAY] -= part_m
        state.shot[m, PLAY] -= part_m


@njit(cache=True)
def _innovation(state: TargetState, m: int, value_m: float, travel_m: float, flank: float, ago_s: float) -> float:
    x = state.x[m]
    e, p = (stiffer(state), play(state)) if m == LOCAL else (x[STIFFNESS], x[PLAY])
    return value_m + e * travel_m + p * flank - _position(state, m, -ago_s)


@njit(cache=True)
def _spread(state: TargetState, m: int, noise_m2: float, travel_m: float, flank: float, ago_s: float) -> float:
    more_m2 = beat_phase.variance(state.beat) if m == PHASED else 0.0
    return target_models.innovation_variance(state, m, noise_m2 + more_m2, travel_m, flank, ago_s)


@njit(cache=True)
def _to_time(config: TargetParams, state: TargetState, stamp_ns: int) -> float:
    """Advance all models to `stamp_ns`. Return how long (s) the stamp is before their time, 0 normally."""
    dt_s = (stamp_ns - state.time_ns) * 1e-9
    if dt_s <= 0.0:
        return -dt_s
    target_models.propagate_local(state.x[LOCAL], state.P[LOCAL], dt_s, config.local_acceleration2)
    if state.heart_found or state.breath_found:
        level2 = config.level_acceleration_m_per_s2**2
        if config.by_phase != 0 and state.breath_found == 0:
            level2 *= _BREATHLESS
        for m in range(STEADY, _in_use(config, state)):
            rate = state.mean_rate if m == RESTLESS else state.x[m, HEART_RATE]
            target_models.propagate(state.x[m], state.P[m], state.angle, m, dt_s, rate, level2)
            if m == PHASED:
                beat_phase.propagate(state.beat, state.mean_rate, dt_s)
    state.time_ns = stamp_ns
    return 0.0


@njit(cache=True)
def apply(
    config: TargetParams, state: TargetState, stamp_ns: int, value_m: float, travel_m: float, flank: float, noise_m2: float
) -> int:
    """Take in a sample: wall = `value_m` + stiffer * `travel_m` + play * `flank`.

    Args:
        config: parameters.
        state: the models.
        stamp_ns: time of the sample, at most 0.1 s before the newest one.
        value_m: by force: depth of the free tip along the inward normal less assumed compliance times force; by pose:
            depth of the tip.
        travel_m: by force: distance of the free tip from its recent mean; by pose: 0.
        flank: by force: +1 or -1 for the side of the gap that pushed last, times the tip's motion per insertion; by
            pose: 0.
        noise_m2: variance of the sample.

    Returns:
        ACCEPTED, REJECTED (further than gate_sigma from every model, or not plausible) or NOTHING_NEW (too old).
    """
    if not (abs(value_m) < _RANGE_m and abs(travel_m) < _RANGE_m and abs(flank) < _RANGE_m and 0.0 < noise_m2 < _RANGE_m):
        state.rejected += 1
        return REJECTED
    if state.started == 0 or stamp_ns - state.time_ns > 1_000_000_000:
        start(config, state, stamp_ns, value_m)
        return ACCEPTED
    if stamp_ns < state.time_ns - 100_000_000:
        return NOTHING_NEW
    before_ns = state.time_ns
    ago_s = _to_time(config, state, stamp_ns)
    dt_s = (state.time_ns - before_ns) * 1e-9
    wild = True
    models = _in_use(config, state)
    for m in range(models):
        v = _innovation(state, m, value_m, travel_m, flank, ago_s)
        if v * v <= config.gate_sigma**2 * _spread(state, m, noise_m2, travel_m, flank, ago_s):
            wild = False
            break
    if wild:
        state.rejected += 1
        state.rejected_s += max(dt_s, 1e-4)
        if state.rejected_s < _RESTART_AFTER_S:
            return REJECTED
        for m in range(MODELS):
            v = _innovation(state, m, value_m, travel_m, flank, ago_s)
            state.P[m, LEVEL, LEVEL] += v * v
    state.rejected_s = 0.0
    for m in range(models):
        v = _innovation(state, m, value_m, travel_m, flank, ago_s)
        spread_m2 = _spread(state, m, noise_m2, travel_m, flank, ago_s)
        if m == PHASED and ago_s == 0.0:
            beat_m = value_m - target_models.position(state.x[m], 0.0)
            beat_phase.correct(state.beat, beat_m, noise_m2 + state.P[m, LEVEL, LEVEL], dt_s)
        target_models.correct(state, m, v, spread_m2)
    wall_m = value_m + stiffer(state) * travel_m + play(state) * flank
    _score(config, state, wall_m, ago_s, noise_m2)
    _find_rates(config, state, wall_m, dt_s)
    return ACCEPTED


@njit(cache=True)
def _score(config: TargetParams, state: TargetState, wall_m: float, ago_s: float, noise_m2: float) -> None:
    """Once a horizon, compare each model's prediction of `horizon_s` ago with this sample, and set the weights."""
    age_s = (state.time_ns - state.shot_ns) * 1e-9 - ago_s
    if age_s < config.horizon_s - 1e-4:
        return
    models = _in_use(config, state)
    if age_s < 3.0 * config.horizon_s:
        # While the models converge, old errors say nothing of the next ones.
        state.scored_s += age_s
        memory_s = min(max(_RECENT_SHARE * state.scored_s, _LEAST_MEMORY_S), config.score_memory_s)
        share = min(age_s / memory_s, 1.0)
        for m in range(MODELS):
            error = wall_m - target_models.position(state.shot[m], age_s)
            if m == PHASED:
                error -= beat_phase.ahead(state.beat_shot_m, state.shot_rate, age_s)
            state.score_m2[m] += share * (error * error - state.score_m2[m])
        state.noise_m2 += share * (noise_m2 - state.noise_m2)
    total = 0.0
    for m in range(MODELS):
        own_m2 = max(state.score_m2[m] - state.noise_m2, 0.05 * state.noise_m2 + 1e-12)
        state.weight[m] = 1.0 / own_m2**2 if m < models else 0.0
        total += state.weight[m]
    for m in range(MODELS):
        state.weight[m] /= total
        for i in range(N):
            state.shot[m, i] = state.x[m, i]
    state.shot_ns, state.shot_rate = state.time_ns, state.mean_rate
    for j in range(BEAT_RATES):  # elementwise: an array assigned to another may be copied first
        for h in range(BEAT_HARMONICS):
            for k in range(2):
                state.beat_shot_m[j, h, k] = state.beat.moment_m[j, h, k]
    if models > 1:
        _settle_rates(state, age_s)


@njit(cache=True)
def _settle_rates(state: TargetState, dt_s: float) -> None:
    """Follow the restless model's mean rate; restart the steady model from it when it has been better for _TAKE_OVER_S."""
    state.mean_rate += min(dt_s / _MEAN_RATE_S, 1.0) * (state.x[RESTLESS, HEART_RATE] - state.mean_rate)
    worse = state.score_m2[RESTLESS] < 0.5 * state.score_m2[STEADY]
    state.worse_s = state.worse_s + dt_s if worse else 0.0
    if state.worse_s < _TAKE_OVER_S:
        return
    state.worse_s = 0.0
    for i in range(N):
        state.x[STEADY, i] = state.x[RESTLESS, i]
        for j in range(N):
            state.P[STEADY, i, j] = state.P[RESTLESS, i, j]
    state.x[STEADY, HEART_RATE] = state.mean_rate


@njit(cache=True)
def _find_rates(config: TargetParams, state: TargetState, wall_m: float, dt_s: float) -> None:
    """Feed the frequency banks with means over STEP_S, and start the harmonics of a rate that they find."""
    state.bank_value += wall_m
    state.bank_s += dt_s
    state.bank_n += 1
    if state.bank_s < STEP_S:
        return
    mean_m, step_s = state.bank_value / state.bank_n, state.bank_s
    state.bank_value, state.bank_s, state.bank_n = 0.0, 0.0, 0
    frequency_bank.apply(state.heart_bank, mean_m, step_s)
    frequency_bank.apply(state.breath_bank, mean_m, step_s)
    if state.heart_bank.since_s < 1.0:
        return
    heart_Hz, size_m = frequency_bank.peak(state.heart_bank, False)
    steady = heart_Hz > 0.0 and abs(heart_Hz - state.last_heart_Hz) < 0.003 * heart_Hz * step_s / STEP_S
    state.agreed = state.agreed + 1 if steady and size_m > _SMALLEST_M else 0
    state.last_heart_Hz = heart_Hz
    long_enough = state.heart_bank.since_s * heart_Hz > 1.5
    if state.agreed >= 5 and long_enough:
        lost = state.heart_found == 0 or (
            abs(state.mean_rate - 2.0 * math.pi * heart_Hz) > 0.15 * state.mean_rate
            and state.score_m2[LOCAL] < 1.2 * min(state.score_m2[STEADY], state.score_m2[RESTLESS])
        )
        if lost:
            _start_harmonics(state, state.heart_bank, HEART, HEART_HARMONICS, HEART_RATE, heart_Hz, size_m)
            state.heart_found, state.agreed = 1, -200
            state.mean_rate = 2.0 * math.pi * heart_Hz
    if state.heart_found and state.breath_found == 0 and state.breath_bank.since_s > 5.0:
        # By force the drift of the mean is small: there, speed helped on no run and cost 1 mN on an irregular beat.
        breath_Hz, size_m = frequency_bank.peak(state.breath_bank, config.by_phase != 0)
        if breath_Hz > 0.0 and size_m > _SMALLEST_M:
            _start_harmonics(state, state.breath_bank, BREATH, BREATH_HARMONICS, BREATH_RATE, breath_Hz, size_m)
            state.breath_found = 1


@njit(cache=True)
def _start_harmonics(
    state: TargetState, bank: Bank, first: int, count: int, rate: int, rate_Hz: float, size_m: float
) -> None:
    """Start the harmonics of heart or breath in all models: at `rate_Hz` (Hz), amplitude about `size_m` (m), from `bank`."""
    fresh = state.heart_found == 0 and state.breath_found == 0
    state.scored_s = 0.0
    for m in (STEADY, RESTLESS, PHASED):
        x, P = state.x[m], state.P[m]
        before_m = _position(state, m, 0.0)
        if fresh:
            before_m, x[SPEED] = state.x[LOCAL, LEVEL], 0.0
            for j in range(N):
                P[LEVEL, j] = P[j, LEVEL] = P[SPEED, j] = P[j, SPEED] = 0.0
        P[LEVEL, LEVEL] += size_m**2
        P[SPEED, SPEED] += (2.0 * math.pi * rate_Hz * size_m if rate == BREATH_RATE else 0.3 * size_m) ** 2
        if m == PHASED and rate == HEART_RATE:
            beat_phase.start(state.beat, *frequency_bank.pair(bank, rate_Hz))
        else:
            _start_pairs(x, P, bank, first, count, rate, rate_Hz, size_m)
        x[LEVEL] += before_m - _position(state, m, 0.0)
        state.score_m2[m] = 0.5 * state.score_m2[LOCAL]


@njit(cache=True)
def _start_pairs(x: Floats, P: Matrix, bank: Bank, first: int, count: int, rate: int, rate_Hz: float, size_m: float) -> None:
    """Start `count` pairs from index `first` on, and their rate, in one model's state and covariance."""
    for i in range(first, first + 2 * count):
        x[i] = 0.0
        for j in range(N):
            P[i, j] = P[j, i] = 0.0
        P[i, i] = (0.7 * size_m / (1 + (i - first) // 2)) ** 2
    x[first], x[first + 1] = frequency_bank.pair(bank, rate_Hz)
    for j in range(N):
        P[rate, j] = P[j, rate] = 0.0
    x[rate] = 2.0 * math.pi * rate_Hz
    P[rate, rate] = ((0.05 if rate == HEART_RATE else 0.15) * x[rate]) ** 2
