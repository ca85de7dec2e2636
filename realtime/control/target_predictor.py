"""Where the wall will be: heart beat and breath learned as rotating harmonics by Kalman filters, from late, noisy samples.

Models of the same motion run side by side and are judged by how well they foretell it (`horizon_s` ahead): a local one
(position and speed, knows no heart), a steady one (harmonics of a heart and a breath whose rates hardly change), a
restless one (the beat's rate and strength may change from beat to beat), and for slow streams of samples a phased one
(`beat_phase`: one wave, its phase among many possible). The forecast is their mean, weighted by what each has been
worth lately.
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

_RESTART_AFTER_S = 0.1  # wild samples for this long are a new truth, not outliers
_SMALLEST_M = 5e-5  # a peak lower than this is no heart
_TAKE_OVER_S = 2.0
_RANGE_m = 10.0  # nothing is further off, or wilder, than that
_MEAN_RATE_S = 5.0
_BREATHLESS = 100.0  # times the squared acceleration of a slow stream's level, while its breath is not known


@njit(cache=True)
def start(config: TargetParams, state: TargetState, stamp_ns: int, level_m: float) -> None:
    """Begin at `stamp_ns` with the wall at `level_m`; nothing is known of its motion."""
    state.started, state.time_ns, state.shot_ns = 1, stamp_ns, stamp_ns
    state.heart_found = state.breath_found = state.agreed = state.rejected = 0
    state.rejected_s = state.worse_s = state.mean_rate = state.last_heart_Hz = 0.0
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
    """The wall's position (m) `ahead_s` after the state's time: the models' forecasts by their weights."""
    value = 0.0
    for m in range(MODELS):
        if state.weight[m] > 1e-3:
            value += state.weight[m] * _position(state, m, ahead_s)
    return value


@njit(cache=True)
def _position(state: TargetState, m: int, ahead_s: float) -> float:
    """Position (m) that model `m` has `ahead_s` after (or before) the state's time."""
    value = target_models.position(state.x[m], ahead_s)
    return value + beat_phase.ahead(state.beat.moment_m, state.mean_rate, ahead_s) if m == PHASED else value


@njit(cache=True)
def _in_use(config: TargetParams, state: TargetState) -> int:
    """How many of the models, counted in their order, run now."""
    if state.heart_found == 0 and state.breath_found == 0:
        return 1
    return PHASED + 1 if config.by_phase != 0 and state.heart_found != 0 else PHASED


@njit(cache=True)
def at(state: TargetState, time_ns: int) -> float:
    """The wall's position (m) at `time_ns`; trusted for half a second past the last sample."""
    return ahead(state, min((time_ns - state.time_ns) * 1e-9, 0.5))


@njit(cache=True)
def shift(state: TargetState, by_m: float) -> None:
    """Move the wall by `by_m` in all models: it is looked for where no force can tell."""
    for m in range(MODELS):
        state.x[m, LEVEL] += by_m
        state.shot[m, LEVEL] += by_m


@njit(cache=True)
def variance_ahead(state: TargetState) -> float:
    """Variance (m2) that forecasts of `horizon_s` have had lately, noise of the samples included."""
    value = 0.0
    for m in range(MODELS):
        value += state.weight[m] * state.score_m2[m]
    return value


@njit(cache=True)
def least_score(state: TargetState) -> float:
    """Mean square (m2) that the best model's forecasts have been off the samples lately."""
    least_m2 = min(state.score_m2[LOCAL], state.score_m2[STEADY], state.score_m2[RESTLESS])
    return min(least_m2, state.score_m2[PHASED]) if state.weight[PHASED] > 0.0 else least_m2


@njit(cache=True)
def rates_Hz(state: TargetState) -> tuple[float, float]:
    """Heart and breath rate (Hz) now; 0 where not found yet."""
    best = STEADY if state.weight[STEADY] >= state.weight[RESTLESS] else RESTLESS
    heart = state.x[best, HEART_RATE] / (2.0 * math.pi) if state.heart_found else 0.0
    breath = state.x[best, BREATH_RATE] / (2.0 * math.pi) if state.breath_found else 0.0
    return heart, breath


