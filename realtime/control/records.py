"""The records that cross the tick: parameters, state, inputs, outputs.

Every field is declared once: here, or in the message that carries its value (`carried_by`, `protocol.topics`).
"""

from __future__ import annotations

import numpy as np

from protocol.topics import ForceSensor, Pose, RigState
from realtime.control.declare import Floats, Ints, Matrix, Tensor, as_markdown, carried_by, dtype_of, part, real, whole

N_AXES = 3
CURVE_POINTS = 129
# The wall's motion: harmonics of heart and breath, and four models of the same motion.
HEART_HARMONICS, BREATH_HARMONICS = 3, 2
TARGET_N = 2 + 2 * (HEART_HARMONICS + BREATH_HARMONICS) + 4
TARGET_MODELS = 4
BANK_POINTS = 24
# Cells of the distal shaft with a tension of the pull-wire each.
WIRE_CELLS = 5
# The grid of `beat_phase`.
BEAT_PHASES, BEAT_RATES, BEAT_HARMONICS = 48, 15, 3
# Readings of the force sensor that are kept for a comparison with a late estimate.
FORCE_RING = 96
# Predicted joints that are kept for late poses and estimates.
HISTORY_POINTS = 192


# --- inputs ---


class PoseRecord:
    """A tracker pose, in the base frame."""

    count: int = whole("", "count of poses")
    stamp_ns: int = whole("ns", "time of measurement")
    arrival_ns: int = carried_by(Pose, "arrival_ns")
    position_m: Floats = carried_by(Pose, "position_m")
    quaternion_wxyz: Floats = carried_by(Pose, "quaternion_wxyz")


class Force:
    """A force on the tissue, in the base frame: the sensor's reading, or the model's estimate."""

    count: int = whole("", "count of readings")
    stamp_ns: int = whole("ns", "time of measurement; for an estimate, that of its pose")
    arrival_ns: int = whole("ns", "time of arrival")
    force_N: Floats = carried_by(ForceSensor, "force_N")
    covariance_N2: Matrix = real("N^2", "covariance of an estimate; zero for the sensor", 3, 3)
    lasting_covariance_N2: Matrix = real("N^2", "its part that estimates shortly after each other share", 3, 3)
    nominal_N: Floats = real("N", "an estimate's force without adaptation of the stiffness; zero for the sensor", 3)
    nominal_covariance_N2: Matrix = real("N^2", "covariance of that force; zero for the sensor", 3, 3)


class BoardRecord:
    """The stepper board's newest status."""

    count: int = whole("", "count of statuses")
    arrival_ns: int = whole("ns", "time of arrival")
    mcu_offset_ns: int = whole("ns", "rig's clock minus the board's clock")
    position_steps: Ints = whole("steps", "steps made, by axis", N_AXES)
    encoder_counts: Ints = whole("counts", "encoder, by axis", N_AXES)
    state: int = whole("", "a BoardState; FAULT also after a reset")
    fault: int = whole("", "the board's fault code, 0 for none")
    ready: int = whole("", "1 when the board takes set-points")


class CommandRecord:
    """Command of the operator, and causes from the supervision."""

    count: int = whole("", "count of commands that the loop has to carry out")
    kind: int = whole("", "a CommandKind")
    armed: int = whole("", "1 when the loop is to be armed")
    target_m: Floats = real("m", "requested tip position", 3)
    normal: Floats = real("", "outward normal of the wall, unit, towards the tip", 3)
    force_N: float = real("N", "requested force along the inward normal")
    jog_axis: int = whole("", "a JogAxis: what a jog moves")
    jog_direction: Floats = real("", "unit vector along which a jog moves the tip, base frame", 3)
    jog_travel: float = real("m, rad", "length of a jog")
    jog_speed: float = real("m/s, rad/s", "speed of a jog")
    clear: int = whole("", "count of the operator's clear commands")
    watch: int = whole("", "causes that the supervision found, a bit set of `safety.CAUSES`")


