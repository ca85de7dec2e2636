"""Contact away from the tip on the simulated rig: is it found, how near to its true place, and how often falsely.

    python -m host.studies.benchmarks.body_contact --seeds 401 402 403 [--clean-minutes 10]

The rig runs in lock step with two or three sensors: drivers, control loop, topics, model process. It holds the free, bent
catheter at a place. Then an obstacle comes next to the shaft (planted effect second_contact@shape) at a distance from the
sheath's exit. With `--clean-minutes` the watch alone gets poses of a catheter that stands so long in a beating wall without
an obstacle, and false reports are counted.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.contact_watch import ContactWatch
from host.estimation.interface import Actuation, PoseReading
from host.estimation.lasting_errors import ActuationKnowledge
from host.estimation.rig_estimator import make_estimator
from host.estimation.service import EstimationService
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from host.navigation.request import joints_at
from protocol.catheter import load_catheter
from protocol.enums import SafetyAction
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig
from protocol.topics import BodyContact, Message, RigState
from sim.board import SimulatedBoard
from sim.effects import PlantedEffect
from sim.plant import Plant, PlantConfig
from sim.scenario import Scenario
from sim.tissue import TissueConfig
from sim.world import World, simulated_plant

Array = NDArray[np.float64]
TWO, THREE = (0.0, 0.020), (0.0, 0.020, 0.040)
NO_WALL = TissueConfig(point_m=(0.0, 0.0, 1.0))
COMES_S, STEP_S, FRAME_S = 8.0, 0.001, 0.025
TRUE_AFTER_S = 0.3  # the middle of the window in which most contacts are detected; a retraction has hardly moved by then
STANDS_S = 3.0  # of a clean run, before its time counts
# Stages that press the demo's catheter on its wall.
PRESSING = (0.0080, 0.0, 0.668)


class ObstacleCase(NamedTuple):
    """Tip's place before (m); the obstacle, from the exit along e3 and off the axis to -e2; offsets of the sensors (m)."""

    target_m: tuple[float, float, float]
    place_m: float
    clearance_m: float
    offsets_m: tuple[float, ...]


CASES = tuple(
    ObstacleCase(target, place, clearance, offsets)
    for target, place, clearance in (
        ((0.0, -0.010, 0.050), 0.015, -0.001),
        ((0.0, -0.020, 0.075), 0.020, -0.001),
        ((0.0, -0.020, 0.075), 0.030, -0.001),
        ((0.0, -0.020, 0.095), 0.030, -0.001),
        ((0.0, -0.020, 0.095), 0.045, -0.001),
        ((0.0, -0.010, 0.050), 0.038, 0.003),
    )
    for offsets in (TWO, THREE)
)


class ObstacleRun(NamedTuple):
    """Result of a run with an obstacle: what the rig said, and what was true TRUE_AFTER_S after the obstacle came.

    Times from the arrival of the obstacle (s), NaN where that did not happen.
    """

    reports: list[BodyContact]
    outside_m: float  # exposed length before the contact
    true_offset_m: float  # back from the tip
    true_force_N: float
    warned_s: float
    acted_s: float  # the failsafe holds or retracts
    action: str  # strongest safety action


class _Tracked:
    """A simulated catheter that goes to its stages in the first second and stands there, and the watch on its sensors."""

    def __init__(
        self, rig: Rig, plant: Plant, stage: tuple[float, float, float], offsets_m: tuple[float, ...], seed: int
    ) -> None:
        self._plant, self._stage, self._offsets_m, self._tracker = plant, np.array(stage), offsets_m, rig.tracker
        self._rng = np.random.default_rng(seed)
        self._joint = joints_at(rig, self._stage[None])[0]
        self._joint[0] -= 0.5 * rig.transmission.insertion_backlash_m  # moved forwards
        known_per_m = rig.estimation.curvature_sd_per_m
        self.watch = ContactWatch(
            load_catheter(rig.catheter.name),
            rig.tracker.position_noise_m,
            rig.tracker.orientation_noise_rad,
            ActuationKnowledge.from_rig(rig),
            lambda curvature: (curvature, known_per_m),
        )

    def frame(self, number: int, mode: str) -> BodyContact | None:
        """Let a frame of the tracker pass; the watch's report, if there is one."""
        for k in range(round(FRAME_S / STEP_S)):
            share = min(number * FRAME_S + k * STEP_S, 1.0)
            self._plant.step(STEP_S, share * self._stage)
        if number * FRAME_S < 1.5:
            return None
        stamp_ns, seen = round((number + 1) * FRAME_S * 1e9), []
        for tool, offset in enumerate(self._offsets_m):
            pose = self._plant.measured_pose(tool)
            position = pose.position_m + self._tracker.position_noise_m * self._rng.standard_normal(3)
            turn = quaternion_of_vector(self._tracker.orientation_noise_rad * self._rng.standard_normal(3))
            seen.append((offset, PoseReading(position, quaternion_product(pose.quaternion_wxyz, turn), stamp_ns)))
        insertion, roll, curvature = (float(value) for value in self._joint)
        return self.watch.take(seen, Actuation(insertion, roll, curvature, stamp_ns, None, mode))


def with_sensors(rig: Rig, offsets_m: tuple[float, ...]) -> Rig:
    """Return the rig with sensors at these places, from the tip: two or three."""
    tracker: dict[str, object] = {"shaft_sensor_offset_m": offsets_m[1]}
    if len(offsets_m) > 2:
        tracker |= {"rear_handle": "0C", "rear_sensor_offset_m": offsets_m[2]}
    data = rig.effective()
    return parse_rig({**data, "tracker": {**data["tracker"], **tracker}})


