"""The records that cross the tick: parameters, state, inputs, outputs. One declaration, read by kernels and people."""

from __future__ import annotations

import numpy as np

N_AXES = 3
CURVE_POINTS = 129

POSE = np.dtype(
    [
        ("count", "i8"),
        ("stamp_ns", "i8"),
        ("arrival_ns", "i8"),
        ("position_m", "f8", 3),
        ("quaternion_wxyz", "f8", 4),
    ],
    align=True,
)
FORCE = np.dtype(
    [
        ("count", "i8"),
        ("stamp_ns", "i8"),
        ("arrival_ns", "i8"),
        ("force_N", "f8", 3),
        ("covariance_N2", "f8", (3, 3)),
    ],
    align=True,
)
BOARD = np.dtype(
    [
        ("count", "i8"),
        ("arrival_ns", "i8"),
        ("mcu_offset_ns", "i8"),
        ("position_steps", "i8", N_AXES),
        ("encoder_counts", "i8", N_AXES),
        ("state", "i8"),
        ("fault", "i8"),
        ("ready", "i8"),
    ],
    align=True,
)
COMMAND = np.dtype(
    [
        ("count", "i8"),
        ("kind", "i8"),
        ("armed", "i8"),
        ("target_m", "f8", 3),
        ("normal", "f8", 3),
        ("force_N", "f8"),
        ("clear", "i8"),
        ("watch", "i8"),
    ],
    align=True,
)

INPUTS = np.dtype(
    [
        ("now_ns", "i8"),
        ("tip", POSE),
        ("shaft", POSE),
        ("sensor", FORCE),
        ("estimate", FORCE),
        ("board", BOARD),
        ("command", COMMAND),
    ],
    align=True,
)

PREDICTOR_PARAMS = np.dtype(
    [
        ("acceleration_noise_m_per_s2", "f8"),
        ("position_noise_m", "f8"),
        ("max_speed_m_per_s", "f8"),
        ("gate_sigma", "f8"),
        ("workspace_min_m", "f8", 3),
        ("workspace_max_m", "f8", 3),
    ],
    align=True,
)
PREDICTOR_STATE = np.dtype(
    [
        ("started", "i8"),
        ("seen", "i8"),
        ("stamp_ns", "i8"),
        ("accepted_ns", "i8"),
        ("position_m", "f8", 3),
        ("velocity_m_per_s", "f8", 3),
        ("quaternion_wxyz", "f8", 4),
        ("p00", "f8"),
        ("p01", "f8"),
        ("p11", "f8"),
        ("rejected", "i8"),
        ("rejected_in_row", "i8"),
    ],
    align=True,
)

# The wall's motion (`target_predictor`): harmonics of heart and breath, and three models of the same motion.
HEART_HARMONICS, BREATH_HARMONICS = 3, 2
TARGET_N = 2 + 2 * (HEART_HARMONICS + BREATH_HARMONICS) + 4
TARGET_MODELS = 4
BANK_POINTS = 24
BANK = np.dtype(
    [
        ("low_Hz", "f8"),
        ("high_Hz", "f8"),
        ("memory_s", "f8"),
        ("since_s", "f8"),
        ("level", "f8"),
        ("phase_rad", "f8", BANK_POINTS),
        ("first", "f8", (BANK_POINTS, 2)),
        ("second", "f8", (BANK_POINTS, 2)),
    ],
    align=True,
)
# The grid of `beat_phase`.
BEAT_PHASES, BEAT_RATES, BEAT_HARMONICS = 48, 15, 3
BEAT = np.dtype(
    [
        ("share", "f8", (BEAT_PHASES, BEAT_RATES)),
        ("moved", "f8", (BEAT_PHASES, BEAT_RATES)),
        ("wave_m", "f8", 2 * BEAT_HARMONICS),
        ("told_m", "f8", 2 * BEAT_HARMONICS),
        ("seen", "f8", (2 * BEAT_HARMONICS, 2 * BEAT_HARMONICS)),
        ("factor", "f8", (2 * BEAT_HARMONICS, 2 * BEAT_HARMONICS)),
        ("moment_m", "f8", (BEAT_RATES, BEAT_HARMONICS, 2)),
    ],
    align=True,
)
TARGET_PARAMS = np.dtype(
    [
        ("by_phase", "i8"),
        ("horizon_s", "f8"),
        ("gate_sigma", "f8"),
        ("stiffness_sd", "f8"),
        ("play_sd_m", "f8"),
        ("level_acceleration_m_per_s2", "f8"),
        ("local_acceleration2", "f8"),
        ("score_memory_s", "f8"),
        ("heart_min_Hz", "f8"),
        ("heart_max_Hz", "f8"),
        ("breath_min_Hz", "f8"),
        ("breath_max_Hz", "f8"),
    ],
    align=True,
)
TARGET_STATE = np.dtype(
    [
        ("started", "i8"),
        ("time_ns", "i8"),
        ("x", "f8", (TARGET_MODELS, TARGET_N)),
        ("P", "f8", (TARGET_MODELS, TARGET_N, TARGET_N)),
        ("score_m2", "f8", TARGET_MODELS),
        ("weight", "f8", TARGET_MODELS),
        ("noise_m2", "f8"),
        ("shot_ns", "i8"),
        ("shot", "f8", (TARGET_MODELS, TARGET_N)),
        ("heart_found", "i8"),
        ("breath_found", "i8"),
        ("mean_rate", "f8"),
        ("worse_s", "f8"),
        ("bank_value", "f8"),
        ("bank_s", "f8"),
        ("bank_n", "i8"),
        ("heart_bank", BANK),
        ("breath_bank", BANK),
        ("last_heart_Hz", "f8"),
        ("agreed", "i8"),
        ("rejected", "i8"),
        ("rejected_s", "f8"),
        ("beat", BEAT),
        ("beat_shot_m", "f8", (BEAT_RATES, BEAT_HARMONICS, 2)),
        ("shot_rate", "f8"),
        ("row", "f8", TARGET_N),
        ("cross", "f8", TARGET_N),
        ("angle", "f8", (HEART_HARMONICS + BREATH_HARMONICS, 2)),
    ],
    align=True,
)