class Inputs:
    """All inputs of the tick."""

    now_ns: int = whole("ns", "time of this tick")
    tip: PoseRecord = part(PoseRecord, "newest pose of the tip")
    shaft: PoseRecord = part(PoseRecord, "newest pose of the shaft")
    sensor: Force = part(Force, "newest reading of the force sensor")
    estimate: Force = part(Force, "newest converged estimate")
    board: BoardRecord = part(BoardRecord, "newest status of the board")
    command: CommandRecord = part(CommandRecord, "newest command")


# --- parameters and state of the control blocks ---


class PredictorParams:
    """Tip predictor (`predictor`)."""

    acceleration_noise_m_per_s2: float = real("m/s^2", "white acceleration of the tip, per square root of Hz")
    position_noise_m: float = real("m", "noise of the tracker, standard deviation")
    max_speed_m_per_s: float = real("m/s", "largest plausible speed of the tip")
    gate_sigma: float = real("", "limit for the rejection of poses, in standard deviations")
    workspace_min_m: Floats = real("m", "lowest plausible position", 3)
    workspace_max_m: Floats = real("m", "highest plausible position", 3)


class PredictorState:
    """Tip predictor (`predictor`)."""

    started: int = whole("", "1 after the first accepted pose")
    seen: int = whole("", "count of the newest pose that was processed")
    stamp_ns: int = whole("ns", "time of measurement of the newest accepted pose")
    accepted_ns: int = whole("ns", "time of arrival of the newest accepted pose")
    position_m: Floats = real("m", "filtered position at stamp_ns", 3)
    velocity_m_per_s: Floats = real("m/s", "filtered velocity at stamp_ns", 3)
    quaternion_wxyz: Floats = real("", "orientation of the newest accepted pose", 4)
    p00: float = real("m^2", "variance of the position, each axis")
    p01: float = real("m^2/s", "covariance of position and velocity")
    p11: float = real("m^2/s^2", "variance of the velocity")
    rejected: int = whole("", "poses rejected since the start; only for telemetry")
    rejected_in_row: int = whole("", "poses rejected since the last accepted one")


class Bank:
    """Leaky Fourier sums on a grid of frequencies (`frequency_bank`)."""

    low_Hz: float = real("Hz", "lowest frequency of the grid")
    high_Hz: float = real("Hz", "highest frequency of the grid")
    memory_s: float = real("s", "time constant of each sum")
    since_s: float = real("s", "signal seen since the start")
    level: float = real("m", "mean of the signal")
    phase_rad: Floats = real("rad", "phase of each grid point", BANK_POINTS)
    first: Matrix = real("m", "first sum, cosine and sine", BANK_POINTS, 2)
    second: Matrix = real("m", "second sum, cosine and sine", BANK_POINTS, 2)


class Beat:
    """Phase and wave of an uneven heart (`beat_phase`)."""

    share: Matrix = real("", "probability of each phase and rate", BEAT_PHASES, BEAT_RATES)
    moved: Matrix = real("", "these probabilities during propagation; scratch", BEAT_PHASES, BEAT_RATES)
    wave_m: Floats = real("m", "harmonics of the wave, cosine and sine", 2 * BEAT_HARMONICS)
    projected_m: Floats = real("m", "right side of the wave's normal equations", 2 * BEAT_HARMONICS)
    information: Matrix = real("", "left side of the wave's normal equations", 2 * BEAT_HARMONICS, 2 * BEAT_HARMONICS)
    factor: Matrix = real("", "Cholesky factor of `information`; scratch", 2 * BEAT_HARMONICS, 2 * BEAT_HARMONICS)
    moment_m: Tensor = real("m", "moments by rate and harmonic, cosine and sine", BEAT_RATES, BEAT_HARMONICS, 2)


