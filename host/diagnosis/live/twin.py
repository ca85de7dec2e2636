"""The twin of a running rig: one row for each tracker frame from its messages; the nominal model of kind rig with the rod
model.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.dataset import Recording
from host.diagnosis.model.model import ActiveEffect, Segment
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.model.operators import fill
from host.diagnosis.models.rig import FORCE, FORCE_ROWS, HANDLES, POSE_ROWS, SHAFT, TIP, RigModel, RigSegment
from host.diagnosis.models.rig_kernel import matrices, rotation_logs
from host.mechanics.cosserat import CosseratSolution, solve_cosserat
from protocol.catheter import Catheter, load_catheter
from protocol.rig_file import Rig
from protocol.topics import ForceSensor, Message, Pose, Stage

Array = npt.NDArray[np.float64]
COLUMNS = (*HANDLES, *TIP, *SHAFT, *FORCE)
KEPT_STAGES, KEPT_FORCES = 4000, 4000
FORCE_HALF_NS = 5_000_000  # forces this near a frame are averaged into its row
EVERY, ROUNDS = 4, 3
OFFSETS = (1, 3, 5)  # places of insertion, roll and knob offset among the nominal parameters
LONGEST_DELAY_S = 0.025
LATEST_NS = 60_000_000  # a frame waits so long for the stage's and the second tool's message


@dataclass(frozen=True)
class TwinFit:
    """The twin fitted to a rig: nominal parameters, and the delay (s) with which poses follow handle and force."""

    theta: Array
    delay_s: float
    error: float  # RMS left, in units of 0.3 mm and 4 mrad

    def applied(self, recording: Recording) -> Recording:
        """Return `recording` with its inputs delayed as the poses are."""
        return delayed(recording, self.delay_s)


def delayed(recording: Recording, delay_s: float) -> Recording:
    """Handle and force as they were delay_s (s) before each frame."""
    time_s = recording.time_s
    late = {name: np.interp(time_s - delay_s, time_s, recording.channels[name]) for name in (*HANDLES, *FORCE)}
    return replace(recording, channels=recording.channels | late)


def thinned(recording: Recording, every: int) -> Recording:
    """Keep every `every`-th row of `recording`."""
    return replace(
        recording,
        time_s=recording.time_s[::every],
        dt_s=recording.dt_s * every,
        fit=recording.fit[::every],
        heldout=recording.heldout[::every],
        channels={k: v[::every] for k, v in recording.channels.items()},
    )


class Twin(RigModel):
    """The nominal model of kind rig for a rig file; backlash and knob curve are applied before (see FrameCollector).

    The model bends by linear elasticity, which is not enough for a hold at 0.2 N: the rod model's difference is
    added, at the nominal parameters, so that effects act through the model. The wall moves: forces are an input only.
    """

    def __init__(self, rig: Rig, catheter: Catheter | None = None) -> None:
        self.catheter: Catheter = catheter or load_catheter(rig.catheter.name)
        mechanics = self.catheter.cosserat
        if mechanics is None:
            raise ValueError(
                f"catheter.name: found {rig.catheter.name!r} without spatial mechanics, wanted one that has them"
            )
        super().__init__(_spec(rig, mechanics.EI1, mechanics.GJ / mechanics.EI1))
        self.shaft_offset_m = rig.tracker.shaft_sensor_offset_m
        self.softness = 1.0

    def calibrate(self, recording: Recording, rest: Callable[[], None] = lambda: None) -> TwinFit:
        """Offsets, softness and delay by Gauss-Newton on every EVERY-th frame of `recording` (its poses, free run)."""
        theta = np.array([p.grid[0] for p in self.parameters])
        scale = np.tile(np.repeat([3e-4, 4e-3], 3), 2)[:, None]

        def errors(z: Array) -> Array:
            self.softness = float(np.exp(np.clip(z[3], -0.7, 0.7)))
            moved = theta.copy()
            moved[list(OFFSETS)] += z[:3]
            rest()
            segment = self.prepare(thinned(delayed(recording, float(z[4])), EVERY))
            self.correct(segment, moved)
            r = (segment.y - self.simulate(segment, moved, []))[POSE_ROWS] / scale
            return np.clip(np.nan_to_num(r), -8.0, 8.0).ravel()

        z, steps = np.zeros(5), np.array([1e-4, 2e-3, 0.1, 0.02, 2e-3])
        r = errors(z)
        for _ in range(ROUNDS):
            J = np.array([(errors(z + step) - r) / by for step, by in zip(np.diag(steps), steps, strict=True)]).T
            z = z - np.linalg.lstsq(J * steps, r, rcond=1e-6)[0] * steps
            z[4] = min(max(z[4], 0.0), LONGEST_DELAY_S)
            r = errors(z)
        theta[list(OFFSETS)] += z[:3]
        return TwinFit(theta, float(z[4]), float(np.sqrt(np.mean(r**2))))

    def prepare(self, recording: Recording) -> RigSegment:
        """As the nominal model does, but with the force as it was recorded: it is an average over a frame already."""
        segment = super().prepare(recording)
        segment.force = np.vstack([np.nan_to_num(fill(recording.channels[name])) for name in FORCE])
        segment.inputs["axial_force"] = self.normal @ segment.force
        return segment

    def correct(self, segment: Segment, theta: Array) -> None:
        """Makes `simulate` of `segment` exact at `theta` (nominal parameters) without effects."""
        assert isinstance(segment, RigSegment)
        segment.exact = self._exact(segment, theta) - super().simulate(segment, theta, [])
        segment.exact[FORCE_ROWS] = 0.0

    def simulate(self, segment: Segment, theta: Array, active: list[ActiveEffect]) -> Array:
        """Outputs (15, n) of the nominal model, plus what the rod model adds where `correct` was called."""
        assert isinstance(segment, RigSegment)
        nominal = super().simulate(segment, theta, active)
        return nominal if segment.exact is None else np.asarray(nominal + segment.exact)

    def _exact(self, segment: RigSegment, theta: Array) -> Array:
        """Outputs (15, n) by the rod model, NaN where it has no equilibrium."""
        insertion, roll, kappa = self.links(segment, theta, [])
        push, start = segment.force * self.softness, None
        tip, shaft = np.full((2, 7, segment.n), np.nan)
        for i in range(segment.n):
            found = self._solve(insertion[i], roll[i], kappa[i], -push[:, i], start)
            start = found if found.converged else None
            if found.converged:
                tip[:, i] = [*found.tip_position_m, *found.tip_quaternion_wxyz]
                shaft[:, i] = [*found.station_positions_m[0], *found.station_quaternions_wxyz[0]]
        rows = []
        for pose, reference in zip((tip, shaft), segment.reference, strict=True):
            good = np.isfinite(pose[0])
            turn = rotation_logs(reference, matrices(np.where(good, pose[3:], np.array([1.0, 0.0, 0.0, 0.0])[:, None])))
            rows += [pose[:3], np.where(good, turn, np.nan)]
        return np.vstack([*rows, segment.force])

    def _solve(
        self, insertion: float, roll: float, kappa: float, force: Array, start: CosseratSolution | None
    ) -> CosseratSolution:
        return solve_cosserat(
            self.catheter,
            float(insertion),
            float(kappa),
            force,
            stations_m=(self.shaft_offset_m,),
            roll_rad=float(roll),
            start=start,
        )


def _spec(rig: Rig, rigidity: float, torsion_to_bending: float) -> NominalSpec:
    """The nominal file of the twin: everything held."""
    known = rig.transmission
    values = {
        "insertion_gain": known.insertion_slope,
        "insertion_offset_m": known.insertion_at_home_m,
        "roll_slope": known.roll_slope,
        "roll_offset_rad": 0.0,
        "knob_gain_per_m_rad": 1.0,
        "knob_offset_per_m": 0.0,
        "bending_stiffness_N_m2": rigidity,
        "wall_distance_m": 1.0,
        "wall_stiffness_N_per_m": 1000.0,
    }
    return NominalSpec.model_validate(
        {
            "name": f"twin of {rig.name}",
            "kind": "rig",
            "data": {"time": "time_s"},
            "rig": {
                "distal_length_m": rig.catheter.distal_length_m,
                "shaft_sensor_offset_m": rig.tracker.shaft_sensor_offset_m,
                "torsion_to_bending": torsion_to_bending,
            },
            "parameters": {key: {"value": float(value), "free": False} for key, value in values.items()},
        }
    )


class FrameCollector:
    """Collects stage, poses and forces that arrive in any order; `rows` (n, columns) are on an even grid of frames."""

    def __init__(self, rig: Rig, keep_s: float) -> None:
        self._transmission = rig.transmission
        self.period_ns = round(1e9 / rig.tracker.rate_hz)
        self._stages: deque[tuple[int, float, float, float]] = deque(maxlen=KEPT_STAGES)
        self._forces: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=KEPT_FORCES)
        self._tips: dict[int, Pose] = {}
        self._shafts: dict[int, Pose] = {}
        self._body: float | None = None
        self.stamps_ns: deque[int] = deque(maxlen=round(keep_s * 1e9 / self.period_ns))
        self.rows: deque[Array] = deque(maxlen=self.stamps_ns.maxlen)

    def receive(self, topic: str, message: Message) -> None:
        """Take in one message; those of other topics are not looked at."""
        if isinstance(message, Stage) and message.encoder_insertion_m is not None:
            self._stage(message)
        elif isinstance(message, ForceSensor) and message.status == 0:
            self._forces.append((message.stamp_ns, tuple(message.force_N)))
        elif isinstance(message, Pose):
            (self._tips if topic == "pose/tip" else self._shafts)[message.frame] = message

    def _stage(self, stage: Stage) -> None:
        """The handle behind the known play and the known curve of the knob."""
        t = self._transmission
        handle, half = float(stage.encoder_insertion_m or 0.0), 0.5 * t.insertion_backlash_m
        self._body = handle if self._body is None else min(max(self._body, handle - half), handle + half)
        curvature = float(np.interp(stage.encoder_knob_rad or 0.0, t.knob_rad, t.curvature_per_m))
        self._stages.append((stage.stamp_ns, self._body, float(stage.encoder_roll_rad or 0.0), curvature))

    def settle(self) -> int:
        """Rows that have become complete since the last call are added; how many."""
        if not self._stages:
            return 0
        newest, added = self._stages[-1][0], 0
        for frame in sorted(self._tips):
            tip = self._tips[frame]
            if newest < tip.stamp_ns or (frame not in self._shafts and newest < tip.stamp_ns + LATEST_NS):
                break
            del self._tips[frame]
            added += self._add(tip, self._shafts.pop(frame, None))
        self._shafts = {frame: pose for frame, pose in self._shafts.items() if newest < pose.stamp_ns + LATEST_NS}
        return added

    def _add(self, tip: Pose, shaft: Pose | None) -> int:
        """One row, after as many empty ones as frames are missing before it."""
        lost = round((tip.stamp_ns - self.stamps_ns[-1]) / self.period_ns) - 1 if self.stamps_ns else 0
        if lost < 0:
            return 0
        for _ in range(min(lost, self.rows.maxlen or 0)):
            self.append(self.stamps_ns[-1] + self.period_ns, np.full(len(COLUMNS), np.nan))
        stamp_ns = tip.stamp_ns
        self.append(stamp_ns, np.array([*self._handle(stamp_ns), *_numbers(tip), *_numbers(shaft), *self._force(stamp_ns)]))
        return lost + 1

    def append(self, stamp_ns: int, row: Array) -> None:
        """Add a finished row (columns,): of a frame, or of a recording that is watched again."""
        self.stamps_ns.append(stamp_ns)
        self.rows.append(row)

    def _handle(self, stamp_ns: int) -> list[float]:
        """Handle (3,) at `stamp_ns`, straight between messages."""
        after = self._stages[-1]
        for before in reversed(self._stages):
            if before[0] <= stamp_ns:
                share = (stamp_ns - before[0]) / max(after[0] - before[0], 1)
                return (
                    [a + share * (b - a) for a, b in zip(before[1:], after[1:], strict=True)]
                    if after[0] > before[0]
                    else list(before[1:])
                )
            after = before
        return list(after[1:])

    def _force(self, stamp_ns: int) -> list[float]:
        near = []
        for stamp, force in reversed(self._forces):  # in the order of their stamps, newest first
            if stamp < stamp_ns - FORCE_HALF_NS:
                break
            if stamp <= stamp_ns + FORCE_HALF_NS:
                near.append(force)
        return [float(value) for value in np.mean(near, axis=0)] if near else [np.nan] * 3

    def recording(self, first: int, last: int | None = None) -> Recording:
        """Rows `first` to `last` as a recording, all of them to fit."""
        table = np.array(list(self.rows)[first:last])
        n, dt_s = len(table), self.period_ns * 1e-9
        channels: dict[str, Any] = {name: table[:, k] for k, name in enumerate(COLUMNS)}
        units = {"handle_insertion": "m", "handle_roll": "rad", "handle_knob": "rad"}
        time_s: Array = dt_s * np.arange(n, dtype=np.float64)
        return Recording("live", time_s, dt_s, True, channels, np.ones(n, bool), np.zeros(n, bool), units)


def _numbers(pose: Pose | None) -> list[float]:
    if pose is None or pose.missing or pose.position_m is None or pose.quaternion_wxyz is None:
        return [np.nan] * 7
    return [*map(float, pose.position_m), *map(float, pose.quaternion_wxyz)]
