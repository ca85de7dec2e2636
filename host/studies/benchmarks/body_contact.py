"""Contact away from the tip on the simulated rig: is it found, how near to its true place, and how often falsely.

    python -m host.studies.benchmarks.body_contact --seeds 401 402 403 [--clean-minutes 10]

An obstacle stands next to the shaft (planted effect second_contact@shape) at a distance from the sheath's exit; the catheter
is led past it with its tip free, or presses with its tip on the beating wall meanwhile. The model process sees poses and
stages. With `--clean-minutes` the demo's contact on a beating wall is held so long without an obstacle, and false reports
are counted.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from host.estimation.rig_estimator import make_estimator
from host.estimation.service import EstimationService
from protocol.enums import Phase
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import BodyContact, Message, RigState
from sim.effects import PlantedEffect
from sim.forked_board import forkable_board
from sim.scenario import TARGET_M, ContactJob, Scenario
from sim.world import World, simulated_plant

Array = NDArray[np.float64]


class ObstacleCase(NamedTuple):
    """A tip position that is gone to, and the obstacle next to it: from the exit along e3, and off the axis to -e2 (m)."""

    target_m: tuple[float, float, float]
    place_m: float
    clearance_m: float
    press: bool  # with the tip on the wall as well


CASES = (
    ObstacleCase((0.0, -0.0107, 0.021), 0.010, 0.0, False),
    ObstacleCase((0.0, -0.0107, 0.021), 0.015, 0.0, False),
    ObstacleCase((0.0, -0.020, 0.045), 0.020, 0.001, False),
    ObstacleCase((0.0, -0.020, 0.045), 0.030, 0.003, False),
    ObstacleCase((0.0, -0.0107, 0.021), 0.010, 0.0, True),
    ObstacleCase((0.0, -0.0107, 0.021), 0.015, 0.0, True),
)


class ObstacleRun(NamedTuple):
    """Reports of a run, the true place back from the tip (m) and force (N) at its end, and whether the failsafe warned."""

    reports: list[BodyContact]
    true_offset_m: float
    true_force_N: float
    tip_force_N: float
    warned: bool
    stopped: bool


def run(rig: Rig, seed: int, case: ObstacleCase | None, seconds: float) -> ObstacleRun:
    """Lead the catheter there, press if the case says so, and stay for `seconds`; without a case: the demo's contact."""
    reports: list[BodyContact] = []
    warned = False

    def publish(topic: str, message: Message) -> None:
        nonlocal warned
        if isinstance(message, BodyContact):
            reports.append(message)
        if isinstance(message, RigState) and "body touches" in message.cause:
            warned = True

    effects: tuple[PlantedEffect, ...] = ()
    if case is not None:
        place = {"place_m": case.place_m, "clearance_m": case.clearance_m}
        effects = (PlantedEffect("second_contact", "shape", place, 0.0),)
    plant = simulated_plant(rig, seed, effects=effects)
    world = World(rig, plant, forkable_board("native"), seed)
    scenario = Scenario(rig, world, publish, estimator=EstimationService(make_estimator(rig)))
    if not scenario.arm():
        raise RuntimeError("the simulated rig did not become ready")
    target = ContactJob(TARGET_M).target_m if case is None else case.target_m
    free = (target[0], target[1], 0.021) if case is None else target
    scenario.command("target", "position", target_m=free)
    scenario.run(4.0)
    if case is None or case.press:
        job = ContactJob(TARGET_M)
        scenario.command("target", "contact", target_m=job.target_m, normal=job.into, force_N=job.force_N)
        scenario.run(job.approach_s, lambda: scenario.phase == Phase.CONTACT)
    scenario.run(seconds)
    offset_m, force_N = _true_contact(plant, case) if case is not None else (0.0, 0.0)
    tip_N = float(np.linalg.norm(plant.contact_force_N))
    return ObstacleRun(reports, offset_m, force_N, tip_N, warned, scenario.phase == Phase.STOPPED)


def _true_contact(plant: object, case: ObstacleCase) -> tuple[float, float]:
    """Arc length from the tip back to where the obstacle stands, and its force, by the simulator."""
    shape = plant.shape(400)  # type: ignore[attr-defined]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape, axis=0), axis=1))])
    along = float(np.interp(case.place_m, shape[:, 2], lengths))
    return float(lengths[-1]) - along, float(plant._parts.effects[0]["s"][0])  # type: ignore[attr-defined]


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
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--cases", type=int, nargs="+", default=list(range(len(CASES))))
    parser.add_argument("--clean-minutes", type=float, default=0.0)
    options = parser.parse_args()
    rig = load_rig(SIMULATED_RIG)
    if options.clean_minutes:
        for seed in options.seeds:
            clean = run(rig, seed, None, 60.0 * options.clean_minutes)
            false = sum(report.place != "tip" for report in clean.reports)
            worst = max((report.excess for report in clean.reports), default=0.0)
            print(
                f"seed {seed}: {options.clean_minutes:g} minutes, {len(clean.reports)} windows, {false} false reports, ",
                end="",
            )
            print(f"largest excess {worst:.2f} of 1, warned {clean.warned}", flush=True)
        return
    print("| case | seed | true place, force, tip force | alarms | newest alarm | place | error | sd | force | warned |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for number in options.cases:
        for seed in options.seeds:
            found = run(rig, seed, CASES[number], options.seconds)
            alarms = [report for report in found.reports if report.place != "tip"]
            last = alarms[-1] if alarms else None
            where = _where(last, found)
            print(
                f"| {number} | {seed} | {1e3 * found.true_offset_m:.1f} mm, {1e3 * found.true_force_N:.0f} mN, "
                f"{1e3 * found.tip_force_N:.0f} mN | {len(alarms)} of {len(found.reports)} | "
                f"{'nothing' if last is None else last.place + ': ' + last.text} | {where} | "
                f"{'yes' if found.warned else 'no'}{', STOPPED' if found.stopped else ''} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