class TargetParams:
    """Predictor of the wall (`target_predictor`) for one kind of sample."""

    by_phase: int = whole("", "1 to run the phased model, for slow streams of samples")
    horizon_s: float = real("s", "horizon at which predictions are scored")
    gate_sigma: float = real("", "limit for the rejection of samples, in standard deviations of every model")
    stiffness_sd: float = real("", "standard deviation of the relative error of the stiffness at first")
    play_sd_m: float = real("m", "standard deviation of the error of half the backlash at first")
    level_acceleration_m_per_s2: float = real("m/s^2", "drift of the level, per square root of Hz")
    local_acceleration2: float = real("m^2/s^3", "squared acceleration of the local model")
    score_memory_s: float = real("s", "time constant of the models' scores")
    heart_min_Hz: float = real("Hz", "slowest heart")
    heart_max_Hz: float = real("Hz", "fastest heart")
    breath_min_Hz: float = real("Hz", "slowest breath")
    breath_max_Hz: float = real("Hz", "fastest breath")


class TargetState:
    """Predictor of the wall (`target_predictor`)."""

    started: int = whole("", "1 after the first sample")
    time_ns: int = whole("ns", "time of the states")
    x: Matrix = real("m", "state of each model, in the order of `target_models`", TARGET_MODELS, TARGET_N)
    P: Tensor = real("m^2", "covariance of each model", TARGET_MODELS, TARGET_N, TARGET_N)
    score_m2: Floats = real("m^2", "mean square error of each model's predictions", TARGET_MODELS)
    weight: Floats = real("", "weight of each model in the mean", TARGET_MODELS)
    noise_m2: float = real("m^2", "mean variance of the samples")
    scored_s: float = real("s", "time for which predictions were scored since the harmonics began")
    shot_ns: int = whole("ns", "time of the states that are being scored")
    shot: Matrix = real("m", "states that are being scored", TARGET_MODELS, TARGET_N)
    heart_found: int = whole("", "1 once the heart's rate is known")
    breath_found: int = whole("", "1 once the breath's rate is known")
    mean_rate: float = real("rad/s", "mean rate of the heart")
    worse_s: float = real("s", "time for which the restless model has been the better one")
    bank_value: float = real("m", "sum of the samples for the banks")
    bank_s: float = real("s", "time span of these samples")
    bank_n: int = whole("", "number of these samples")
    heart_bank: Bank = part(Bank, "search for the heart's rate")
    breath_bank: Bank = part(Bank, "search for the breath's rate")
    last_heart_Hz: float = real("Hz", "the bank's peak at the last check")
    agreed: int = whole("", "checks in a row with the same peak; negative: wait")
    rejected: int = whole("", "samples rejected since the start; only for telemetry")
    rejected_s: float = real("s", "time for which samples have been rejected in a row")
    beat: Beat = part(Beat, "the phased model's beat")
    beat_shot_m: Tensor = real("m", "moments of the phased model that are being scored", BEAT_RATES, BEAT_HARMONICS, 2)
    shot_rate: float = real("rad/s", "the mean rate that is being scored")
    row: Floats = real("", "measurement row; scratch", TARGET_N)
    cross: Floats = real("m^2", "covariance times row; scratch", TARGET_N)
    angle: Matrix = real("", "cosine and sine by which each harmonic turned; scratch", HEART_HARMONICS + BREATH_HARMONICS, 2)


class ForcePredictorParams:
    """Prediction of the force for the thesis' law (`force_predictor`)."""

    acceleration_noise_N_per_s2: float = real("N/s^2", "white second derivative of the force, per square root of Hz")
    rate_sd_N_per_s: float = real("N/s", "rate of the force at the first reading, standard deviation")


class ForcePredictorState:
    """Prediction of the force for the thesis' law (`force_predictor`)."""

    started: int = whole("", "1 after the first reading")
    stamp_ns: int = whole("ns", "time of measurement of the newest reading")
    force_N: float = real("N", "filtered compression at stamp_ns")
    rate_N_per_s: float = real("N/s", "its rate")
    p00: float = real("N^2", "variance of the force")
    p01: float = real("N^2/s", "covariance of force and rate")
    p11: float = real("N^2/s^2", "variance of the rate")


class StageParams:
    """Stages (`stage_limiter`); units are m or rad, by axis."""

    steps_per_unit: Floats = real("steps/unit", "steps for one m or rad", N_AXES)
    max_speed: Floats = real("unit/s", "speed limit", N_AXES)
    max_accel: Floats = real("unit/s^2", "acceleration limit", N_AXES)
    min_unit: Floats = real("unit", "lower end of the travel", N_AXES)
    max_unit: Floats = real("unit", "upper end of the travel", N_AXES)


