"""Runs of the simulated rig that the control study is made of: hold on a beating wall, go to points, one pose that jumps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.service import DEFAULT_ESTIMATOR, EstimationService, load_estimator
from protocol.enums import Phase
from protocol.rig_file import Rig, parse_rig
from protocol.topics import Message, RigCause
from realtime.control import free_tip, target_predictor
from realtime.control.configure import tick_parameters
from realtime.control.records import TARGET_STATE, new
from realtime.control.target_models import LOCAL, position
from realtime.core.lockstep import Publish
from sim import heart
from sim.aurora_emulator import Pose
from sim.forked_board import forkable_board
from sim.heart import HeartConfig
from sim.plant import PlantConfig
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

Array = NDArray[np.float64]
JOB = ContactJob(target_m=TARGET_M)
WANTED_N = JOB.force_N
FAR_AWAY_M = (0.0, 0.0, 0.5)
REGULAR, STILL = HeartConfig(), HeartConfig(beat_m=0.0, respiration_m=0.0)
IRREGULAR = HeartConfig(irregularity=0.1, premature_share=0.05)
# The force is judged from here on after contact, when rates and play are learned; the touch over the time before.
SETTLED_S = 5.0
AHEAD_S = 0.040


class Held(NamedTuple):
    """A row a tick since contact: time (s), true force into the wall (N), phase. `reached`: whether there was contact."""

    time_s: Array
    force_N: Array
    phase: NDArray[np.int64]
    reached: bool

    def rms_N(self, wanted_N: float) -> float:
        """Return the RMS error (N) relative to `wanted_N` after settling."""
        return float(np.sqrt(np.mean((self.force_N[self.time_s > SETTLED_S] - wanted_N) ** 2)))

    def spread_N(self) -> float:
        """RMS force about its mean once settled."""
        return float(np.std(self.force_N[self.time_s > SETTLED_S]))

    def mean_N(self) -> float:
        """Return the mean force (N) after settling."""
        return float(np.mean(self.force_N[self.time_s > SETTLED_S]))

    def longest_loss_s(self) -> float:
        """Longest time without contact after the first touch; infinite if there was none."""
        if not self.reached:
            return float("inf")
        touching = (self.force_N > 0.0) & (self.phase == Phase.CONTACT)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], ~touching, [False])).astype(np.int8)))
        period_s = float(self.time_s[1] - self.time_s[0])
        return float(np.max(edges[1::2] - edges[::2], initial=0)) * period_s

    def overshoot_N(self, wanted_N: float) -> float:
        """Greatest force of the touch above the wanted one."""
        return float(np.max(self.force_N[self.time_s <= SETTLED_S], initial=0.0) - wanted_N)

    def kept(self) -> float:
        """Share of the time in contact, from the first touch on."""
        return float(np.mean((self.force_N > 0.0) & (self.phase == Phase.CONTACT))) if self.reached else 0.0


def with_control(rig: Rig, section: str = "control", **values: object) -> Rig:
    """`rig` with values of one section changed. Raises InputError."""
    data = rig.effective()
    data[section] = {**data[section], **values}
    return parse_rig(data, "control study")


def _silent(topic: str, message: Message) -> None:
    """Ignore the loop's messages: the study reads the simulated world."""


def _scenario(
    rig: Rig,
    seed: int,
    source: str = "sensor",
    world_type: type[World] = World,
    publish: Publish = _silent,
    **plant: Any,
) -> Scenario:
    estimator = EstimationService(load_estimator(DEFAULT_ESTIMATOR, rig)) if source == "estimate" else None
    world = world_type(rig, simulated_plant(rig, seed, **plant), forkable_board("native"), seed)
    return Scenario(rig, world, publish, estimator=estimator, force_source=source)


