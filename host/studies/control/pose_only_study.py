"""Force by poses alone over seeds: regular and irregular beat, walls tilted out of the bending plane, both estimators.

    python -m host.studies.control.pose_only_study --seeds 7701 7702 7703 7704 7705 7706 7707 7708 7709 7710
    python -m host.studies.control.pose_only_study --tilts-deg 30 60 --beats regular --seeds 7701 7702 7703
    python -m host.studies.control.pose_only_study --unknown-deg 6 --beats regular --seeds 7701 7702 7703

The estimate closes the loop on the simulated wall. Virtual time; the force is the simulator's, along the wall's normal, from
5 s after contact on. "Of still" divides the RMS error by that of a catheter that the force sensor brought to the same wall
with the same beat and that then does not move, about its own mean force. "Touch lost" counts the runs in which the force
was 0 or the phase was not contact at any time after the first touch, and the longest such time.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from host.studies.control.runs import IRREGULAR, JOB, REGULAR, WANTED_N, Held, hold, still, with_control
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from sim.plant import PlantConfig
from sim.scenario import ContactJob
from sim.tissue import TissueConfig

HEAD = (
    "| wall, beat | estimator | RMS error | of each run | mean force | of still | worst | highest above 0.2 N | "
    "touch lost | longest |"
)
BEATS = {"regular": REGULAR, "irregular": IRREGULAR}


def tilted_wall(tilt_deg: float, unknown_deg: float = 0.0) -> tuple[ContactJob, TissueConfig]:
    """Return the job and the wall whose normal is turned by `tilt_deg` out of the bending plane, about e2.

    The wall alone is turned by `unknown_deg` about e1 before: the job does not know it. The wall still goes through the
    target: the simulated catheter bends in the plane of e2 and e3, at e1 = 0.
    """
    tilt = math.radians(tilt_deg)
    into = (-math.sin(tilt), 0.0, math.cos(tilt))
    unknown = math.radians(unknown_deg)
    across = math.cos(unknown)
    normal = (across * math.sin(tilt), math.sin(unknown), -across * math.cos(tilt))
    wall = replace(PlantConfig().tissue, normal=normal)
    return replace(JOB, into=into), wall


def run(rig: Rig, seed: int, model: str, beat: str, walls: tuple[ContactJob, TissueConfig], seconds: float) -> Held:
    """Hold WANTED_N by pose alone, with the estimator `model`."""
    job, wall = walls
    changed = with_control(rig, "estimation", model=model)
    return hold(changed, seed, BEATS[beat], seconds, "estimate", job, tissue=wall)


def row(runs: list[Held], still_rms_N: list[float]) -> str:
    """Return one row of the table: each RMS error is compared with the still catheter of the same seed.

    Runs that did not reach the wall have no force to judge; they are counted as lost for ever.
    """
    pairs = [(held, still_N) for held, still_N in zip(runs, still_rms_N, strict=True) if held.reached]
    if not pairs:
        return f"wall not reached | | | | | | {len(runs)} of {len(runs)} | for ever |"
    there, reference = [held for held, _ in pairs], np.array([still_N for _, still_N in pairs])
    rms = np.array([held.rms_N(WANTED_N) for held in there])
    mean = np.mean([held.mean_N() for held in there])
    lost_s = [held.longest_loss_s() for held in runs]
    longest = f"{max(lost_s):.3f} s" if max(lost_s) < np.inf else "for ever"
    return (
        f"{1e3 * np.sqrt(np.mean(rms**2)):.1f} mN | {1e3 * np.min(rms):.1f} to {1e3 * np.max(rms):.1f} mN | "
        f"{1e3 * mean:.0f} mN | {np.sqrt(np.mean(rms**2) / np.mean(reference**2)):.2f} | {np.max(rms / reference):.2f} | "
        f"{1e3 * max(held.overshoot_N(WANTED_N) for held in there):.0f} mN | "
        f"{sum(lost > 0.0 for lost in lost_s)} of {len(runs)} | {longest} |"
    )


def main() -> None:
    """Print a row for each beat, tilt and estimator, and of the still catheter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7701, 7702])
    parser.add_argument("--models", nargs="+", choices=("spatial", "planar"), default=["spatial", "planar"])
    parser.add_argument("--beats", nargs="+", choices=tuple(BEATS), default=list(BEATS))
    parser.add_argument(
        "--tilts-deg", type=float, nargs="+", default=[0.0], help="of the wall's normal out of the bending plane"
    )
    parser.add_argument(
        "--unknown-deg", type=float, default=0.0, help="tilt in the bending plane that the job does not know"
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="after contact")
    parser.add_argument("--each", action="store_true", help="print each run as well")
    options = parser.parse_args()
    rig = load_rig(SIMULATED_RIG)
    print(HEAD)
    print("|---|---|---|---|---|---|---|---|---|---|")
    for tilt_deg in options.tilts_deg:
        job, wall = tilted_wall(tilt_deg, options.unknown_deg)
        for beat in options.beats:
            where = f"{tilt_deg:g} degrees, {beat}"
            reference = [still(rig, seed, options.seconds - 5.0, BEATS[beat], job, tissue=wall) for seed in options.seeds]
            print(
                f"| {where} | does not move | {1e3 * np.sqrt(np.mean(np.square(reference))):.1f} mN | | | 1 | | | | |",
                flush=True,
            )
            for model in options.models:
                runs = []
                for seed, reference_N in zip(options.seeds, reference, strict=True):
                    runs.append(run(rig, seed, model, beat, (job, wall), options.seconds))
                    if options.each:
                        print(f"| seed {seed} | {model} | {row(runs[-1:], [reference_N])}", flush=True)
                print(f"| {where} | {model} | {row(runs, reference)}", flush=True)


if __name__ == "__main__":
    main()