STAGE_PARAMS = np.dtype(
    [
        ("steps_per_unit", "f8", N_AXES),
        ("max_speed", "f8", N_AXES),
        ("max_accel", "f8", N_AXES),
        ("min_unit", "f8", N_AXES),
        ("max_unit", "f8", N_AXES),
    ],
    align=True,
)
STAGE_STATE = np.dtype([("position", "f8", N_AXES), ("speed", "f8", N_AXES)], align=True)

BACKLASH_PARAMS = np.dtype(
    [
        ("width_m", "f8"),
        ("caution_m", "f8"),
        ("slope", "f8"),
        ("threshold_m", "f8"),
        ("roll_slope", "f8"),
    ],
    align=True,
)
BACKLASH_STATE = np.dtype(
    [
        ("direction", "f8"),
        ("extreme_m", "f8"),
        ("body_m", "f8"),
        ("flank", "f8"),
        ("width_m", "f8"),
    ],
    align=True,
)

KINEMATICS_PARAMS = np.dtype(
    [
        ("distal_length_m", "f8"),
        ("insertion_at_home_m", "f8"),
        ("max_curvature_per_m", "f8"),
        ("axis_radius_m", "f8"),
        ("knob_of_curvature_rad", "f8", CURVE_POINTS),
    ],
    align=True,
)

HYBRID_PARAMS = np.dtype(
    [
        ("position_gain_per_s", "f8"),
        ("position_integral_per_s2", "f8"),
        ("force_gain_m_per_N", "f8"),
        ("force_integral_m_per_N_s", "f8"),
        ("approach_speed_m_per_s", "f8"),
        ("contact_force_N", "f8"),
    ],
    align=True,
)
HYBRID_STATE = np.dtype(
    [
        ("joint", "f8", N_AXES),
        ("integral", "f8", N_AXES),
        ("force_integral_N_s", "f8"),
        ("goal_m", "f8", 3),
        ("above_ns", "i8"),
    ],
    align=True,
)

PREDICTIVE_PARAMS = np.dtype(
    [
        ("move_speed_m_per_s", "f8"),
        ("move_accel_m_per_s2", "f8"),
        ("slide_speed_m_per_s", "f8"),
        ("force_slew_N_per_s", "f8"),
        ("force_margin_N", "f8"),
        ("offset_memory_s", "f8"),
        ("contact_memory_s", "f8"),
        ("crossing_s", "f8"),
        ("reversal_share", "f8"),
        ("reversal_depth_m", "f8"),
        ("force_noise_N", "f8"),
        ("play_noise_m", "f8"),
        ("position_noise_m", "f8"),
        ("compliance_m_per_N", "f8"),
        ("blind_share", "f8"),
    ],
    align=True,
)
PREDICTIVE_STATE = np.dtype(
    [
        ("normal", "f8", 3),
        ("offset_m", "f8", 3),
        ("touch_offset_m", "f8", 3),
        ("offset_s", "f8"),
        ("offset_ns", "i8"),
        ("goal_speed", "f8"),
        ("along_m", "f8"),
        ("touch_m", "f8"),
        ("depth_m", "f8"),
        ("wanted_N", "f8"),
        ("mean_m", "f8"),
        ("felt_ns", "i8"),
        ("away_s", "f8"),
        ("speed", "f8", N_AXES),
        ("soon", "f8", N_AXES),
        ("later", "f8", N_AXES),
        ("point_m", "f8", 3),
        ("joint", "f8", N_AXES),
        ("short_m", "f8"),
        ("short_s", "f8"),
    ],
    align=True,
)
# Sensor and estimate side by side (`force_source`).
FORCE_RING = 96
FORCE_SOURCE_STATE = np.dtype(
    [
        ("source", "i8"),
        ("seen", "i8", 2),
        ("arrival_ns", "i8", 2),
        ("normal_N", "f8", 2),
        ("noise_N2", "f8"),
        ("equal", "i8"),
        ("head", "i8"),
        ("ring_ns", "i8", FORCE_RING),
        ("ring_N", "f8", FORCE_RING),
        ("pairs", "i8"),
        ("bias_N", "f8"),
        ("apart_N2", "f8"),
        ("usual_N2", "f8"),
        ("good_s", "f8"),
        ("smooth_N", "f8"),
        ("changed", "i8"),
        ("fresh", "i8"),
        ("stamp_ns", "i8"),
        ("value_N", "f8"),
        ("spread_N2", "f8"),
        ("age_from_ns", "i8"),
        ("force_N", "f8", 3),
        ("reading_N", "f8", 3),
    ],
    align=True,
)
# Where the distal end is believed to have been (insertion m, roll rad, knob rad): a ring, the newest at `head`.
HISTORY_POINTS = 192
HISTORY = np.dtype(
    [
        ("head", "i8"),
        ("count", "i8"),
        ("time_ns", "i8", HISTORY_POINTS),
        ("joint", "f8", (HISTORY_POINTS, N_AXES)),
        ("flank", "f8", HISTORY_POINTS),
    ],
    align=True,
)