def run(rig: Rig, seed: int, case: ObstacleCase, seconds: float) -> ObstacleRun:
    """Let the obstacle come to the catheter of the running rig, which holds its tip at a place, and watch for `seconds`."""
    rig = with_sensors(rig, case.offsets_m)
    effect = PlantedEffect("second_contact", "shape", {"place_m": case.place_m, "clearance_m": case.clearance_m}, COMES_S)
    plant = simulated_plant(rig, seed, tissue=NO_WALL, effects=(effect,))
    reports: list[BodyContact] = []
    states: list[RigState] = []

    def publish(topic: str, message: Message) -> None:
        if isinstance(message, BodyContact):
            reports.append(message)
        elif isinstance(message, RigState):
            states.append(message)

    with SimulatedBoard("native") as board:
        world = World(rig, plant, board, seed)
        scenario = Scenario(rig, world, publish, estimator=EstimationService(make_estimator(rig)))
        if not scenario.arm() or not scenario.command("target", "position", target_m=case.target_m).accepted:
            raise RuntimeError("the simulated rig did not take the target")
        scenario.run(COMES_S - 1e-9 * world.now_ns)
        outside_m = float(_arc_lengths(plant.shape(400))[-1])
        scenario.run(TRUE_AFTER_S)
        true_offset_m, true_force_N = _true_contact(plant, case)
        scenario.run(seconds - TRUE_AFTER_S)
    after = [state for state in states if state.stamp_ns > COMES_S * 1e9]
    warned = [state for state in states if "body touches" in state.cause]
    acting = [state for state in after if state.safety_action not in ("none", "warn")]
    actions = SafetyAction.labels()
    return ObstacleRun(
        reports,
        outside_m,
        true_offset_m,
        true_force_N,
        _first_s(warned),
        _first_s(acting),
        max((state.safety_action for state in after), key=actions.index),
    )


def _first_s(states: list[RigState]) -> float:
    return 1e-9 * states[0].stamp_ns - COMES_S if states else np.nan


def _arc_lengths(shape: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape, axis=0), axis=1))])


def _true_contact(plant: Plant, case: ObstacleCase) -> tuple[float, float]:
    """Arc length from the tip back to where the obstacle stands, and its force, by the simulator."""
    shape = plant.shape(400)
    lengths = _arc_lengths(shape)
    along = float(np.interp(case.place_m, shape[:, 2], lengths))
    return float(lengths[-1]) - along, float(plant._parts.effects[0]["s"][0])


def clean(rig: Rig, seed: int, seconds: float, offsets_m: tuple[float, ...]) -> tuple[list[BodyContact], float, bool]:
    """Stand in the beating wall without an obstacle: reports, mean force (N), whether the body was said to touch."""
    plant = Plant(PlantConfig(tool_offsets_m=offsets_m), seed)
    reports, forces, touched = [], [], False
    tracked = _Tracked(rig, plant, PRESSING, offsets_m, seed)
    for frame in range(round((STANDS_S + seconds) / FRAME_S)):
        report = tracked.frame(frame, "contact")
        forces.append(float(np.linalg.norm(plant.contact_force_N)))
        reports += [] if report is None else [report]
        touched = touched or tracked.watch.touched
    return reports, float(np.mean(forces)), touched


def _where(report: BodyContact | None, found: ObstacleRun) -> str:
    """Place, its error, its standard deviation and the force, as the cells of a row."""
    if report is None or report.body_offset_m is None or report.body_offset_sd_m is None or report.body_force_N is None:
        return "- | - | - | -"
    error_mm = 1e3 * (report.body_offset_m - found.true_offset_m)
    force_mN = 1e3 * np.linalg.norm(report.body_force_N)
    place_mm, sd_mm = 1e3 * report.body_offset_m, 1e3 * report.body_offset_sd_m
    return f"{place_mm:.1f} mm | {error_mm:+.1f} mm | {sd_mm:.1f} mm | {force_mN:.0f} mN"


def _after(time_s: float) -> str:
    return "never" if np.isnan(time_s) else f"{time_s:.2f} s"


def main() -> None:
    """Print a row for each case and seed; or the false reports of a clean run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[401])
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--clean-minutes", type=float, default=0.0)
    options = parser.parse_args()
    rig = load_rig(SIMULATED_RIG)
    if options.clean_minutes:
        for seed in options.seeds:
            for offsets in (TWO, THREE):
                reports, force_N, touched = clean(rig, seed, 60.0 * options.clean_minutes, offsets)
                false = sum(report.place != "tip" for report in reports)
                worst = max((report.excess for report in reports), default=0.0)
                print(
                    f"seed {seed}, {len(offsets)} sensors: {len(reports)} windows at {1e3 * force_N:.0f} mN, {false} false, "
                    f"largest excess {worst:.2f} of 1, warned {touched}",
                    flush=True,
                )
        return
    print("| sensors | outside | true place, force | false | warned | failsafe | reported | place | error | sd | force |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for case in CASES:
        for seed in options.seeds:
            found = run(rig, seed, case, options.seconds)
            late = [report for report in found.reports if report.place != "tip" and report.stamp_ns > COMES_S * 1e9]
            false = sum(report.place != "tip" and report.stamp_ns <= COMES_S * 1e9 for report in found.reports)
            last = late[-1] if late else None
            place = "tip" if last is None else last.place
            print(
                f"| {len(case.offsets_m)} | {1e3 * found.outside_m:.0f} mm | {1e3 * found.true_offset_m:.1f} mm, "
                f"{1e3 * found.true_force_N:.0f} mN | {false} | {_after(found.warned_s)} | "
                f"{_after(found.acted_s)}, {found.action} | {place} | {_where(last, found)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