class StageState:
    """Stages (`stage_limiter`); units are m or rad, by axis."""

    position: Floats = real("unit", "commanded position", N_AXES)
    speed: Floats = real("unit/s", "commanded speed", N_AXES)


class BacklashParams:
    """Backlash of the insertion and slope of the roll (`backlash`)."""

    width_m: float = real("m", "width of the gap, from the rig file")
    caution_m: float = real("m", "reduction of the assumed width at the start")
    slope: float = real("", "body insertion per handle insertion")
    threshold_m: float = real("m", "motion back that counts as a reversal")
    roll_slope: float = real("", "distal roll per handle roll")


class BacklashState:
    """Backlash of the insertion (`backlash`)."""

    direction: float = real("", "+1 or -1: side of the gap that is to push")
    extreme_m: float = real("m", "furthest body insertion in this direction")
    body_m: float = real("m", "predicted body insertion, relative to home")
    flank: float = real("", "+1 or -1: side of the gap that pushed last")
    width_m: float = real("m", "width of the gap, as learned")


class WireParams:
    """Friction of the pull-wire (`wire_friction`)."""

    friction: float = real("", "coefficient of friction mu between wire and sheath; 0: none")
    turning_rad: float = real("rad", "total bend of the body between handle and distal shaft")
    distal_length_m: float = real("m", "length of the part that bends")
    wire_share: float = real(
        "", "of the path at the knob that stretches the wire; 1: the knob sets the tension; 0: the bend"
    )


class WireState:
    """Friction of the pull-wire (`wire_friction`)."""

    direction: float = real("", "+1 or -1: direction in which the curvature is to change")
    extreme_per_m: float = real("1/m", "furthest requested curvature in this direction")
    curvature_per_m: float = real("1/m", "predicted unloaded curvature")
    side: float = real("", "+1 or -1: wire that is pulled")
    tension: Floats = real("1/m", "tension of each cell of the distal shaft: the curvature that it gives", WIRE_CELLS)


class KinematicsParams:
    """Unloaded catheter (`inverse_kinematics`, `free_tip`)."""

    distal_length_m: float = real("m", "length of the part that bends")
    insertion_at_home_m: float = real("m", "distal insertion with the handle at home")
    max_curvature_per_m: float = real("1/m", "greatest curvature")
    axis_radius_m: float = real("m", "distance from the axis below which the roll is held")
    knob_of_curvature_rad: Floats = real("rad", "knob over a uniform grid of curvatures", CURVE_POINTS)


class HybridParams:
    """The thesis' law (`hybrid`), and the threshold of contact."""

    position_gain_per_s: float = real("1/s", "proportional gain of the joint loop")
    position_integral_per_s2: float = real("1/s^2", "integral gain of the joint loop")
    force_gain_m_per_N: float = real("m/N", "proportional gain of the force loop")
    force_integral_m_per_N_s: float = real("m/(N s)", "integral gain of the force loop")
    approach_speed_m_per_s: float = real("m/s", "speed of the goal without contact")
    contact_force_N: float = real("N", "force that counts as contact")
    from_desired: int = whole("", "1: the force loop's displacement is added to the desired position; 0: to the present tip")
    pi_form: int = whole("", "1: joints follow K_p e + K_i sum(e); 0: they are moved by it (incremental form)")
    joint_gain: float = real("", "K_p of the PI form")
    joint_integral_per_s: float = real("1/s", "K_i of the PI form")


class HybridState:
    """Joint command and goal, and the integrators of the thesis' law."""

    joint: Floats = real("m, rad, rad", "joint command: insertion, roll, knob", N_AXES)
    integral: Floats = real("m s, rad s", "integral of the joint error", N_AXES)
    last_error: Floats = real("m, rad, rad", "joint error of the last tick, PI form", N_AXES)
    has_last: int = whole("", "1 when last_error is that of the last tick")
    force_integral_N_s: float = real("N s", "integral of the force error")
    goal_m: Floats = real("m", "moving goal of the tip", 3)
    above_ns: int = whole("ns", "time since which the force has been beyond its threshold; 0: it is not")


