"""Drives one stage after the other through sine sweeps, by the board's own set-points, and reports the result.

The realtime side of a rig's characterization: the drivers of the loop, no control law. The same turn-taking as
`realtime.core.lockstep`: bytes in, bytes out, one period a `step`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from protocol.errors import InputError
from protocol.rig_file import AXES, Rig
from protocol.setpoint_encoder import BUFFER_BYTES, encode_setpoint
from protocol.topics import Log, Stage
from realtime.control import stage_limiter
from realtime.control.configure import tick_parameters
from realtime.control.records import BOARD, FORCE, POSE, STAGE_STATE, new
from realtime.core import telemetry
from realtime.core.board_intake import axis_limits, take_status
from realtime.core.intake import Intake
from realtime.core.lines import FromRig, SensorClients, ToRig
from realtime.core.lockstep import Publish
from realtime.drivers.aurora import PoseSample
from realtime.drivers.stepper_board import BoardEventKind, LinkPhase, StepperBoardLink

# Between sweeps the stages move at these speeds (m/s, rad/s, rad/s), then rest.
MOVE_SPEED = (0.010, 0.8, 0.8)
REST_S = 0.5
DEVICES_WITHIN_S = 15.0
ARMED_WITHIN_S = 1.0
_LOST = (BoardEventKind.FAULT, BoardEventKind.RESET, BoardEventKind.MISMATCH)


@dataclass(frozen=True)
class Sweep:
    """`axis` goes `amplitude` (m or rad) either way about `centre` (3,), as a sine of `rate_rad_per_s`, `cycles` times."""

    axis: int
    centre: tuple[float, float, float]
    amplitude: float
    rate_rad_per_s: float
    cycles: int

    @property
    def seconds(self) -> float:
        """Return the sweep's duration in s."""
        return 2.0 * math.pi * self.cycles / self.rate_rad_per_s

    def at(self, time_s: float) -> np.ndarray:
        """Return the stage positions (3,) `time_s` after the start."""
        position = np.array(self.centre, float)
        position[self.axis] += self.amplitude * math.sin(self.rate_rad_per_s * time_s)
        return position


def check_sweeps(rig: Rig, sweeps: Sequence[Sweep]) -> None:
    """Check sweeps. Raises InputError if one leaves the travel, or exceeds the speed or acceleration of a stage."""
    for number, sweep in enumerate(sweeps):
        for axis in range(3):
            stage, swing = rig.stage(axis), sweep.amplitude if axis == sweep.axis else 0.0
            low, high = sweep.centre[axis] - swing, sweep.centre[axis] + swing
            if not (stage.min_unit <= low and high <= stage.max_unit):
                raise InputError.from_sentence(
                    f"sweeps.{number}.{AXES[axis]}: found {low:.4g} to {high:.4g}, "
                    f"wanted within {stage.min_unit} to {stage.max_unit}"
                )
        stage, rate = rig.stage(sweep.axis), sweep.rate_rad_per_s
        if not (0.0 < rate * sweep.amplitude <= 0.9 * stage.max_speed_unit_per_s):
            raise InputError.from_sentence(
                f"sweeps.{number}.rate_rad_per_s: found a peak speed of {rate * sweep.amplitude:.4g}, "
                f"wanted above 0 and at most {0.9 * stage.max_speed_unit_per_s:.4g} "
                f"(stages.{AXES[sweep.axis]})"
            )
        if rate * rate * sweep.amplitude > 0.5 * stage.max_accel_unit_per_s2 or sweep.cycles < 1:
            raise InputError.from_sentence(
                f"sweeps.{number}: found {sweep.cycles} cycles at {rate} rad/s, wanted at least one and an "
                "acceleration of at most half the stage's"
            )