SAFETY_PARAMS = np.dtype(
    [
        ("over_force_N", "f8"),
        ("hold_after_ns", "i8"),
        ("stop_after_ns", "i8"),
        ("force_timeout_ns", "i8"),
        ("board_timeout_ns", "i8"),
        ("retract_speed_m_per_s", "f8"),
        ("retract_distance_m", "f8"),
    ],
    align=True,
)

PARAMS = np.dtype(
    [
        ("period_s", "f8"),
        ("setpoint_lead_ns", "i8"),
        ("setpoint_expiry_us", "i8"),
        ("stage", STAGE_PARAMS),
        ("backlash", BACKLASH_PARAMS),
        ("kinematics", KINEMATICS_PARAMS),
        ("hybrid", HYBRID_PARAMS),
        ("predictor", PREDICTOR_PARAMS),
        ("safety", SAFETY_PARAMS),
        ("force_source", "i8"),
        ("sensor_on_tip", "i8"),
        ("law", "i8"),
        ("predictive", PREDICTIVE_PARAMS),
        ("wall", TARGET_PARAMS),
        ("estimate_wall", TARGET_PARAMS),
        ("tip_wall", TARGET_PARAMS),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("ticks", "i8"),
        ("phase", "i8"),
        ("action", "i8"),
        ("cause", "i8"),
        ("latched", "i8"),
        ("latch_clear", "i8"),
        ("retract_from_m", "f8"),
        ("setpoint_number", "i8"),
        ("predictor", PREDICTOR_STATE),
        ("stage", STAGE_STATE),
        ("backlash", BACKLASH_STATE),
        ("hybrid", HYBRID_STATE),
        ("force", FORCE_SOURCE_STATE),
        ("force_seen", "i8"),
        ("force_rejected", "i8"),
        ("command_seen", "i8"),
        ("cleared", "i8"),
        ("contact_since_ns", "i8"),
        ("work", "f8", (4, 3)),
        ("home_m", "f8"),
        ("believed", "f8", N_AXES),
        ("history", HISTORY),
        ("predictive", PREDICTIVE_STATE),
        ("wall", TARGET_STATE),
        ("tip_wall", TARGET_STATE),
    ],
    align=True,
)

OUTPUTS = np.dtype(
    [
        ("now_ns", "i8"),
        ("valid", "i8"),
        ("number", "i8"),
        ("execute_us", "i8"),
        ("expiry_us", "i8"),
        ("position_steps", "i8", N_AXES),
        ("stage_unit", "f8", N_AXES),
        ("joint", "f8", N_AXES),
        ("tip_m", "f8", 3),
        ("tip_velocity_m_per_s", "f8", 3),
        ("goal_m", "f8", 3),
        ("force_N", "f8", 3),
        ("normal_force_N", "f8"),
        ("wanted_force_N", "f8"),
        ("phase", "i8"),
        ("action", "i8"),
        ("cause", "i8"),
        ("poses_rejected", "i8"),
        ("forces_rejected", "i8"),
        ("pose_age_ns", "i8"),
        ("force_source", "i8"),
        ("wall_m", "f8"),
        ("wall_sd_m", "f8"),
        ("heart_Hz", "f8"),
        ("breath_Hz", "f8"),
        ("stiffness_N_per_m", "f8"),
        ("play_m", "f8"),
    ],
    align=True,
)


def new(dtype: np.dtype) -> np.recarray:
    """A zeroed record array of length 1 and `dtype`, for `record[0]` in kernels and in plain Python alike."""
    return np.zeros(1, dtype).view(np.recarray)
