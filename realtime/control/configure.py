"""Conversion of the rig file into the tick's parameter record."""

from __future__ import annotations

from typing import Any

import numpy as np

from protocol.catheter import load_catheter
from protocol.enums import ControlLaw, ForceSource
from protocol.rig_file import Rig
from realtime.control.inverse_kinematics import fitted_knob_curve
from realtime.control.records import PARAMS, new
from realtime.control.stage_limiter import crossing_time_s

# The board sends STATUS at 200 Hz; this is three missed messages and a margin.
BOARD_TIMEOUT_S = 0.030
# Below this multiple of the tracker's noise, an offset from the axis does not determine the roll.
AXIS_RADIUS_SIGMA = 4.0
# Predictions of the wall are scored this far ahead.
HORIZON_S = 0.040
# Squared acceleration (m2/s3) of the local model. With the first it follows a heart beat of 1 mm at 2 Hz. With the second
# it stays at the mean, which is better than following when samples are few, noisy and late.
FOLLOWING2, STANDING2 = 1e-3, 1e-7
# Standard deviations: a pose that is further from the last one than its speed allows by so many is rejected, and a sample of
# the wall that is so far from every model.
GATE_SIGMA = 5.0


def _fill(record: np.record, **fields: Any) -> None:
    for name, value in fields.items():
        record[name] = value


def _fill_predictive(p: np.record, rig: Rig) -> None:
    """Fill the parameters of the predictive law and of the predictors of the wall."""
    control, insertion = rig.control, rig.stages.insertion
    crossing_s = crossing_time_s(
        rig.transmission.insertion_backlash_m, insertion.max_speed_unit_per_s, insertion.max_accel_unit_per_s2
    )
    p.law = ControlLaw[control.law.upper()]
    _fill(
        p.predictive,
        move_speed_m_per_s=control.move_speed_m_per_s,
        move_accel_m_per_s2=control.move_accel_m_per_s2,
        slide_speed_m_per_s=control.slide_speed_m_per_s,
        force_slew_N_per_s=control.force_slew_N_per_s,
        force_margin_N=control.force_margin_N,
        crossing_s=crossing_s,
        reversal_share=control.reversal_share,
        reversal_depth_m=control.reversal_depth_m,
        slow_approach_share=control.blind_approach_share,
    )
    _fill(p.tip_offset, free_memory_s=control.offset_memory_s, contact_memory_s=control.contact_memory_s)
    _fill(
        p.wall,
        compliance_m_per_N=control.tip_compliance_m_per_N,
        play_noise_m=control.play_noise_m,
        position_noise_m=rig.tracker.position_noise_m,
    )
    p.force_noise_N = rig.force_sensor.noise_N
    p.wall.by_estimate.by_phase = p.wall.by_pose.by_phase = 1
    for record, stiffness_sd, play_sd_m, acceleration, local2, memory_s in (
        (p.wall.by_force, control.stiffness_sd, control.play_sd_m, 1e-4, FOLLOWING2, 1.0),
        (p.wall.by_estimate, 0.0, 0.0, 2e-5, STANDING2, 3.0),
        (p.wall.by_pose, 0.0, 0.0, 1e-5, FOLLOWING2, 3.0),
    ):
        _fill(
            record,
            horizon_s=HORIZON_S,
            gate_sigma=GATE_SIGMA,
            stiffness_sd=stiffness_sd,
            play_sd_m=play_sd_m,
            level_acceleration_m_per_s2=acceleration,
            local_acceleration2=local2,
            score_memory_s=memory_s,
            heart_min_Hz=40 / 60 * 0.9,
            heart_max_Hz=180 / 60 * 1.1,
            breath_min_Hz=0.1,
            breath_max_Hz=0.6,
        )