class JogState:
    """A jog in progress (`jog`)."""

    left: float = real("m, rad", "remaining way")
    target_m: Floats = real("m", "where a jog of the tip ends", 3)
    least_force_N: float = real("N", "least force since the jog began")


class TipOffsetParams:
    """Learning of the tip's offset (`tip_offset`)."""

    free_memory_s: float = real("s", "time constant in free space")
    contact_memory_s: float = real("s", "time constant in contact")


class TipOffsetState:
    """Learned difference between the tip and the model's free tip (`tip_offset`)."""

    offset_m: Floats = real("m", "measured tip minus the model's free tip", 3)
    touch_offset_m: Floats = real("m", "the offset when contact began", 3)
    learned_s: float = real("s", "time learned from so far, up to the time constant")
    stamp_ns: int = whole("ns", "time of measurement of the newest pose that was learned from")
    insertion_error_m: float = real("m", "predicted insertion minus the insertion that explains the poses")
    insertion_learned_s: float = real("s", "time that the insertion was learned from, up to its time constant")


class RollWindupState:
    """By how much a force across turns the tip about the sheath's axis (`roll_windup`)."""

    windup_rad: float = real("rad", "roll of the tip minus that of the handle, scaled by the slope")
    torque_Nm: float = real("N m", "torque of the contact force about the sheath's axis, averaged as the windup is")
    stamp_ns: int = whole("ns", "when the newest pose was measured")


class WallParams:
    """Observation of the wall by force and by pose (`wall_observer`)."""

    compliance_m_per_N: float = real("m/N", "assumed compliance of catheter and tissue in series")
    play_noise_m: float = real("m", "error after backlash compensation, standard deviation")
    position_noise_m: float = real("m", "noise of the tracker, standard deviation")
    by_force: TargetParams = part(TargetParams, "predictor fed by the force sensor")
    by_estimate: TargetParams = part(TargetParams, "predictor fed by estimates of the force")
    by_pose: TargetParams = part(TargetParams, "predictor fed by the tip's poses")


class WallState:
    """Observation of the wall (`wall_observer`)."""

    force: TargetState = part(TargetState, "the wall by its force")
    pose: TargetState = part(TargetState, "the wall by the tip's poses")
    compliance_m_per_N: float = real("m/N", "compliance of catheter and tissue in series, in use")
    mean_depth_m: float = real("m", "mean depth of the free tip along the inward normal")
    stamp_ns: int = whole("ns", "time of measurement of the newest accepted force")


class PredictiveParams:
    """The predictive law (`predictive`)."""

    move_speed_m_per_s: float = real("m/s", "speed of the goal in free space")
    move_accel_m_per_s2: float = real("m/s^2", "acceleration of the goal")
    slide_speed_m_per_s: float = real("m/s", "speed of the goal in contact, and of the search for a lost wall")
    force_slew_N_per_s: float = real("N/s", "rate limit of the force set-point")
    force_margin_N: float = real("N", "prediction error that does not reduce the force set-point")
    crossing_s: float = real("s", "time the stage needs to cross the gap")
    reversal_share: float = real("", "share of it by which a reversal is planned ahead")
    reversal_depth_m: float = real("m", "shortest motion back for which a reversal is planned")
    slow_approach_share: float = real("", "share of the approach speed without a force sensor")


class PredictiveState:
    """The predictive law (`predictive`)."""

    goal_speed_m_per_s: float = real("m/s", "speed of the moving goal")
    touch_depth_m: float = real("m", "depth of the free tip when contact began")
    reversal_depth_m: float = real("m", "shortest motion back for which a reversal is planned now")
    force_setpoint_N: float = real("N", "present force set-point")
    away_s: float = real("s", "time for which the contact has been lost")
    short_s: float = real("s", "time for which the free tip has been at its depth limit with too little force")
    speed: Floats = real("m/s, rad/s", "speed of the joint command", N_AXES)
    joint_at_crossing: Floats = real("m, rad, rad", "joint command one planned crossing from now", N_AXES)
    joint_after_crossing: Floats = real("m, rad, rad", "joint command a little later", N_AXES)