@njit(cache=True)
def stiffer(state: TargetState) -> float:
    """By what share catheter and tissue in series are stiffer than assumed, as learned."""
    return _learned(state, STIFFNESS)


@njit(cache=True)
def play(state: TargetState) -> float:
    """By how much (m) half the play is less than believed, as learned."""
    return _learned(state, PLAY)


@njit(cache=True)
def _learned(state: TargetState, what: int) -> float:
    steady, restless = state.weight[STEADY], state.weight[RESTLESS]
    if steady + restless < 1e-6:
        return state.x[STEADY, what]
    return (steady * state.x[STEADY, what] + restless * state.x[RESTLESS, what]) / (steady + restless)


@njit(cache=True)
def credit_play(state: TargetState, part_m: float) -> None:
    """Half the believed play has been made less by `part_m`: that much is no longer to be learned."""
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
    """Bring all models up to `stamp_ns`; returns how long (s) before their time the stamp is, 0 normally."""
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
    """Take in a sample as of `stamp_ns`, of variance `noise_m2`: wall = `value_m` + stiffer * `travel_m` + play * `flank`.

    By the force: value is where the unloaded tip would be along the wall's inward normal, less assumed compliance times
    force; travel is how far the unloaded tip is from its recent mean; flank is +-1 (times the tip's motion per
    insertion) for the side of the play that was last pushed. By the pose: value is where the tip is, the others are
    zero. Samples may be up to 0.1 s older than the newest one.
    Returns ACCEPTED, REJECTED (wild: outside gate_sigma of every model, or out of any range) or NOTHING_NEW (too old).
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
    _judge(config, state, wall_m, ago_s, noise_m2)
    _listen(config, state, wall_m, dt_s)
    return ACCEPTED


@njit(cache=True)
def _judge(config: TargetParams, state: TargetState, wall_m: float, ago_s: float, noise_m2: float) -> None:
    """Compare what each model foretold `horizon_s` ago with this sample, once a horizon; renew the weights."""
    age_s = (state.time_ns - state.shot_ns) * 1e-9 - ago_s
    if age_s < config.horizon_s - 1e-4:
        return
    models = _in_use(config, state)
    if age_s < 3.0 * config.horizon_s:
        share = min(age_s / config.score_memory_s, 1.0)
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
    """The restless model's mean rate; and where it has long been the better one, the steady one starts from it."""
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
def _listen(config: TargetParams, state: TargetState, wall_m: float, dt_s: float) -> None:
    """Feed the frequency banks with means over STEP_S, and begin or renew the harmonics where they find a rate."""
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
    heart_Hz, size_m = frequency_bank.peak(state.heart_bank)
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
            _begin(state, state.heart_bank, HEART, HEART_HARMONICS, HEART_RATE, heart_Hz, size_m)
            state.heart_found, state.agreed = 1, -200
            state.mean_rate = 2.0 * math.pi * heart_Hz
    if state.heart_found and state.breath_found == 0 and state.breath_bank.since_s > 5.0:
        breath_Hz, size_m = frequency_bank.peak(state.breath_bank)
        if breath_Hz > 0.0 and size_m > _SMALLEST_M:
            _begin(state, state.breath_bank, BREATH, BREATH_HARMONICS, BREATH_RATE, breath_Hz, size_m)
            state.breath_found = 1


@njit(cache=True)
def _begin(state: TargetState, bank: Bank, first: int, count: int, rate: int, rate_Hz: float, size_m: float) -> None:
    """Open the harmonics of heart or breath in all models, as `bank` heard them: at `rate_Hz`, of about `size_m`."""
    fresh = state.heart_found == 0 and state.breath_found == 0
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
            _open(x, P, bank, first, count, rate, rate_Hz, size_m)
        x[LEVEL] += before_m - _position(state, m, 0.0)
        state.score_m2[m] = 0.5 * state.score_m2[LOCAL]


@njit(cache=True)
def _open(x: Floats, P: Matrix, bank: Bank, first: int, count: int, rate: int, rate_Hz: float, size_m: float) -> None:
    """`count` pairs from `first` on, and their rate, in one model's state and covariance."""
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