def hold(
    rig: Rig,
    seed: int,
    beat: HeartConfig,
    seconds: float,
    source: str = "sensor",
    job: ContactJob = JOB,
    still_after_s: float = np.inf,
    publish: Publish = _silent,
    **plant: Any,
) -> Held:
    """Approach and press for `seconds`; from `still_after_s` after contact on, the catheter is held still.

    job: where, in which direction, with what force. plant: parts of `sim.plant.PlantConfig` that are not the default ones.
    """
    run = _scenario(rig, seed, source, publish=publish, heart=beat, **plant)
    rows: list[tuple[float, float, int]] = []
    if not run.arm():
        return Held(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), False)
    run._shape(job)
    run.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)

    def watch() -> bool:
        rows.append((run.now_ns * 1e-9, float(run.world.plant.contact_force_N @ job.into), run.phase))
        return False

    reached = run.run(job.approach_s, lambda: run.phase == Phase.CONTACT)
    if reached:
        run.run(min(seconds, still_after_s), watch)
        if still_after_s < seconds:
            run.command("target", "hold")
            run.run(seconds - still_after_s, watch)
    table = np.array(rows).reshape(-1, 3)
    time_s = table[:, 0] - (table[0, 0] if len(table) else 0.0)
    return Held(time_s, table[:, 1], table[:, 2].astype(np.int64), reached)


def still(rig: Rig, seed: int, seconds: float, beat: HeartConfig = REGULAR, job: ContactJob = JOB, **plant: Any) -> float:
    """RMS force (N) of a catheter held still in the beating wall, about its own mean: the most favourable for it."""
    held = hold(rig, seed, beat, SETTLED_S + seconds, still_after_s=SETTLED_S, job=job, **plant)
    return held.spread_N()


class Reached(NamedTuple):
    """Going to points, a row a goal: distance, RMS error after `within_s`, overshoot (m), time to stay within 1 mm (s).

    stopped_by: name of the failsafe's first cause, if it ended the motion; the goals after it were refused.
    """

    distance_m: Array
    rms_m: Array
    overshoot_m: Array
    settled_s: Array
    stopped_by: str = ""


def random_goals(rig: Rig, count: int, seed: int) -> Array:
    """Points (count, 3) in free space, each 20 to 35 mm from the one before, on one side of the bend: roll within 70 deg."""
    rng, kinematics, out = np.random.default_rng(seed), tick_parameters(rig)[0].kinematics, np.zeros(3)
    goals: list[Array] = []
    last = np.array(TARGET_M)
    while len(goals) < count:
        joint = np.array([rng.uniform(-0.085, -0.030), rng.uniform(-1.2, 1.2), rng.uniform(0.2, 1.3)])
        out[:] = free_tip.apply(kinematics, joint)
        if 0.020 < np.linalg.norm(out - last) < 0.035:
            goals.append(out.copy())
            last = out.copy()
    return np.array(goals)


def go_to(rig: Rig, goals: Array, seed: int, within_s: float = 2.0, seconds: float = 2.5, **plant: Any) -> Reached:
    """The tip to each of `goals` (n, 3) in turn, `seconds` each; judged by the true tip. Empty if not armed.

    plant: parts of `sim.plant.PlantConfig` that are not the default ones, other than the wall, which is far away.
    """
    wall = replace(PlantConfig().tissue, point_m=FAR_AWAY_M)
    causes: list[str] = []

    def publish(topic: str, message: Message) -> None:
        if isinstance(message, RigCause) and message.name:
            causes.append(message.name)

    run = _scenario(rig, seed, publish=publish, tissue=wall, **plant)
    rows: list[tuple[float, ...]] = []
    if not run.arm():
        none = np.zeros(0)
        return Reached(none, none, none, none, causes[0] if causes else "not armed")
    for goal in goals:
        path: list[Array] = []

        def watch(path: list[Array] = path) -> bool:
            path.append(run.world.plant.sensor_pose(0.0)[0])
            return False

        run.command("target", "position", target_m=tuple(map(float, goal)))
        run.run(seconds, watch)
        rows.append(_judged(np.array(path), goal, round(within_s * 1000)))
    stopped_by = causes[0] if causes and run.phase != Phase.POSITION else ""
    distance_m, rms_m, overshoot_m, settled_s = np.array(rows).reshape(-1, 4).T
    return Reached(distance_m, rms_m, overshoot_m, settled_s, stopped_by)


def _judged(tip_m: Array, goal: Array, within: int) -> tuple[float, float, float, float]:
    way = goal - tip_m[0]
    distance, off = float(np.linalg.norm(way)), np.linalg.norm(tip_m - goal, axis=1)
    far = np.flatnonzero(off > 1e-3)
    return (
        distance,
        float(np.sqrt(np.mean(off[within:] ** 2))),
        float(np.max((tip_m - goal) @ way) / distance),
        float(far[-1] + 1) * 1e-3 if len(far) else 0.0,
    )