class ForceSourceState:
    """Choice between force sensor and estimate (`force_source`); pairs are [sensor, estimate]."""

    source: int = whole("", "a ForceSource: which one closes the loop")
    seen: Ints = whole("", "count of the newest reading that was processed", 2)
    arrival_ns: Ints = whole("ns", "time of arrival of the newest plausible reading", 2)
    normal_N: Floats = real("N", "its compression", 2)
    noise_N2: float = real("N^2", "variance of the newest estimate along the normal, without its lasting part")
    nominal_N: float = real("N", "compression by the newest estimate without adaptation of the stiffness")
    nominal_noise_N2: float = real("N^2", "its variance")
    equal: int = whole("", "equal readings of the sensor in a row")
    head: int = whole("", "newest place of the ring")
    ring_ns: Ints = whole("ns", "stamps of the sensor's last readings", FORCE_RING)
    ring_N: Floats = real("N", "their compression", FORCE_RING)
    pairs: int = whole("", "estimates that were compared with the sensor")
    bias_N: float = real("N", "mean of estimate minus sensor")
    difference_N2: float = real("N^2", "recent mean square of their difference")
    usual_difference_N2: float = real("N^2", "usual mean square of their difference")
    good_s: float = real("s", "time for which the sensor has been good")
    smooth_N: float = real("N", "compression of the source, smoothed if it is the estimate")
    changed: int = whole("", "1 in the tick of a handover; only for telemetry")
    fresh: int = whole("", "1 where the source has a new reading")
    stamp_ns: int = whole("ns", "time of its measurement")
    value_N: float = real("N", "its compression")
    spread_N2: float = real("N^2", "its variance")
    age_from_ns: int = whole("ns", "time of arrival")
    force_N: Floats = real("N", "its force, base frame", 3)
    reading_N: Floats = real("N", "the sensor's newest reading, base frame", 3)
    estimate_stamp_ns: int = whole("ns", "time of measurement of the newest estimate's pose")
    sensor_then: float = real("N", "the sensor's compression at that time, NaN where it is not known")
    new: Ints = whole("", "1 where the sensor, the estimate has a plausible new reading in this tick", 2)


class WitnessState:
    """Sensor, estimate and geometry compared (`witnesses`)."""

    sensor_N: float = real("N", "compression by the sensor, averaged over 10 ms")
    estimate_N: float = real("N", "compression by the estimate, the greater of both stiffnesses, averaged over 60 ms")
    estimate_sd_N: float = real("N", "standard deviation of the newest estimate without adaptation")
    estimate_ns: int = whole("ns", "stamp of the newest estimate")
    difference_N: float = real("N", "estimate minus sensor at the same times, averaged")
    pairs: int = whole("", "pairs that were compared since arming")
    geometry_N: float = real("N", "compression by the tip's deflection; 0 where that is not known")
    reference_m: float = real("m", "measured tip minus free tip, along the outward normal, in free space")
    reference_s: float = real("s", "time from which the reference was learned")
    deflection_m: float = real("m", "present difference from the reference")
    pose_ns: int = whole("ns", "stamp of the newest pose")
    differ_s: float = real("s", "time for which sensor and estimate have disagreed")
    pressed_s: float = real("s", "time for which a stopped catheter has been pressed")


class History:
    """Ring of predicted joints (`free_tip`)."""

    head: int = whole("", "newest place of the ring")
    count: int = whole("", "places in use")
    time_ns: Ints = whole("ns", "time at which the stages reach the joints", HISTORY_POINTS)
    joint: Matrix = real("m, rad, rad", "joints then, the roll that of the handle", HISTORY_POINTS, N_AXES)
    windup_rad: float = real("rad", "windup of the roll as it is known now, for all of them")
    flank: Floats = real("", "+1 or -1: side of the gap that pushed last", HISTORY_POINTS)


