"""Contact away from the tip on the simulated catheter: is it found, how near to its true place, and how often falsely.

    python -m host.studies.benchmarks.body_contact --seeds 401 402 403 [--clean-minutes 10]

The simulated catheter stands free and bent for two seconds. Then an obstacle comes next to its shaft (planted effect
second_contact@shape) at a distance from the sheath's exit. The watch gets poses of two or three sensors with the tracker's
noise, and the joints that the stages give through the rig file. With `--clean-minutes` the catheter stands so long in a
beating wall without an obstacle, and false reports are counted.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.contact_watch import ContactWatch
from host.estimation.interface import Actuation, PoseReading
from host.estimation.lasting_errors import ActuationKnowledge
from host.mechanics.rotations import quaternion_of_vector, quaternion_product
from host.navigation.request import joints_at
from protocol.catheter import load_catheter
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import BodyContact
from sim.effects import PlantedEffect
from sim.plant import Plant, PlantConfig
from sim.tissue import TissueConfig

Array = NDArray[np.float64]
TWO, THREE = (0.0, 0.020), (0.0, 0.020, 0.040)
NO_WALL = TissueConfig(point_m=(0.0, 0.0, 1.0))
COMES_S, STEP_S, FRAME_S = 3.0, 0.001, 0.025
# Stages that press the demo's catheter on its wall.
PRESSING = (0.0080, 0.0, 0.668)


class ObstacleCase(NamedTuple):
    """Stages (m, rad, rad); the obstacle, from the exit along e3 and off the axis to -e2 (m); places of the sensors (m)."""

    stage: tuple[float, float, float]
    place_m: float
    clearance_m: float
    offsets_m: tuple[float, ...]


CASES = tuple(
    ObstacleCase((insertion, 0.0, knob), place, clearance, offsets)
    for insertion, knob, place, clearance in (
        (0.0305, 0.6, 0.015, -0.001),
        (0.0605, 0.5, 0.020, -0.001),
        (0.0605, 0.5, 0.030, -0.001),
        (0.0805, 0.4, 0.030, -0.001),
        (0.0805, 0.4, 0.045, -0.001),
    )
    for offsets in (TWO, THREE)
)


class ObstacleRun(NamedTuple):
    """Reports of a run, true place back from the tip (m) and force (N) at its end, time to the warning (s; NaN: none)."""

    reports: list[BodyContact]
    true_offset_m: float
    true_force_N: float
    warned_s: float


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


def run(rig: Rig, seed: int, case: ObstacleCase, seconds: float) -> ObstacleRun:
    """Let the obstacle come to a catheter that stands still, and watch for `seconds`."""
    effect = PlantedEffect("second_contact", "shape", {"place_m": case.place_m, "clearance_m": case.clearance_m}, COMES_S)
    plant = Plant(PlantConfig(tissue=NO_WALL, tool_offsets_m=case.offsets_m, effects=(effect,)), seed)
    tracked = _Tracked(rig, plant, case.stage, case.offsets_m, seed)
    reports: list[BodyContact] = []
    warned_s = np.nan
    for frame in range(round((COMES_S + seconds) / FRAME_S)):
        report = tracked.frame(frame, "position")
        reports += [] if report is None else [report]
        if tracked.watch.touched and np.isnan(warned_s):
            warned_s = (frame + 1) * FRAME_S - COMES_S
    offset_m, force_N = _true_contact(plant, case)
    return ObstacleRun(reports, offset_m, force_N, warned_s)


def _true_contact(plant: Plant, case: ObstacleCase) -> tuple[float, float]:
    """Arc length from the tip back to where the obstacle stands, and its force, by the simulator."""
    shape = plant.shape(400)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape, axis=0), axis=1))])
    along = float(np.interp(case.place_m, shape[:, 2], lengths))
    return float(lengths[-1]) - along, float(plant._parts.effects[0]["s"][0])


def clean(rig: Rig, seed: int, seconds: float, offsets_m: tuple[float, ...]) -> tuple[list[BodyContact], float, bool]:
    """Stand in the beating wall without an obstacle: reports, mean force (N), whether the body was said to touch."""
    plant = Plant(PlantConfig(tool_offsets_m=offsets_m), seed)
    reports, forces, touched = [], [], False
    tracked = _Tracked(rig, plant, PRESSING, offsets_m, seed)
    for frame in range(round((COMES_S + seconds) / FRAME_S)):
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
    print("| sensors | true place, force | false before | warned after | reported | place | error | sd | force |")
    print("|---|---|---|---|---|---|---|---|---|")
    for case in CASES:
        for seed in options.seeds:
            found = run(rig, seed, case, options.seconds)
            late = [report for report in found.reports if report.place != "tip" and report.stamp_ns > COMES_S * 1e9]
            false = sum(report.place != "tip" and report.stamp_ns <= COMES_S * 1e9 for report in found.reports)
            last = late[-1] if late else None
            print(
                f"| {len(case.offsets_m)} | {1e3 * found.true_offset_m:.1f} mm, {1e3 * found.true_force_N:.0f} mN | "
                f"{false} | {found.warned_s:.2f} s | {'tip' if last is None else last.place} | {_where(last, found)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