class SweepLoop:
    """Brings the devices up, arms, runs the sweeps in turn, disarms. `finished` or `problem` say how it ended.

    Publishes `stage` (encoders, stamped with the board's time), the poses, and a `log` line of source
    `sweep` with the sweep as JSON at each begin and end. A device without data, a fault, a force above safety.over_force_N
    or `break_off` ends it: the stages brake, the board is disarmed.
    """

    def __init__(self, rig: Rig, sweeps: Sequence[Sweep], publish: Publish) -> None:
        check_sweeps(rig, sweeps)
        self.rig, self.sweeps, self.publish = rig, list(sweeps), publish
        self.period_ns = round(1e9 / rig.control.loop_hz)
        self.link = StepperBoardLink(axis_limits(rig))
        self.sensors = SensorClients(rig)
        self.current, self.finished, self.problem = -1, False, ""
        self._intake, self._stage_config = Intake(rig), tick_parameters(rig)[0].stage
        self._stage, self._board = new(STAGE_STATE)[0], new(BOARD)[0]
        self._records = {tool.handle: (tool.topic, new(POSE)[0]) for tool in rig.tracker.tools}
        self._force = new(FORCE)[0]
        self._buffer, self._number = np.zeros(BUFFER_BYTES, np.uint8), 0
        self._armed_ns, self._rest_ns, self._start_ns, self._pose_ns, self._force_ns, self._begin_ns = 0, 0, 0, 0, 0, -1
        self._step_ns = 0
        self._target = np.zeros(3)
        self._compile()

    def _compile(self) -> None:
        """Compile the kernels by one call without effect: the first call takes longer than the time limit of a device."""
        config, nowhere = self._stage_config, new(STAGE_STATE)[0]
        stage_limiter.apply(config, nowhere, 0, 0.0, self.period_ns * 1e-9)
        stage_limiter.brake(config, nowhere, 0, self.period_ns * 1e-9)
        encode_setpoint(self._buffer, 0, 0, 0, 0, np.zeros(3, np.int64))

    @property
    def done(self) -> bool:
        """Return whether the sweeps have ended and the stages are at rest, braked or stopped by the board."""
        moving = self.link.armed and bool(np.any(np.abs(self._stage.speed) > 1e-9))
        return (self.finished or bool(self.problem)) and not moving

    @property
    def progress(self) -> float:
        """Return the share of the sweeps that is done, 0 to 1."""
        return min(max(self.current, 0) / max(len(self.sweeps), 1), 1.0)

    def break_off(self, why: str) -> None:
        """End the sweeps early: the stages brake at the next step, and are disarmed at rest."""
        if not self.finished:
            self.problem = self.problem or why

    def step(self, now_ns: int, arriving: FromRig) -> ToRig:
        """Run one period: process the received data, return the data to send."""
        if self._begin_ns < 0:
            self._begin_ns = self._step_ns = now_ns
        self._own_gap(now_ns)
        self._take_board(arriving.board, now_ns)
        readings = self.sensors.feed(arriving, now_ns)
        self._take_poses(readings.poses, now_ns)
        for sample in readings.forces:
            self._intake.force(self._force, sample.stamp_ns, sample.arrival_ns, sample.force_N)
            self._force_ns = now_ns
        commands = self.link.advance(now_ns)
        if not self._armed_ns:
            commands += self._arm_when_ready(now_ns)
        elif not self.problem and not self.finished:
            self._watch(now_ns)
            self._follow(now_ns)
        frame = self._setpoint(now_ns)
        if self.done and self._armed_ns > 0:
            commands += self.link.disarm()
            self._armed_ns = -1
        return self.sensors.outgoing(frame + commands, now_ns)

    def _arm_when_ready(self, now_ns: int) -> bytes:
        if self.link.phase is LinkPhase.READY and self._pose_ns and self._force_ns and self.link.status is not None:
            if self.problem:
                return b""
            self._watch(now_ns)
            if self.problem:
                return b""
            self._armed_ns = now_ns
            self._stage.position[:] = np.array(self.link.status.position_steps) / self._stage_config.steps_per_unit
            self._target[:] = self._stage.position
            return self.link.arm()
        if now_ns - self._begin_ns > DEVICES_WITHIN_S * 1e9:
            poses, forces = "poses" if self._pose_ns else "no pose", "forces" if self._force_ns else "no force"
            self.break_off(
                f"devices: found board {self.link.phase.value}, {poses}, {forces} after "
                f"{DEVICES_WITHIN_S:.0f} s, wanted all ready"
            )
        return b""

    def _own_gap(self, now_ns: int) -> None:
        """End early if this loop itself stalled, before a device is reported for it."""
        gap_ns, self._step_ns = now_ns - self._step_ns, now_ns
        if self._armed_ns > 0 and gap_ns > self.rig.safety.stop_after_s * 1e9:
            self.break_off(
                f"computer: found that the loop of the sweeps stalled for {gap_ns * 1e-9:.2f} s, wanted a "
                f"turn every {self.period_ns * 1e-6:g} ms"
            )

    def _watch(self, now_ns: int) -> None:
        limits, status = self.rig.safety, self.link.status
        force_N = float(np.linalg.norm(self._force.force_N))
        received_ns = {
            "tracker": self._pose_ns,
            "force sensor": self._force_ns,
            "board": now_ns if status is None else status.arrival_ns,
        }
        for device, last_ns in received_ns.items():
            if now_ns - last_ns > limits.stop_after_s * 1e9:
                self.break_off(
                    f"{device}: found no data for {(now_ns - last_ns) * 1e-9:.2f} s, "
                    f"wanted at most {limits.stop_after_s} (safety.stop_after_s)"
                )
        if not force_N <= limits.over_force_N:
            self.break_off(f"force: found {force_N:.2f} N, wanted free space (safety.over_force_N {limits.over_force_N})")
        if self._armed_ns and not self.link.armed and now_ns - self._armed_ns > ARMED_WITHIN_S * 1e9:
            self.break_off(f"board: found it not armed after {ARMED_WITHIN_S:.0f} s, wanted it to obey")

    def _follow(self, now_ns: int) -> None:
        """Move to the centre of the next sweep, rest there, then follow the sine; do nothing before the board is armed."""
        if not self.link.armed:
            return
        if self._start_ns:
            sweep = self.sweeps[self.current]
            time_s = (now_ns - self._start_ns) * 1e-9
            if time_s >= sweep.seconds:
                self._log_event(now_ns, "end", sweep)
                self._start_ns = 0
            else:
                self._target[:] = sweep.at(time_s)
                return
        if self.current + 1 == len(self.sweeps):
            self.current += 1
            self.finished = True
            return
        self._approach(now_ns, self.sweeps[self.current + 1])

    def _approach(self, now_ns: int, sweep: Sweep) -> None:
        gap = np.array(sweep.centre) - self._target
        reach = np.array(MOVE_SPEED) * self.period_ns * 1e-9
        self._target += np.clip(gap, -reach, reach)
        if np.any(np.abs(gap) > 1e-12) or not self._rest_ns:
            self._rest_ns = now_ns
        elif now_ns - self._rest_ns >= REST_S * 1e9:
            self._rest_ns, self._start_ns = 0, now_ns
            self.current += 1
            self._log_event(now_ns, "begin", sweep)

    def _log_event(self, now_ns: int, event: str, sweep: Sweep) -> None:
        text = json.dumps({"event": event, "number": self.current, **asdict(sweep)})
        self.publish("log", Log(stamp_ns=now_ns, level="info", source="sweep", text=text))

    def _setpoint(self, now_ns: int) -> bytes:
        """Move the stages by one period towards the target (to rest after a problem) and return the frame for the board."""
        if self._armed_ns <= 0 or not self.link.armed:
            return b""
        period_s = self.period_ns * 1e-9
        for axis in range(3):
            if self.problem:
                stage_limiter.brake(self._stage_config, self._stage, axis, period_s)
            else:
                stage_limiter.apply(self._stage_config, self._stage, axis, self._target[axis], period_s)
        self._number = (self._number + 1) & 0xFFFF
        lead_ns = round(self.rig.board.setpoint_lead_s * 1e9)
        execute_us = ((now_ns + lead_ns - int(self._board.mcu_offset_ns)) // 1000) & 0xFFFFFFFF
        steps = np.round(self._stage.position * self._stage_config.steps_per_unit).astype(np.int64)
        n = encode_setpoint(
            self._buffer, self._number & 0xFF, self._number, execute_us, round(self.rig.board.setpoint_expiry_s * 1e6), steps
        )
        return self._buffer[:n].tobytes()

    def _take_board(self, data: bytes, now_ns: int) -> None:
        for event in self.link.feed(data, now_ns):
            if event.kind is BoardEventKind.STATUS:
                take_status(self._board, self.link, now_ns)
                self._publish_stage()
            elif event.kind in _LOST:
                self.break_off(event.message)

    def _publish_stage(self) -> None:
        status = self.link.status
        if status is None:
            return
        board_us = (status.arrival_ns - int(self._board.mcu_offset_ns)) // 1000
        measured_ns = status.arrival_ns - 1000 * ((board_us - status.mcu_time_us) % (1 << 32))
        counts = [self.rig.stage(axis).encoder_counts_per_step for axis in range(3)]
        encoder = np.array(status.encoder_counts) / counts / self._stage_config.steps_per_unit
        self.publish(
            "stage",
            Stage(
                stamp_ns=max(measured_ns, 0),
                command_insertion_m=float(self._stage.position[0]),
                command_roll_rad=float(self._stage.position[1]),
                command_knob_rad=float(self._stage.position[2]),
                encoder_insertion_m=float(encoder[0]),
                encoder_roll_rad=float(encoder[1]),
                encoder_knob_rad=float(encoder[2]),
            ),
        )

    def _take_poses(self, samples: list[PoseSample], now_ns: int) -> None:
        for sample in samples:
            if sample.missing or sample.tool not in self._records:
                continue
            topic, record = self._records[sample.tool]
            self._intake.pose(record, sample.stamp_ns, sample.arrival_ns, sample.position_m, sample.quaternion_wxyz)
            if topic == "pose/tip":
                self._pose_ns = now_ns
            self.publish(topic, telemetry.pose_message(record, sample.frame, sample.quality_m))