class SafetyParams:
    """Limits of the failsafe."""

    over_force_N: float = real("N", "greatest force; above it the catheter is retracted")
    hold_after_ns: int = whole("ns", "age of a pose that makes the loop hold")
    stop_after_ns: int = whole("ns", "age of a pose or force that stops or retracts")
    force_timeout_ns: int = whole("ns", "age of a force that makes the loop hold in contact")
    board_timeout_ns: int = whole("ns", "age of a board's status that stops")
    retract_speed_m_per_s: float = real("m/s", "speed of a retraction")
    retract_distance_m: float = real("m", "least length of a retraction")
    retract_stopped: int = whole("", "1: a stopped catheter that is pressed is retracted")


class Params:
    """All parameters, from the rig file."""

    period_s: float = real("s", "time between ticks")
    setpoint_lead_ns: int = whole("ns", "a set-point is executed this long after its tick")
    setpoint_expiry_us: int = whole("us", "a set-point later than this is not executed")
    stage: StageParams = part(StageParams, "stages")
    backlash: BacklashParams = part(BacklashParams, "backlash and slopes")
    wire: WireParams = part(WireParams, "friction of the pull-wire")
    kinematics: KinematicsParams = part(KinematicsParams, "unloaded catheter")
    hybrid: HybridParams = part(HybridParams, "the thesis' law")
    predictor: PredictorParams = part(PredictorParams, "tip predictor")
    force_predictor: ForcePredictorParams = part(ForcePredictorParams, "prediction of the force, thesis' law")
    safety: SafetyParams = part(SafetyParams, "failsafe")
    force_source: int = whole("", "a ForceSource: which force closes the loop, if it is good")
    force_noise_N: float = real("N", "noise of the force sensor, standard deviation")
    sensor_on_tip: int = whole("", "1 when the force sensor turns with the tip")
    law: int = whole("", "a ControlLaw")
    tip_offset: TipOffsetParams = part(TipOffsetParams, "learning of the tip's offset")
    wall: WallParams = part(WallParams, "observation of the wall")
    predictive: PredictiveParams = part(PredictiveParams, "the predictive law")


class State:
    """All state of the tick."""

    ticks: int = whole("", "ticks so far")
    phase: int = whole("", "a Phase")
    action: int = whole("", "a SafetyAction")
    latched: int = whole("", "causes kept until the operator clears them, a bit set")
    retract_from_m: float = real("m", "body insertion where the retraction began")
    setpoint_number: int = whole("", "number of the newest set-point")
    predictor: PredictorState = part(PredictorState, "tip predictor")
    stage: StageState = part(StageState, "stages")
    backlash: BacklashState = part(BacklashState, "backlash")
    wire: WireState = part(WireState, "friction of the pull-wire")
    hybrid: HybridState = part(HybridState, "joint command, goal, the thesis' law")
    force: ForceSourceState = part(ForceSourceState, "force sensor and estimate")
    force_predictor: ForcePredictorState = part(ForcePredictorState, "prediction of the force, thesis' law")
    force_seen: int = whole("", "readings of the source so far")
    force_rejected: int = whole("", "readings rejected so far")
    command_seen: int = whole("", "count of the newest command that was acted on")
    cleared: int = whole("", "count of the newest clearing that was acted on")
    home_m: float = real("m", "distal insertion of the body at home, as located at rest")
    predicted_joint: Floats = real("m, rad, rad", "joints when the stages have reached their set-points", N_AXES)
    normal: Floats = real("", "outward normal of the wall, as learned", 3)
    witness: WitnessState = part(WitnessState, "sensor, estimate and geometry compared")
    free_s: float = real("s", "time for which nothing has pressed on a tip that is being retracted")
    retract_knob_rad: float = real("rad", "knob where the retraction began")
    history: History = part(History, "predicted joints of the last 0.2 s")
    tip_offset: TipOffsetState = part(TipOffsetState, "offset of the tip")
    windup: RollWindupState = part(RollWindupState, "windup of the roll")
    wall: WallState = part(WallState, "motion of the wall")
    predictive: PredictiveState = part(PredictiveState, "the predictive law")
    jog: JogState = part(JogState, "jog in progress")


