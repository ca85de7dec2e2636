"""Three witnesses of one contact force: the sensor, the model's estimate, and the geometry of the tip.

The loop works with one force source. This block compares all of them from arming on, in every phase, so that no single
wrong source can press unseen:

- sensor: the newest reading,
- estimate: the model process' answer, by the stiffness of the catheter's file; for too much force also by the adapted
  one, whichever is greater,
- geometry: the distance by which the measured tip stays behind the free tip of the kinematics, along the inward normal,
  since the catheter was last free, over the compliance of the rig file. It needs neither of the others. While the loop's
  force shows a contact, a turn about the sheath's axis is left out: there the shaft yields by its windup, which the
  compliance does not describe.

Sensor and estimate are compared at the estimate's time, so that a beating wall cancels. Geometry is too coarse to prove
a small force (1 mm is 0.1 N); it says which of two that disagree is the wrong one, and it limits how far the free tip is
driven.
"""

from __future__ import annotations

import math

from numba import njit

from realtime.control import free_tip, inverse_kinematics
from realtime.control.codes import PHASE_APPROACH, PHASE_HOLD, PHASE_POSITION, SOURCE_ESTIMATE, SOURCE_SENSOR
from realtime.control.constraint_frame import dot
from realtime.control.declare import ReadFloats
from realtime.control.records import ForceSourceState, Inputs, Params, WitnessState

# Averages: of the sensor, of the estimate (two frames of the tracker), of their difference, of the tip's deflection.
_SENSOR_S, _ESTIMATE_S, _DIFFERENCE_S, _DEFLECTION_S = 0.01, 0.06, 0.15, 0.06
# The free tip's distance from the measured one is learned over this time in free space, and known after a third of it.
_REFERENCE_S = 1.0
# Sensor and estimate disagree when their averaged difference exceeds this many standard deviations of the estimate, and
# at least _LEAST_N, which covers the sensor's zero.
_SIGMAS, _LEAST_N = 1.5, 0.08
# In an approach without a fault the tip was at most 1.7 mm behind the free tip before the contact was noticed (30 drawn
# rigs). Beyond this limit the wall holds the tip back and the force does not show it. A catheter that is driven on bends
# back, and pulling it out then raises the force above 1 N.
_UNSEEN_m = 0.004
# A disagreement that stands this long cannot be decided by waiting.
_UNDECIDED_S = 0.3
# Above this a witness says that something presses on the tip; the estimate by this beyond twice its standard deviation.
PRESSED_N = 0.05
# A witness this old says nothing.
_FRESH_NS = 200_000_000
# The least plausible stiffness of a catheter, relative to the rig file's: bent far back it is a fifth (0.29 N at 11 mm).
# A force that is above the limit even then is too much.
_LEAST_STIFFNESS = 0.2
# The estimate alone proves too much force when it is this many standard deviations above the limit.
_OVER_SIGMAS = 1.5
# A stopped catheter is retracted again above this share of the greatest force, for so long: a heart that moves nearer by
# 8 mm/s raises the force by 4 N/s, and the insertion needs 90 ms to cross its backlash.
_STANDING_SHARE, _STANDING_S = 0.3, 0.01


@njit(cache=True)
def start(state: WitnessState) -> None:
    """Reset the state to unknown; for arming."""
    state.sensor_N = state.estimate_N = state.estimate_sd_N = state.difference_N = 0.0
    state.geometry_N = state.reference_m = state.deflection_m = state.reference_s = 0.0
    state.differ_s = state.pressed_s = 0.0
    state.pairs = 0


@njit(cache=True)
def _share(dt_s: float, memory_s: float) -> float:
    return 1.0 - math.exp(-dt_s / memory_s)


@njit(cache=True)
def take_forces(state: WitnessState, force: ForceSourceState, period_s: float) -> None:
    """Process the readings that `force_source` has accepted in this tick; `force.new` marks the new ones."""
    if force.new[SOURCE_SENSOR] != 0:
        state.sensor_N += _share(period_s, _SENSOR_S) * (force.normal_N[SOURCE_SENSOR] - state.sensor_N)
    if force.new[SOURCE_ESTIMATE] == 0:
        return
    dt_s = min(max((force.estimate_stamp_ns - state.estimate_ns) * 1e-9, 0.0), 0.1)
    state.estimate_ns = force.estimate_stamp_ns
    # An adapted stiffness may be wrong: it is not let lower what the estimate says of too much force, and of the forces by
    # both stiffnesses the one that is further from the sensor is compared with it.
    state.estimate_sd_N = math.sqrt(force.nominal_noise_N2)
    greatest_N = max(force.normal_N[SOURCE_ESTIMATE], force.nominal_N)
    state.estimate_N += _share(dt_s, _ESTIMATE_S) * (greatest_N - state.estimate_N)
    if force.sensor_then == force.sensor_then:  # a reading of the sensor at the estimate's time, else NaN
        state.pairs += 1
        difference_N, adapted_N = force.nominal_N - force.sensor_then, force.normal_N[SOURCE_ESTIMATE] - force.sensor_then
        if abs(adapted_N) > abs(difference_N):
            difference_N = adapted_N
        share = max(_share(dt_s, _DIFFERENCE_S), 1.0 / state.pairs)
        state.difference_N += share * (difference_N - state.difference_N)


