"""From the rig file to the tick's parameter record."""

from __future__ import annotations

from typing import Any

import numpy as np

from realtime.inverse_kinematics import fitted_knob_curve
from realtime.records import PARAMS, new
from realtime.rig_file import Rig
from realtime.tick import FORCE_FROM_ESTIMATE, FORCE_FROM_SENSOR

# The board answers at 200 Hz; three missed answers and a margin.
BOARD_TIMEOUT_S = 0.030
# Offsets from the axis below this multiple of the tracker noise say nothing about the roll.
AXIS_RADIUS_SIGMA = 4.0


def _fill(record: np.record, **fields: Any) -> None:
    for name, value in fields.items():
        record[name] = value


def tick_parameters(rig: Rig, force_source: str = "sensor") -> np.recarray:
    """The PARAMS record of `rig`; `force_source` is `sensor` or `estimate`. Raises ValueError otherwise."""
    if force_source not in ("sensor", "estimate"):
        raise ValueError(f"force_source: found {force_source!r}, wanted sensor or estimate")
    params = new(PARAMS)
    p, control, limits = params[0], rig.control, rig.safety
    p.period_s = 1.0 / control.loop_hz
    p.setpoint_lead_ns = round(rig.board.setpoint_lead_s * 1e9)
    p.setpoint_expiry_us = round(rig.board.setpoint_expiry_s * 1e6)
    p.force_source = FORCE_FROM_SENSOR if force_source == "sensor" else FORCE_FROM_ESTIMATE
    for axis in range(3):
        stage = rig.stage(axis)
        p.stage.steps_per_unit[axis] = stage.steps_per_unit
        p.stage.max_speed[axis] = stage.max_speed_unit_per_s
        p.stage.max_accel[axis] = stage.max_accel_unit_per_s2
        p.stage.min_unit[axis], p.stage.max_unit[axis] = stage.min_unit, stage.max_unit
    _fill(p.backlash, width_m=rig.transmission.insertion_backlash_m, slope=rig.transmission.insertion_slope,
          threshold_m=control.reversal_threshold_m, roll_slope=rig.transmission.roll_slope)
    _fill(p.kinematics, distal_length_m=rig.catheter.distal_length_m,
          insertion_at_home_m=rig.transmission.insertion_at_home_m,
          max_curvature_per_m=rig.catheter.max_curvature_per_m,
          axis_radius_m=AXIS_RADIUS_SIGMA * rig.tracker.position_noise_m)
    p.kinematics.knob_of_curvature_rad[:] = fitted_knob_curve(
        rig.transmission.knob_rad, rig.transmission.curvature_per_m, rig.catheter.max_curvature_per_m)
    _fill(p.hybrid, position_gain_per_s=control.position_gain_per_s,
          position_integral_per_s2=control.position_integral_per_s2, force_gain_m_per_N=control.force_gain_m_per_N,
          force_integral_m_per_N_s=control.force_integral_m_per_N_s,
          approach_speed_m_per_s=control.approach_speed_m_per_s, contact_force_N=control.contact_force_N)
    _fill(p.predictor, acceleration_noise_m_per_s2=control.acceleration_noise_m_per_s2,
          position_noise_m=rig.tracker.position_noise_m, max_speed_m_per_s=limits.max_tip_speed_m_per_s,
          gate_sigma=5.0, workspace_min_m=limits.workspace_min_m, workspace_max_m=limits.workspace_max_m)
    _fill(p.safety, over_force_N=limits.over_force_N, hold_after_ns=round(limits.hold_after_s * 1e9),
          stop_after_ns=round(limits.stop_after_s * 1e9), force_timeout_ns=round(limits.force_timeout_s * 1e9),
          board_timeout_ns=round(BOARD_TIMEOUT_S * 1e9), retract_speed_m_per_s=limits.retract_speed_m_per_s,
          retract_distance_m=limits.retract_distance_m)
    return params
