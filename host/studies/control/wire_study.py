"""Motion and force of a catheter whose pull-wire rubs in its sheath, with and without the compensation (8.1.1).

    python -m host.studies.control.wire_study --friction 0.15 --turning 1.0 --seeds 311 312

The simulated wire stretches (3500 N/m) and rubs: twelve cells of the distal shaft have tensions of their own. The catheter
file that the rig uses has the same coefficient, or none. Virtual time. Free motion goes to ten points, 20 to 35 mm apart;
the contact is with a regularly beating wall, judged from 5 s after contact on.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from host.studies.control.runs import REGULAR, WANTED_N, go_to, hold, random_goals
from host.studies.control.stiffness_study import WIRE
from protocol.catheter import ConstitutiveParameters, catheter_toml, load_catheter
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig

GOALS = 10


def rubbing(rig: Rig, folder: Path, friction: float, turning_rad: float) -> Rig:
    """Return `rig` with a catheter file of this coefficient of friction, written into `folder`."""
    catheter = load_catheter(rig.catheter.name)
    path = folder / f"{catheter.name}_rubbing.toml"
    text = catheter_toml(replace(catheter, constitutive=ConstitutiveParameters(friction, 0.0)), [])
    path.write_text(text, encoding="utf-8")
    data = rig.effective()
    data["catheter"]["name"] = str(path)
    data["transmission"] |= {"catheter": str(path), "wire_turning_rad": turning_rad}
    return parse_rig(data, "wire study")


def row(rig: Rig, seeds: list[int], seconds: float, friction: float, turning_rad: float) -> str:
    """Return a row of the table: figures over all seeds."""
    knob = replace(WIRE, wire_friction=friction, wire_turning_rad=turning_rad)
    trips = [go_to(rig, random_goals(rig, GOALS, seed), seed, knob=knob) for seed in seeds]
    settled_s = np.concatenate([trip.settled_s for trip in trips])
    stopped_by = sorted({trip.stopped_by for trip in trips} - {""})
    cells = [f"{np.median(settled_s):.2f} s", f"{np.max(settled_s):.2f} s", ", ".join(stopped_by) or "-"]
    for source in ("sensor", "estimate"):
        runs = [hold(rig, seed, REGULAR, seconds, source, knob=knob) for seed in seeds]
        touched = [held for held in runs if held.reached]
        rms_N = np.sqrt(np.mean([held.rms_N(WANTED_N) ** 2 for held in touched])) if touched else np.nan
        most_N = max((float(np.max(held.force_N)) for held in touched), default=np.nan)
        cells += [f"{1e3 * rms_N:.1f} mN", f"{1e3 * most_N:.0f} mN"]
    return " | ".join(cells)


def main() -> None:
    """Print a row for a wire without friction, one that rubs, and the same with the compensation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--friction", type=float, default=0.15, help="coefficient of friction of the wire")
    parser.add_argument("--turning", type=float, default=1.0, help="bend (rad) of the body between handle and distal shaft")
    parser.add_argument("--seeds", type=int, nargs="+", default=[311, 312])
    parser.add_argument("--seconds", type=float, default=15.0, help="after contact")
    options = parser.parse_args()
    plain = load_rig(SIMULATED_RIG)
    print(
        "| wire | settled within 1 mm, median | longest | stopped by | RMS error, force sensor | largest | by poses alone "
        "| largest |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="seldinger-wire-") as folder:
        compensated = rubbing(plain, Path(folder), options.friction, options.turning)
        for name, rig, friction in (
            ("no friction", plain, 0.0),
            ("friction, not compensated", plain, options.friction),
            ("friction, compensated", compensated, options.friction),
        ):
            print(f"| {name} | {row(rig, options.seeds, options.seconds, friction, options.turning)} |", flush=True)


if __name__ == "__main__":
    main()
