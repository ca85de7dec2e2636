"""The simulated rig: board, stages, catheter, wall and sensor boxes, advanced together to a given virtual time."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np

from protocol.rig_file import Rig
from realtime.core.intake import quaternion_product, rotation
from realtime.core.lines import FromRig, ToRig
from sim.aurora_emulator import AuroraEmulator, AuroraEmulatorConfig, Pose
from sim.board import CPU_HZ, STEP_TIMER_CYCLES, BoardSlice, SimulatedBoard
from sim.net_ft_emulator import NetFtEmulator, NetFtEmulatorConfig
from sim.plant import Plant, PlantConfig
from sim.stages import SimulatedStages, StagesConfig


def simulated_plant(rig: Rig, seed: int, **changes: Any) -> Plant:
    """The plant that stands for `rig`: its sensors where the rig file has them, at home."""
    return Plant(PlantConfig(tool_offsets_m=rig.tracker.tool_offsets_m, **changes), seed)


class World:
    """Everything outside the computer. Time in ns from 0; the same seed and bytes give the same world.

    `digest` is a hash of all step edges and all true poses so far.
    """

    def __init__(self, rig: Rig, plant: Plant, board: SimulatedBoard, seed: int) -> None:
        self.rig, self.plant, self.board = rig, plant, board
        self.now_ns = 0
        self.edges = np.zeros(3, np.int64)
        self.edge_phases = np.zeros(STEP_TIMER_CYCLES, np.int64)  # edges by processor cycle within the step timer's period
        self.slice: BoardSlice | None = None
        self.peak_force_N = 0.0
        self.limit_bits, self.estop = 0, False
        tracker, sensor = rig.tracker, rig.force_sensor
        self.tracker = AuroraEmulator(
            AuroraEmulatorConfig(
                handles=tuple(tool.handle for tool in tracker.tools),
                rate_hz=tracker.rate_hz,
                latency_s=tracker.latency_s,
                position_noise_m=tracker.position_noise_m,
                orientation_noise_rad=tracker.orientation_noise_rad,
            ),
            seed=2 * seed + 1,
        )
        self.force_box = NetFtEmulator(
            NetFtEmulatorConfig(
                rate_hz=sensor.rate_hz,
                counts_per_N=sensor.counts_per_newton,
                counts_per_Nm=sensor.counts_per_newton_metre,
                force_noise_N=sensor.noise_N,
            ),
            seed=2 * seed + 2,
        )
        self._digest = hashlib.sha256()
        self.stages = SimulatedStages(
            StagesConfig(
                steps_per_unit=tuple(rig.stage(axis).steps_per_unit for axis in range(3)),  # type: ignore[arg-type]
                encoder_counts_per_step=tuple(  # type: ignore[arg-type]
                    rig.stage(axis).encoder_counts_per_step for axis in range(3)
                ),
            ),
            plant.config.effects,
        )
        self._switches = {
            axis: (1 if stage.home_end == "max" else -1, round(stage.home_unit * stage.steps_per_unit))
            for axis, stage in ((axis, rig.stage(axis)) for axis in range(3))
            if stage.home_end
        }
        turn = np.array(tracker.base_from_tracker_wxyz)
        self._tracker_from_base = rotation(turn).T
        self._tracker_turn = turn * (1.0, -1.0, -1.0, -1.0)
        self._tracker_shift_m = np.array(tracker.base_from_tracker_m)
        self._sensor_from_base = rotation(sensor.base_from_sensor_wxyz).T

    @property
    def digest(self) -> str:
        """Hash of all step edges (cycle, axis, sign) and true tip poses since the start."""
        return self._digest.hexdigest()

    @property
    def edge_jitter_s(self) -> float:
        """Shortest span of the step timer's period that holds all edges on the pins: how unevenly they come."""
        held = np.flatnonzero(self.edge_phases)
        if len(held) < 2:
            return 0.0
        longest_gap = int(np.diff(held, append=held[0] + STEP_TIMER_CYCLES).max())
        return (STEP_TIMER_CYCLES - longest_gap) / CPU_HZ

    @property
    def steps(self) -> np.ndarray:
        """Steps (3,) counted on the pins since the start."""
        return self.stages.step_counts

    def exchange(self, until_ns: int, leaving: ToRig) -> FromRig:
        """Take what the computer sent, let time run to `until_ns` in slices of 1 ms, return what arrives by then."""
        for action in leaving.tracker_line:
            self.tracker.set_line(action.baud)
            if action.break_s > 0:
                self.tracker.serial_break(self.now_ns)
        self.tracker.feed(leaving.tracker, self.now_ns)
        for datagram in leaving.force:
            self.force_box.feed(datagram, self.now_ns)
        to_board, from_board = leaving.board, b""
        while self.now_ns < until_ns:
            next_ns = min(self.now_ns + 1_000_000, until_ns)
            from_board += self.advance(next_ns, to_board)
            to_board = b""
        return FromRig(from_board, self.tracker.read(until_ns), self.force_box.read(until_ns))

    def advance(self, until_ns: int, to_board: bytes) -> bytes:
        """Let time run to `until_ns` (at most a few ms on) with bytes for the board; returns what the board sent."""
        limit_bits = self.limit_bits | self._home_switches()
        part = self.board.exchange(until_ns // 1000, to_board, limit_bits, self.estop, self.stages.encoder_counts)
        self.slice = part
        if len(part.edge_axis):
            np.add.at(self.edges, part.edge_axis, 1)
            np.add.at(self.edge_phases, part.edge_cycle % STEP_TIMER_CYCLES, 1)
        dt_s = (until_ns - self.now_ns) * 1e-9
        self.plant.step(dt_s, self.stages.advance(dt_s, part.edge_axis, part.edge_sign))
        self._sample(until_ns)
        self.now_ns = until_ns
        force_N = self.plant.contact_force_N
        self.peak_force_N = max(self.peak_force_N, math.sqrt(force_N @ force_N))
        if len(part.edge_axis):
            for column in (part.edge_cycle, part.edge_axis, part.edge_sign):
                self._digest.update(column.tobytes())
        self._digest.update(self.plant.sensor_pose(0.0)[0].tobytes())
        return part.uart_out

    def _home_switches(self) -> int:
        """Limit bits of the axes with a home switch: open at and beyond its place, counted from where the stages began."""
        bits = 0
        for axis, (end, place) in self._switches.items():
            if end * (int(self.stages.step_counts[axis]) - place) >= 0:
                bits |= 1 << (2 * axis + (end > 0))
        return bits

    def _sample(self, until_ns: int) -> None:
        """Let the sensors measure what falls due. Their sampling is placed at the end of the 1 ms slice it is in."""
        while self.force_box.next_sample_ns <= until_ns:
            force_N, torque_Nm = self.plant.measured_wrench()
            self.force_box.sample(
                self.force_box.next_sample_ns, self._sensor_from_base @ force_N, self._sensor_from_base @ torque_Nm
            )
        while self.tracker.next_frame_ns <= until_ns:
            poses = [self._in_tracker_frame(tool) for tool in range(len(self.rig.tracker.tools))]
            self.tracker.sample(self.tracker.next_frame_ns, poses)

    def _in_tracker_frame(self, tool: int) -> Pose | None:
        measured = self.plant.measured_pose(tool)
        if measured.missing:
            return None
        return (
            self._tracker_from_base @ (measured.position_m - self._tracker_shift_m),
            quaternion_product(self._tracker_turn, measured.quaternion_wxyz),
        )