class Outputs:
    """Set-point of the tick, and its telemetry."""

    now_ns: int = whole("ns", "time of this tick")
    valid: int = whole("", "1 when the set-point is to be sent")
    number: int = whole("", "number of the set-point")
    execute_us: int = whole("us", "board time at which the set-point is reached")
    expiry_us: int = whole("us", "after execute_us + expiry_us it is never executed")
    position_steps: Ints = whole("steps", "the set-point, by axis", N_AXES)
    stage_unit: Floats = real("m, rad, rad", "set-point in units of the axes", N_AXES)
    joint: Floats = real("m, rad, rad", "predicted joints, the insertion corrected by the poses", N_AXES)
    tip_m: Floats = carried_by(RigState, "tip_m")
    tip_velocity_m_per_s: Floats = carried_by(RigState, "tip_velocity_m_per_s")
    goal_m: Floats = real("m", "moving goal of the tip", 3)
    force_N: Floats = real("N", "force of the source, base frame", 3)
    normal_force_N: float = carried_by(RigState, "force_N")
    wanted_force_N: float = real("N", "requested compression")
    phase: int = whole("", "a Phase")
    action: int = whole("", "a SafetyAction")
    cause: int = whole("", "causes that stand or are latched, a bit set of `safety.CAUSES`")
    poses_rejected: int = carried_by(RigState, "poses_rejected")
    forces_rejected: int = carried_by(RigState, "forces_rejected")
    pose_age_ns: int = carried_by(RigState, "pose_age_ns")
    force_source: int = whole("", "a ForceSource")
    wall_m: float = real("m", "predicted wall along the inward normal")
    wall_sd_m: float = real("m", "its standard deviation")
    heart_Hz: float = real("Hz", "heart rate found, 0 for none")
    breath_Hz: float = real("Hz", "breath rate found, 0 for none")
    stiffness_N_per_m: float = real("N/m", "stiffness learned, catheter and tissue in series")
    play_m: float = real("m", "width of the backlash learned")
    witness_N: Floats = real("N", "compression by force sensor, estimate and geometry", 3)


POSE, FORCE, BOARD, COMMAND, INPUTS = map(dtype_of, (PoseRecord, Force, BoardRecord, CommandRecord, Inputs))
PREDICTOR_PARAMS, PREDICTOR_STATE = dtype_of(PredictorParams), dtype_of(PredictorState)
BANK, BEAT = dtype_of(Bank), dtype_of(Beat)
TARGET_PARAMS, TARGET_STATE = dtype_of(TargetParams), dtype_of(TargetState)
STAGE_PARAMS, STAGE_STATE = dtype_of(StageParams), dtype_of(StageState)
BACKLASH_PARAMS, BACKLASH_STATE = dtype_of(BacklashParams), dtype_of(BacklashState)
WIRE_PARAMS, WIRE_STATE = dtype_of(WireParams), dtype_of(WireState)
FORCE_PREDICTOR_STATE, FORCE_SOURCE_STATE = dtype_of(ForcePredictorState), dtype_of(ForceSourceState)
HYBRID_PARAMS, HYBRID_STATE = dtype_of(HybridParams), dtype_of(HybridState)
HISTORY = dtype_of(History)
PARAMS, STATE, OUTPUTS = dtype_of(Params), dtype_of(State), dtype_of(Outputs)


def new(dtype: np.dtype) -> np.ndarray:
    """Return a zeroed array of one record of a declared class, for `array[0]` in kernels and in plain Python alike."""
    return np.zeros(1, dtype)


def page() -> str:
    """Return docs/records.md: every record with its fields."""
    return (
        "# Records of the tick\n\n"
        "The control tick reads parameters and inputs and changes state and outputs. Every field is declared once, in\n"
        "`realtime/control/records.py`; this page is made from the declarations: `python -m realtime.control.records`.\n"
        + as_markdown(Params, Inputs, State, Outputs)
    )


if __name__ == "__main__":
    print(page(), end="")