@njit(cache=True)
def take_pose(
    params: Params, state: WitnessState, inputs: Inputs, joint: ReadFloats, normal: ReadFloats, phase: int, felt: bool
) -> None:
    """Process an accepted pose with the joints (3,) at its time: compute the distance from the free tip to the tip.

    felt: whether the loop's force shows a contact.
    """
    roll_rad = joint[1]
    if felt:
        roll_rad = inverse_kinematics.roll_of(params.kinematics, inputs.tip.position_m, roll_rad)
    free_m = free_tip.apply(params.kinematics, (joint[0], roll_rad, joint[2]))
    behind_m = dot(inputs.tip.position_m, normal) - dot(free_m, normal)
    dt_s = min(max((inputs.tip.stamp_ns - state.pose_ns) * 1e-9, 0.0), 0.1)
    state.pose_ns = inputs.tip.stamp_ns
    if (phase == PHASE_HOLD or phase == PHASE_POSITION) and not pressed(state, inputs):
        state.reference_s = min(state.reference_s + dt_s, _REFERENCE_S)
        state.reference_m += dt_s / max(state.reference_s, dt_s + 1e-9) * (behind_m - state.reference_m)
    state.deflection_m += _share(dt_s, _DEFLECTION_S) * (behind_m - state.reference_m - state.deflection_m)
    known = state.reference_s > _REFERENCE_S / 3.0
    state.geometry_N = max(state.deflection_m / params.wall.compliance_m_per_N, 0.0) if known else 0.0


@njit(cache=True)
def pressed(state: WitnessState, inputs: Inputs) -> bool:
    """Whether a fresh witness says that the tip presses on something."""
    by_sensor = inputs.now_ns - inputs.sensor.arrival_ns < _FRESH_NS and state.sensor_N > PRESSED_N
    by_estimate = (
        inputs.now_ns - inputs.estimate.arrival_ns < _FRESH_NS and state.estimate_N > PRESSED_N + 2.0 * state.estimate_sd_N
    )
    return by_sensor or by_estimate


@njit(cache=True)
def _sources_differ(state: WitnessState, inputs: Inputs) -> bool:
    """Whether sensor and estimate differ by more than their uncertainty."""
    fresh = inputs.now_ns - inputs.sensor.arrival_ns < _FRESH_NS and inputs.now_ns - inputs.estimate.arrival_ns < _FRESH_NS
    limit_N = max(_SIGMAS * state.estimate_sd_N, _LEAST_N)
    return fresh and state.pairs >= 3 and abs(state.difference_N) > limit_N


@njit(cache=True)
def _is_unseen(params: Params, state: WitnessState, phase: int) -> bool:
    """Whether the tip is held back in an approach, which means that the loop's force shows no contact."""
    return phase == PHASE_APPROACH and state.geometry_N * params.wall.compliance_m_per_N > _UNSEEN_m


@njit(cache=True)
def disagree(params: Params, state: WitnessState, inputs: Inputs, phase: int) -> int:
    """Compare the witnesses: 0 they agree or one is missing, 1 they disagree, 2 for so long that it is decided."""
    if not (_sources_differ(state, inputs) or _is_unseen(params, state, phase)):
        state.differ_s = 0.0
        return 0
    state.differ_s += params.period_s
    return 2 if state.differ_s > _UNDECIDED_S else 1


@njit(cache=True)
def over(params: Params, state: WitnessState, force: ForceSourceState, inputs: Inputs) -> bool:
    """Whether any witness proves more than the greatest force."""
    limit_N = params.safety.over_force_N
    if inputs.now_ns - force.arrival_ns[SOURCE_SENSOR] <= params.safety.stop_after_ns:
        reading = force.reading_N
        if math.sqrt(reading[0] ** 2 + reading[1] ** 2 + reading[2] ** 2) > limit_N:
            return True
    if inputs.now_ns - force.arrival_ns[SOURCE_ESTIMATE] <= params.safety.stop_after_ns:
        if state.estimate_N - _OVER_SIGMAS * state.estimate_sd_N > limit_N:
            return True
    return _LEAST_STIFFNESS * state.geometry_N > limit_N


@njit(cache=True)
def standing(params: Params, state: WitnessState, inputs: Inputs, period_s: float) -> bool:
    """Whether something has pressed on a stopped catheter for _STANDING_S: a wall that comes nearer presses harder.

    The sensor or the estimate says so, each alone, beyond _STANDING_SHARE of the greatest force.
    """
    limit_N = _STANDING_SHARE * params.safety.over_force_N
    by_sensor = inputs.now_ns - inputs.sensor.arrival_ns < _FRESH_NS and state.sensor_N > limit_N
    by_estimate = (
        inputs.now_ns - inputs.estimate.arrival_ns < _FRESH_NS and state.estimate_N - 2.0 * state.estimate_sd_N > limit_N
    )
    if not (by_sensor or by_estimate):
        state.pressed_s = 0.0
        return False
    state.pressed_s += period_s
    return state.pressed_s > _STANDING_S
