"""The tick and the plant without bytes between them: stages that obey, sensors with their rates, delays and noise.

For what needs thousands of seconds (tuning, gain sweeps, figures). Left out against `sim.scenario`: the board and its
firmware, the serial protocols, the encoders, the tracker's frame clock. Set-points take effect after the lead of the
board's queue, as whole steps.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.enums import CommandKind, Phase
from protocol.rig_file import Rig
from realtime.control.configure import tick_parameters
from realtime.control.records import INPUTS, OUTPUTS, STATE, new
from realtime.control.tick import tick
from sim.plant import Plant, PlantConfig

Array = NDArray[np.float64]
_START_NS = 1_000_000_000
_LISTEN_S = 0.3
_FORCE_DELAY_NS = 1_000_000


class IdealTrace(NamedTuple):
    """What happened, a row a tick: time since the start (s), true force into the wall (N), true tip (m), the wall's motion
    (m), stages (m, rad, rad), phase."""

    time_s: Array
    force_N: Array
    tip_m: Array
    wall_m: Array
    stage: Array
    phase: NDArray[np.int64]

    def since_contact(self) -> IdealTrace:
        """From the first tick in contact on, its time zero; empty where there was none."""
        touched = np.flatnonzero(self.phase == Phase.CONTACT)
        first = touched[0] if touched.size else self.time_s.size
        late = self.rows(slice(first, None))
        return late._replace(time_s=late.time_s - (late.time_s[0] if late.time_s.size else 0.0))

    def rows(self, which: Any) -> IdealTrace:
        """Some of the rows: a mask, an index or a slice."""
        return IdealTrace(
            self.time_s[which],
            self.force_N[which],
            self.tip_m[which],
            self.wall_m[which],
            self.stage[which],
            self.phase[which],
        )


class IdealRig:
    """`rig`'s tick on a `config` plant, started where the plant starts, listening for a moment, then armed."""

    def __init__(
        self,
        rig: Rig,
        config: PlantConfig,
        seed: int = 0,
        force_source: str = "sensor",
        extra_delay_s: float = 0.0,
        with_force: bool = True,
    ) -> None:
        """`extra_delay_s`: poses and forces arrive so much later (stamps stay true), to find a loop's margin."""
        self.rig, self.plant = rig, Plant(replace(config, tool_offsets_m=rig.tracker.tool_offsets_m), seed)
        self.params, self.state = tick_parameters(rig, force_source), new(STATE)
        self.inputs, self.outputs = new(INPUTS), new(OUTPUTS)
        self._random = np.random.default_rng([seed, 17])
        self._period_ns = round(1e9 / rig.control.loop_hz)
        self._lead_ticks = max(1, round(rig.board.setpoint_lead_s * rig.control.loop_hz))
        self._extra_ns, self._with_force = round(extra_delay_s * 1e9), with_force
        self._now_ns, self._next_pose_ns = _START_NS, _START_NS
        self._poses: deque[tuple[int, int, Array, Array]] = deque()
        self._forces: deque[tuple[int, int, Array]] = deque()
        self._pending: deque[Array] = deque([np.array(config.start_stage, float)] * self._lead_ticks)
        self._rows: list[tuple[float, ...]] = []
        u = self.inputs[0]
        u.board.ready = 1
        u.command.normal[:] = config.tissue.normal
        self._per_unit = np.array([rig.stage(axis).steps_per_unit for axis in range(3)])
        u.board.position_steps[:] = np.round(np.array(config.start_stage) * self._per_unit)
        self.run(_LISTEN_S)
        self._command(CommandKind.HOLD)
        self.run(0.02)

    def _command(self, kind: int, target_m: Array | None = None, force_N: float = 0.0) -> None:
        command = self.inputs[0].command
        command.armed, command.kind, command.force_N = 1, kind, force_N
        command.count += 1
        if target_m is not None:
            command.target_m[:] = target_m

    def press(self, force_N: float, target_m: Array, seconds: float) -> IdealTrace:
        """Approach the wall towards `target_m` (3,), hold `force_N` (N); all of it for `seconds`."""
        self._command(CommandKind.CONTACT, np.asarray(target_m, float), force_N)
        return self.run(seconds)

    def go(self, target_m: Array, seconds: float) -> IdealTrace:
        """Position control towards `target_m` (3,) for `seconds`."""
        self._command(CommandKind.POSITION, np.asarray(target_m, float))
        return self.run(seconds)

    def run(self, seconds: float) -> IdealTrace:
        """So many seconds; the trace of them."""
        self._rows = []
        for _ in range(round(seconds * 1e9 / self._period_ns)):
            self._step()
        table = np.array(self._rows).reshape(-1, 10)
        return IdealTrace(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5], table[:, 6:9], table[:, 9].astype(np.int64))

    def _step(self) -> None:
        self._now_ns += self._period_ns
        self.plant.step(self._period_ns * 1e-9, self._pending.popleft())
        self._measure()
        self._deliver()
        u, y = self.inputs[0], self.outputs[0]
        u.now_ns = u.board.arrival_ns = self._now_ns
        tick(self.params, self.state, self.inputs, self.outputs)
        steps = np.asarray(y.position_steps if y.valid else u.board.position_steps, float)
        self._pending.append(steps / self._per_unit)
        if y.valid:
            u.board.position_steps[:] = y.position_steps
            u.board.encoder_counts[:] = y.position_steps
        truth, normal = self.plant, np.asarray(self.plant.config.tissue.normal)
        tip = truth.sensor_pose(0.0)[0]
        self._rows.append(
            (
                (self._now_ns - _START_NS) * 1e-9,
                -float(truth.contact_force_N @ normal),
                *tip,
                float(truth._parts.heart_state.displacement_m),
                *self._pending[0],
                float(y.phase),
            )
        )

    def _measure(self) -> None:
        tracker, sensor = self.rig.tracker, self.rig.force_sensor
        if self._now_ns >= self._next_pose_ns:
            self._next_pose_ns += round(1e9 / tracker.rate_hz)
            position, quaternion = self.plant.sensor_pose(0.0)
            position = position + tracker.position_noise_m * self._random.standard_normal(3)
            arrival = self._now_ns + round(tracker.latency_s * 1e9) + 1_500_000 + self._extra_ns
            self._poses.append((self._now_ns, arrival, position, quaternion))
        if self._with_force:
            force = self.plant.contact_force_N + sensor.noise_N * self._random.standard_normal(3)
            self._forces.append((self._now_ns, self._now_ns + _FORCE_DELAY_NS + self._extra_ns, force))

    def _deliver(self) -> None:
        u = self.inputs[0]
        while self._poses and self._poses[0][1] <= self._now_ns:
            stamp, arrival, position, quaternion = self._poses.popleft()
            u.tip.count += 1
            u.tip.stamp_ns, u.tip.arrival_ns = stamp, arrival
            u.tip.position_m[:], u.tip.quaternion_wxyz[:] = position, quaternion
        while self._forces and self._forces[0][1] <= self._now_ns:
            stamp, arrival, force = self._forces.popleft()
            u.sensor.count += 1
            u.sensor.stamp_ns, u.sensor.arrival_ns = stamp, arrival
            u.sensor.force_N[:] = force
