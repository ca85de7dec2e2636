"""Choice of the force that closes the loop: the sensor's or the estimate, which replaces a sensor that fails in contact."""

from __future__ import annotations

import math

from numba import njit

from realtime.control.codes import SOURCE_ESTIMATE, SOURCE_SENSOR
from realtime.control.constraint_frame import to_base
from realtime.control.declare import ReadFloats
from realtime.control.records import FORCE_RING, Force, ForceSourceState, Inputs, Params

# A reading above this is not plausible as a contact force.
_RANGE_N = 20.0
# After this many equal readings in a row the sensor counts as frozen: its noise is many counts.
_FROZEN = 25
# Estimates are used no older than this on arrival, and for this long after (two frames of the tracker and a margin).
_ESTIMATE_AGE_NS, _ESTIMATE_LIFE_NS = 150_000_000, 75_000_000
# Sensor and estimate are compared over _DIFFERENCE estimates. The difference is unusual when its mean square exceeds
# _DISAGREE times its usual value, which is learned over _LEARN estimates, and _LEAST_N squared.
_DIFFERENCE, _LEARN, _LEARNED, _DISAGREE, _LEAST_N = 10.0, 200.0, 30, 6.0, 0.03
# The loop returns to the sensor when it has been good for this long.
_BACK_S = 0.5
# Smoothing of estimates while contact is being detected.
_SMOOTH_S = 0.08


@njit(cache=True)
def start(params: Params, state: ForceSourceState) -> None:
    """Start, at arming, with the source of the parameters; the difference of sensor and estimate is unknown."""
    state.source = params.force_source
    state.pairs, state.bias_N, state.difference_N2, state.usual_difference_N2, state.good_s, state.smooth_N = (
        0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )


@njit(cache=True)
def _plausible(force: Force) -> bool:
    square = force.force_N[0] ** 2 + force.force_N[1] ** 2 + force.force_N[2] ** 2
    return square < _RANGE_N**2


@njit(cache=True)
def compression(force_N: ReadFloats, normal: ReadFloats) -> float:
    """Return the compression (N): force on the tissue against the wall's outward `normal` (unit, towards the tip)."""
    return -(force_N[0] * normal[0] + force_N[1] * normal[1] + force_N[2] * normal[2])


@njit(cache=True)
def _take_sensor(state: ForceSourceState, sensor: Force, normal: ReadFloats) -> bool:
    """Take in a new reading of the sensor. Return whether it is plausible."""
    if not _plausible(sensor):
        return False
    normal_N = compression(state.reading_N, normal)
    equal = normal_N == state.normal_N[SOURCE_SENSOR]
    state.equal = state.equal + 1 if equal else 0
    state.arrival_ns[SOURCE_SENSOR], state.normal_N[SOURCE_SENSOR] = sensor.arrival_ns, normal_N
    state.head = (state.head + 1) % FORCE_RING
    state.ring_ns[state.head], state.ring_N[state.head] = sensor.stamp_ns, normal_N
    return True


@njit(cache=True)
def _sensor_at(state: ForceSourceState, stamp_ns: int) -> int:
    """Return the place in the ring of the sensor's reading at `stamp_ns` (within 2 ms), or -1."""
    for k in range(FORCE_RING):
        place = (state.head - k) % FORCE_RING
        if abs(state.ring_ns[place] - stamp_ns) <= 2_000_000:
            return place
        if state.ring_ns[place] < stamp_ns:
            return -1
    return -1


@njit(cache=True)
def _take_estimate(state: ForceSourceState, estimate: Force, normal: ReadFloats, now_ns: int, touching: bool) -> bool:
    """Take in a new estimate; in contact, compare it with the sensor at its time. Return whether it is plausible."""
    noise_N2 = lasting_N2 = nominal_noise_N2 = 0.0
    for i in range(3):
        for j in range(3):
            noise_N2 += normal[i] * estimate.covariance_N2[i, j] * normal[j]
            lasting_N2 += normal[i] * estimate.lasting_covariance_N2[i, j] * normal[j]
            nominal_noise_N2 += normal[i] * estimate.nominal_covariance_N2[i, j] * normal[j]
    if not (_plausible(estimate) and 0.0 <= noise_N2 < 1e3) or now_ns - estimate.stamp_ns > _ESTIMATE_AGE_NS:
        return False
    normal_N = compression(estimate.force_N, normal)
    state.arrival_ns[SOURCE_ESTIMATE], state.normal_N[SOURCE_ESTIMATE] = estimate.arrival_ns, normal_N
    # A filter averages what scatters. The error that estimates shortly after each other share does not.
    state.noise_N2 = max(noise_N2 - lasting_N2, 1e-6)
    state.nominal_noise_N2 = max(nominal_noise_N2, 1e-6)
    state.nominal_N = compression(estimate.nominal_N, normal)
    place = _sensor_at(state, estimate.stamp_ns)
    state.estimate_stamp_ns = estimate.stamp_ns
    state.sensor_then = state.ring_N[place] if place >= 0 else math.nan
    if touching and place >= 0:
        _compare(state, normal_N - state.ring_N[place])
    return True