class _Bumped(World):
    """A world whose tracker shows the tip elsewhere in one frame."""

    bump_at_ns, bump_m = 0, 0.003

    def _in_tracker_frame(self, tool: int) -> Pose | None:
        pose = super()._in_tracker_frame(tool)
        if pose is None or not self.bump_at_ns <= self.tracker.next_frame_ns < self.bump_at_ns + 25_000_000:
            return pose
        return pose[0] + self.bump_m, pose[1]


def pose_to_step(rig: Rig, seed: int) -> float:
    """Time (s) from the arrival of a pose to the first step edge that would not be there without it; NaN if none."""
    edges: list[dict[int, int]] = []
    arrival_ns = 0
    for bump_at_ns in (0, 2_600_000_000):
        run = _scenario(rig, seed, world_type=_Bumped, tissue=replace(PlantConfig().tissue, point_m=FAR_AWAY_M))
        assert isinstance(run.world, _Bumped)
        run.world.bump_at_ns = bump_at_ns
        run.arm()
        run.command("target", "position", target_m=(0.0, -0.006, 0.024))
        seen: dict[int, int] = {}

        def watch(run: Scenario = run, seen: dict[int, int] = seen) -> bool:
            part = run.world.slice
            if part is not None:
                for time_us, axis in zip(part.edge_time_us, part.edge_axis, strict=True):
                    seen[int(time_us) * 4 + int(axis)] = 1
            return False

        while run.now_ns < 2_800_000_000:
            run.run(0.001, watch)
            tip = run.loop.inputs[0].tip
            if bump_at_ns and not arrival_ns and tip.stamp_ns >= bump_at_ns:
                arrival_ns = int(tip.arrival_ns)
        edges.append(seen)
    differing = sorted(key // 4 for key in edges[0].keys() ^ edges[1].keys())
    after = [time_us for time_us in differing if time_us * 1000 >= arrival_ns]
    return after[0] * 1e-6 - arrival_ns * 1e-9 if arrival_ns and after else float("nan")


class PredictedTarget(NamedTuple):
    """RMS errors (m) of the wall's place AHEAD_S ahead: the predictor's, and what it is compared with."""

    predictor_m: float
    holding_m: float
    linear_m: float
    no_heart_m: float


def predict_target(
    rig: Rig, seed: int, beat: HeartConfig, by_pose: bool, seconds: float = 60.0, after_s: float = 10.0
) -> PredictedTarget:
    """The predictor on the simulated heart, by forces, or by poses (rate and noise of the rig, 2 ms jitter, 5 % lost)."""
    parameters, rng = tick_parameters(rig)[0], np.random.default_rng([seed, 40])
    config = parameters.wall.by_pose if by_pose else parameters.wall.by_force
    noise_m = rig.tracker.position_noise_m if by_pose else rig.force_sensor.noise_N * rig.control.tip_compliance_m_per_N
    wall = _wall_motion(beat, seed, seconds)
    step = round(1000 / rig.tracker.rate_hz) if by_pose else 1
    times = np.arange(0, len(wall) - 100, step)
    if by_pose:
        times = (times + rng.integers(0, 3, len(times)))[rng.random(len(times)) > 0.05]
    samples = wall[times] + noise_m * rng.standard_normal(len(times))
    state, predicted = new(TARGET_STATE)[0], np.zeros((len(times), 2))
    for k, time_ms in enumerate(times):
        target_predictor.apply(config, state, 10**9 + 10**6 * int(time_ms), samples[k], 0.0, 0.0, noise_m**2)
        predicted[k] = target_predictor.ahead(state, AHEAD_S), position(state.x[LOCAL], AHEAD_S)
    truth, kept = wall[times + round(AHEAD_S * 1000)], times > after_s * 1000
    linear = np.append(samples[0], samples[1:] + AHEAD_S * np.diff(samples) / (np.diff(times) * 1e-3))
    guesses = (predicted[:, 0], samples, linear, predicted[:, 1])
    return PredictedTarget(*(float(np.sqrt(np.mean((guess[kept] - truth[kept]) ** 2))) for guess in guesses))


def _wall_motion(beat: HeartConfig, seed: int, seconds: float) -> Array:
    parameters, state = heart.parameters(beat), heart.start(seed)
    return np.array([heart.advance(parameters, state, 1e-3 * k, 1e-3) for k in range(round(seconds * 1000))])