def tick_parameters(rig: Rig, force_source: str = "sensor") -> np.ndarray:
    """Return the PARAMS record of `rig`; `force_source` is `sensor` or `estimate`. Raises ValueError otherwise."""
    if force_source not in ForceSource.labels():
        raise ValueError(f"force_source: found {force_source!r}, wanted {' or '.join(ForceSource.labels())}")
    params = new(PARAMS)
    p, control, limits = params[0], rig.control, rig.safety
    p.period_s = 1.0 / control.loop_hz
    p.setpoint_lead_ns = round(rig.board.setpoint_lead_s * 1e9)
    p.setpoint_expiry_us = round(rig.board.setpoint_expiry_s * 1e6)
    p.sensor_on_tip = 1 if control.force_frame == "tip" else 0
    p.force_source = ForceSource[force_source.upper()]
    for axis in range(3):
        stage = rig.stage(axis)
        p.stage.steps_per_unit[axis] = stage.steps_per_unit
        p.stage.max_speed[axis] = stage.max_speed_unit_per_s
        p.stage.max_accel[axis] = stage.max_accel_unit_per_s2
        p.stage.min_unit[axis], p.stage.max_unit[axis] = stage.min_unit, stage.max_unit
    _fill(
        p.backlash,
        width_m=rig.transmission.insertion_backlash_m,
        slope=rig.transmission.insertion_slope,
        caution_m=control.play_caution_m if control.law == "predictive" else 0.0,
        threshold_m=control.reversal_threshold_m,
        roll_slope=rig.transmission.roll_slope,
    )
    constitutive = load_catheter(rig.catheter.name).constitutive
    _fill(
        p.wire,
        friction=constitutive.friction_coefficient if constitutive else 0.0,
        turning_rad=rig.transmission.wire_turning_rad,
        distal_length_m=rig.catheter.distal_length_m,
        wire_share=rig.estimation.curvature_exponent,
    )
    _fill(
        p.kinematics,
        distal_length_m=rig.catheter.distal_length_m,
        insertion_at_home_m=rig.transmission.insertion_at_home_m,
        max_curvature_per_m=rig.catheter.max_curvature_per_m,
        axis_radius_m=AXIS_RADIUS_SIGMA * rig.tracker.position_noise_m,
    )
    p.kinematics.knob_of_curvature_rad[:] = fitted_knob_curve(
        rig.transmission.knob_rad, rig.transmission.curvature_per_m, rig.catheter.max_curvature_per_m
    )
    _fill(
        p.hybrid,
        from_desired=control.force_added_to == "desired",
        pi_form=control.form == "pi",
        position_gain_per_s=control.position_gain_per_s,
        position_integral_per_s2=control.position_integral_per_s2,
        joint_gain=control.pi_position_gain,
        joint_integral_per_s=control.pi_position_integral_per_s,
        force_gain_m_per_N=control.pi_force_gain_m_per_N if control.form == "pi" else control.force_gain_m_per_N,
        force_integral_m_per_N_s=(
            control.pi_force_integral_m_per_N_s if control.form == "pi" else control.force_integral_m_per_N_s
        ),
        approach_speed_m_per_s=control.approach_speed_m_per_s,
        contact_force_N=control.contact_force_N,
    )
    _fill(
        p.predictor,
        acceleration_noise_m_per_s2=control.acceleration_noise_m_per_s2,
        position_noise_m=rig.tracker.position_noise_m,
        max_speed_m_per_s=limits.max_tip_speed_m_per_s,
        gate_sigma=GATE_SIGMA,
        workspace_min_m=limits.workspace_min_m,
        workspace_max_m=limits.workspace_max_m,
    )
    _fill(
        p.force_predictor,
        acceleration_noise_N_per_s2=control.acceleration_noise_m_per_s2 / control.tip_compliance_m_per_N,
        rate_sd_N_per_s=control.approach_speed_m_per_s / control.tip_compliance_m_per_N,
    )
    _fill_predictive(p, rig)
    force_timeout_s = limits.force_timeout_s if force_source == "sensor" else limits.hold_after_s
    _fill(
        p.safety,
        over_force_N=limits.over_force_N,
        hold_after_ns=round(limits.hold_after_s * 1e9),
        stop_after_ns=round(limits.stop_after_s * 1e9),
        force_timeout_ns=round(force_timeout_s * 1e9),
        board_timeout_ns=round(BOARD_TIMEOUT_S * 1e9),
        retract_speed_m_per_s=limits.retract_speed_m_per_s,
        retract_distance_m=limits.retract_distance_m,
        retract_stopped=int(limits.retract_stopped),
    )
    return params