@njit(cache=True)
def _compare(state: ForceSourceState, difference_N: float) -> None:
    off_N = difference_N - state.bias_N if state.pairs > 0 else 0.0
    state.difference_N2 += (off_N * off_N - state.difference_N2) / _DIFFERENCE
    if unusual_difference(state):
        return
    state.pairs += 1
    state.bias_N += (difference_N - state.bias_N) / min(state.pairs, _LEARN)
    state.usual_difference_N2 += (off_N * off_N - state.usual_difference_N2) / min(max(state.pairs - 1, 1), _LEARN)


@njit(cache=True)
def unusual_difference(state: ForceSourceState) -> bool:
    """Whether sensor and estimate differ by more than usual in contact, so that nothing is learned from the pair.

    It is relative to the learned offset and noise. It does not say which of them is wrong, so it replaces neither:
    `witnesses.disagree` asks whether the difference is harmful, and then the loop holds.
    """
    return state.pairs > _LEARNED and state.difference_N2 > max(_DISAGREE * state.usual_difference_N2, _LEAST_N**2)


@njit(cache=True)
def _choose(params: Params, state: ForceSourceState, now_ns: int, touching: bool) -> bool:
    """Choose the source. Return whether it has changed."""
    if params.force_source == SOURCE_ESTIMATE or not touching:
        changed = state.source != params.force_source
        state.source = params.force_source
        return changed
    overdue = now_ns - state.arrival_ns[SOURCE_SENSOR] > params.safety.force_timeout_ns // 2
    bad = overdue or state.equal >= _FROZEN  # what a sensor shows of its own failure
    state.good_s = 0.0 if bad or unusual_difference(state) else state.good_s + params.period_s
    usable = now_ns - state.arrival_ns[SOURCE_ESTIMATE] <= _ESTIMATE_LIFE_NS and state.pairs > _LEARNED
    if state.source == SOURCE_SENSOR and bad and usable:
        state.source = SOURCE_ESTIMATE
        return True
    if state.source == SOURCE_ESTIMATE and (not usable or state.good_s > _BACK_S):
        state.source = SOURCE_SENSOR
        return True
    return False


@njit(cache=True)
def apply(
    params: Params, state: ForceSourceState, inputs: Inputs, frame_wxyz: ReadFloats, normal: ReadFloats, touching: bool
) -> int:
    """Take in the new readings of sensor and estimate, and choose the source.

    Afterwards `fresh` is 1 if the chosen source has a new reading: `stamp_ns`, `value_N` (compression), `spread_N2`.
    `force_N` (3,) and `age_from_ns` belong to the chosen source. `changed` is 1 in the tick of a handover.

    Args:
        params: parameters of the tick.
        state: the choice, and what is learned of both sources.
        inputs: newest reading and newest estimate.
        frame_wxyz: (4,), the tip's measured orientation, used if the sensor is mounted on the tip.
        normal: (3,), outward normal of the wall, unit.
        touching: whether the loop is in contact.

    Returns:
        Number of readings that were rejected.
    """
    rejected = 0
    state.new[SOURCE_SENSOR] = state.new[SOURCE_ESTIMATE] = 0
    if inputs.sensor.count != state.seen[SOURCE_SENSOR]:
        state.seen[SOURCE_SENSOR] = inputs.sensor.count
        for i in range(3):
            state.reading_N[i] = inputs.sensor.force_N[i]
        if params.sensor_on_tip != 0:
            to_base(frame_wxyz, inputs.sensor.force_N, state.reading_N)
        if _take_sensor(state, inputs.sensor, normal):
            state.new[SOURCE_SENSOR] = 1
        else:
            rejected += 1
    if inputs.estimate.count != state.seen[SOURCE_ESTIMATE]:
        state.seen[SOURCE_ESTIMATE] = inputs.estimate.count
        if _take_estimate(state, inputs.estimate, normal, inputs.now_ns, touching):
            state.new[SOURCE_ESTIMATE] = 1
        elif params.force_source == SOURCE_ESTIMATE:
            rejected += 1
    state.changed = 1 if _choose(params, state, inputs.now_ns, touching) else 0
    state.fresh = 0
    if state.source == SOURCE_SENSOR and state.new[SOURCE_SENSOR] != 0:
        _set(state, inputs.sensor, state.reading_N, state.normal_N[SOURCE_SENSOR], params.force_noise_N**2)
        state.smooth_N = state.value_N
    elif state.source == SOURCE_ESTIMATE and state.new[SOURCE_ESTIMATE] != 0:
        before_ns = state.stamp_ns
        bias_N = 0.0 if params.force_source == SOURCE_ESTIMATE else state.bias_N
        _set(state, inputs.estimate, inputs.estimate.force_N, state.normal_N[SOURCE_ESTIMATE] - bias_N, state.noise_N2)
        dt_s = min(max((state.stamp_ns - before_ns) * 1e-9, 0.0), _SMOOTH_S)
        state.smooth_N += dt_s / (dt_s + _SMOOTH_S) * (state.value_N - state.smooth_N)
    return rejected


@njit(cache=True)
def _set(state: ForceSourceState, force: Force, vector_N: ReadFloats, value_N: float, spread_N2: float) -> None:
    stamped = 0 <= force.arrival_ns - force.stamp_ns <= _ESTIMATE_AGE_NS
    state.stamp_ns = force.stamp_ns if stamped else force.arrival_ns
    state.fresh, state.value_N, state.spread_N2 = 1, value_N, spread_N2
    state.age_from_ns = force.arrival_ns
    for i in range(3):
        state.force_N[i] = vector_N[i]
