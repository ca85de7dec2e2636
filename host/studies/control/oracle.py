"""The oracle of the control study: it gets the true wall motion and backlash, and obeys the stages' limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.rig_file import Rig
from realtime.control import backlash, inverse_kinematics, stage_limiter
from realtime.control.configure import tick_parameters
from realtime.control.records import BACKLASH_STATE, STAGE_STATE, new
from sim import heart
from sim.heart import HeartConfig
from sim.scenario import TARGET_M
from sim.world import simulated_plant

Array = NDArray[np.float64]
STEP_S = 0.001
# A slow integral keeps the mean force (m/s per N); before the first touch the wall is looked for at this speed.
TRIM_m_per_N_s, SEARCH_m_per_s = 0.02, 0.004
SLOPE_S, AFTER_CROSSING_S = 0.005, 0.060
GAINS = (1.0, 1.1, 1.2, 1.3)
SETTLE_S = 6.0


def rms_N(rig: Rig, seed: int, beat: HeartConfig, seconds: float, force_N: float = 0.2) -> float:
    """RMS force error (N) of the oracle, with the best of a few ratios of free tip to wall (a bent catheter gives)."""
    return min(_follow(rig, seed, beat, seconds, force_N, gain) for gain in GAINS)


def _motion(beat: HeartConfig, seed: int, seconds: float) -> Array:
    """The wall's displacement into the tissue (m) for each millisecond, and half a second more."""
    parameters, state = heart.parameters(beat), heart.start(seed)
    return np.array([-heart.advance(parameters, state, STEP_S * k, STEP_S) for k in range(round((seconds + 0.5) / STEP_S))])


def _follow(rig: Rig, seed: int, beat: HeartConfig, seconds: float, force_N: float, gain: float) -> float:
    p = tick_parameters(rig)[0]
    wall = _motion(beat, seed, seconds + SETTLE_S)
    plant = simulated_plant(rig, seed, heart=beat)
    play, stage = new(BACKLASH_STATE)[0], new(STAGE_STATE)[0]
    home_m = float(plant.truth()["insertion_m"])
    backlash.start(p.backlash, play, -0.5 * p.backlash.width_m)
    crossing_s = p.predictive.reversal_share * p.predictive.crossing_s
    play.width_m = p.backlash.width_m
    ahead = np.round(np.array([0.0, SLOPE_S, crossing_s, crossing_s + AFTER_CROSSING_S]) / STEP_S).astype(int)
    joints, base_m, errors = np.zeros((4, 3)), 0.018, []
    for k in range(round((seconds + SETTLE_S) / STEP_S)):
        error_N = force_N - float(plant.contact_force_N[2])
        touching = error_N < force_N
        base_m += (TRIM_m_per_N_s * error_N if touching else SEARCH_m_per_s) * STEP_S
        for row, steps in zip(joints, ahead, strict=True):
            tip = np.array([TARGET_M[0], TARGET_M[1], base_m + gain * wall[k + steps]])
            row[:] = inverse_kinematics.apply(p.kinematics, tip, 0.0)
        speed = (joints[1] - joints[0]) / SLOPE_S
        handle = backlash.apply_ahead(
            p.backlash,
            play,
            joints[0, 0] - home_m,
            joints[2, 0] - home_m,
            joints[3, 0] - home_m,
            p.predictive.reversal_depth_m,
        )
        stage_limiter.follow(p.stage, stage, 0, handle, speed[0] / p.backlash.slope, STEP_S)
        stage_limiter.follow(p.stage, stage, 2, joints[0, 2], speed[2], STEP_S)
        backlash.follow(p.backlash, play, stage.position[0])
        plant.step(STEP_S, np.array([stage.position[0], 0.0, stage.position[2]]))
        if k * STEP_S > SETTLE_S:
            errors.append(error_N)
    return float(np.sqrt(np.mean(np.square(errors))))
