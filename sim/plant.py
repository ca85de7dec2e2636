"""The whole plant: stage positions in; catheter, contact, sensor poses out. One call a millisecond, nothing allocated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sim import catheter_chain, effects, heart, knob, plant_step, sensor_effects, tissue, vessel
from sim.catheter_chain import CATHETERS, CatheterConfig
from sim.effects import PlantedEffect
from sim.heart import HeartConfig
from sim.knob import KnobConfig
from sim.tissue import TissueConfig
from sim.vessel import VesselConfig

Array = np.ndarray
TRAVEL = np.array([0.3, 60.0, 10.0])  # end stops of the stages: m, rad, rad either way


@dataclass(frozen=True)
class PlantConfig:
    """The demo's plant: about 27 mm of a blazer_prime_xp before a wall normal to e3, 25 mm out.

    `tool_offsets_m`: sensors along the catheter, back from the tip. `start_stage`: m, rad, rad at time zero.
    """

    catheter: CatheterConfig = CATHETERS["blazer_prime_xp"]
    vessel: VesselConfig = field(default_factory=VesselConfig)
    knob: KnobConfig = field(default_factory=KnobConfig)
    tissue: TissueConfig = field(default_factory=TissueConfig)
    heart: HeartConfig = field(default_factory=HeartConfig)
    tool_offsets_m: tuple[float, ...] = (0.0, 0.030)
    start_stage: tuple[float, float, float] = (0.0, 0.0, 0.0)
    effects: tuple[PlantedEffect, ...] = ()


class Measured(NamedTuple):
    """What a tracked tool shows before its device adds noise. `missing`: a dropped sample, pose then as last seen."""

    position_m: Array
    quaternion_wxyz: Array
    missing: bool


class Plant:
    """Stage positions to tip pose and contact force.

    step() advances; sensor_pose() and contact_force_N are the truth; measured_pose() and measured_wrench() pass through
    planted sensor effects and are what device emulators get. Deterministic: same config, seed and inputs, same numbers.
    """

    def __init__(self, config: PlantConfig | None = None, seed: int = 0) -> None:
        """At rest at `config.start_stage`, the unloaded shape settled. Raises ValueError for bad effects or values."""
        self.config = config or PlantConfig()
        self.seed = int(seed)
        c = self.config
        self._arrays, self._parts = plant_step.hold(
            plant_step.Parts(
                catheter_chain.parameters(c.catheter),
                catheter_chain.start(),
                vessel.parameters(c.vessel),
                vessel.start(c.vessel, c.start_stage[0], c.start_stage[1]),
                knob.parameters(c.knob, c.catheter),
                knob.start(),
                tissue.parameters(c.tissue),
                tissue.start(),
                heart.parameters(c.heart),
                heart.start(self.seed),
                plant_step.start(c.start_stage, c.tool_offsets_m, self.seed),
                effects.pack(c.effects),
            )
        )
        # What every millisecond reads: views, as records look their fields up by name each time.
        self._wall_force = self._arrays.tissue_state["force"][0]
        self._wall_point, self._tip = self._arrays.tissue["point"][0], self._arrays.chain_state["tip"][0]
        self._stage = np.array(c.start_stage, float)
        self._position, self._frame, self._quaternion = np.zeros(3), np.eye(3), np.zeros(4)
        self._wrench = np.zeros(6)
        plant_step.settle_unloaded(self._arrays)

    @property
    def time_s(self) -> float:
        """Return the time since the start (s)."""
        return float(self._parts.rig.time_s)

    def step(self, dt_s: float, stage_position: Sequence[float] | Array) -> None:
        """Advance by `dt_s` (s, above 0, at most 0.02) while the stages move to `stage_position` (m, rad, rad).

        Beyond the end stops a position counts as the stop. Raises ValueError for a value that is not finite.
        """
        if not 0.0 < dt_s <= 0.02:
            raise ValueError(f"dt_s: found {dt_s}, wanted above 0 and at most 0.02")
        for axis in range(3):
            value = float(stage_position[axis])
            if not math.isfinite(value):
                raise ValueError(f"stage_position[{axis}]: found {value}, wanted a finite number")
            self._stage[axis] = min(max(value, -TRAVEL[axis]), TRAVEL[axis])
        plant_step.advance(self._arrays, self._stage, dt_s)

    def sensor_pose(self, offset_m: float) -> tuple[Array, Array]:
        """True (position (3,) m, quaternion (4,) scalar first, tip->base) at `offset_m` behind the tip, base frame."""
        plant_step.pose(self._arrays, offset_m, self._position, self._frame, self._quaternion)
        return self._position.copy(), self._quaternion.copy()

    def measured_pose(self, tool: int) -> Measured:
        """Pose of tool number `tool` through the planted effects of port pose_sensor, taken now. Call once a frame."""
        if not 0 <= tool < len(self.config.tool_offsets_m):
            raise ValueError(f"tool: found {tool}, wanted 0 to {len(self.config.tool_offsets_m) - 1}")
        missing = sensor_effects.measure_pose(self._arrays.effects, self._arrays.rig, tool, self._position, self._quaternion)
        return Measured(self._position.copy(), self._quaternion.copy(), bool(missing))

    def measured_wrench(self) -> tuple[Array, Array]:
        """(force (3,) N, torque (3,) Nm) of the tip on the tissue, base frame, through the effects of port force_sensor."""
        self._wrench[:3] = self.contact_force_N
        self._wrench[3:] = self.contact_torque_Nm
        sensor_effects.measure_wrench(self._arrays.effects, self._arrays.rig, self._wrench)
        return self._wrench[:3].copy(), self._wrench[3:].copy()

    @property
    def contact_force_N(self) -> Array:
        """Force (3,) of the tip on the tissue, base frame (N)."""
        return -self._wall_force

    @property
    def contact_torque_Nm(self) -> Array:
        """Torque (3,) of that force about the wall's point, base frame (Nm)."""
        return np.array(_cross((self._tip - self._wall_point).tolist(), self.contact_force_N.tolist()))

    def truth(self) -> dict[str, Any]:
        """What no device shows, for reports and tests: SI scalars and arrays by name, and the planted effects."""
        parts = self._parts
        chain, wall, body = parts.chain_state, parts.tissue_state, parts.vessel_state
        tip, quaternion = self.sensor_pose(0.0)
        return {
            "time_s": self.time_s,
            "insertion_m": float(body.body_m),
            "roll_rad": float(body.roll_rad),
            "curvature_per_m": float(parts.rig.curvature),
            "wire_tension_N": float(parts.rig.load[2]),
            "exposed_m": float(chain.exposed_m),
            "tip_m": tip,
            "tip_quaternion_wxyz": quaternion,
            "contact_force_N": self.contact_force_N,
            "depth_m": float(wall.depth_m),
            "heart_m": float(parts.heart_state.displacement_m),
            "slack_force_N": float(body.link_force_N),
            "base_force_N": chain.base_force.copy(),
            "base_moment_Nm": chain.base_moment.copy(),
            "strain_rate_per_m_s": float(chain.residual),
            "effects": [effect.says() for effect in self.config.effects],
        }

    def shape(self, points: int = 60) -> Array:
        """Centre line (points, 3) from the sheath's exit to the tip (m)."""
        length = float(self._parts.chain_state.exposed_m)
        return np.array([self.sensor_pose(offset)[0] for offset in np.linspace(length, 0.0, points)])


def _cross(arm: Sequence[float], force: Sequence[float]) -> tuple[float, float, float]:
    (x, y, z), (fx, fy, fz) = arm, force
    return y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
