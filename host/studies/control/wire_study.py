"""Motion and force of a catheter whose pull-wire rubs in its sheath, with and without the compensation (8.1.1).

    python -m host.studies.control.wire_study --friction 0.15 --turning 1.0 --seeds 311 312

The simulated wire stretches (3500 N/m) and rubs: twelve cells of the distal shaft have tensions of their own. The catheter
file that the rig uses has the same coefficient, that times a factor, or none. In the last two rows the wire rubs by another
law: Coulomb friction on the knob's motion, which does not grow with the tension. Its band is as wide as that of the capstan
with the coefficient of the file at the curvature LIKE_per_m. Virtual time. Free motion goes to ten points, 20 to 35 mm
apart; the contact is with a regularly beating wall, judged from 5 s after contact on.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from host.studies.control.runs import REGULAR, WANTED_N, go_to, hold, random_goals
from host.studies.control.stiffness_study import WIRE
from protocol.catheter import ConstitutiveParameters, catheter_toml, load_catheter
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig, parse_rig
from sim import knob
from sim.catheter_chain import CATHETERS
from sim.effects import PlantedEffect
from sim.knob import KnobConfig

GOALS = 10
LIKE_per_m = 20.0


def rubbing(rig: Rig, folder: Path, friction: float, turning_rad: float) -> Rig:
    """Return `rig` with a catheter file of this coefficient of friction, written into `folder`."""
    catheter = load_catheter(rig.catheter.name)
    folder.mkdir(exist_ok=True)
    path = folder / f"{catheter.name}_rubbing.toml"
    text = catheter_toml(replace(catheter, constitutive=ConstitutiveParameters(friction, 0.0)), [])
    path.write_text(text, encoding="utf-8")
    data = rig.effective()
    data["catheter"]["name"] = str(path)
    data["transmission"] |= {"catheter": str(path), "wire_turning_rad": turning_rad}
    return parse_rig(data, "wire study")


def half_band_rad(rig: Rig, knob_config: KnobConfig) -> float:
    """Return half of what the knob turns between pulling and letting go at the curvature LIKE_per_m."""
    parameters, state = knob.parameters(knob_config, CATHETERS[rig.catheter.name]), knob.start()
    angle = np.linspace(0.0, knob_config.stop_rad, 1001)
    pulled = np.array([knob.pull(parameters, state, turned) for turned in angle])
    let_go = np.array([knob.pull(parameters, state, turned) for turned in angle[::-1]])[::-1]
    return 0.5 * float(np.interp(LIKE_per_m, pulled, angle) - np.interp(LIKE_per_m, let_go, angle))


def coulomb(half_band: float) -> PlantedEffect:
    """Return Coulomb friction on the knob's motion with this half band (rad)."""
    stiffness_N_per_rad = 8.0
    force_N = half_band * stiffness_N_per_rad
    return PlantedEffect("coulomb_friction", "knob", {"force_N": force_N, "stiffness_N_per_rad": stiffness_N_per_rad})


def row(rig: Rig, seeds: list[int], seconds: float, **plant: Any) -> str:
    """Return a row of the table: figures over all seeds. plant: parts of `sim.plant.PlantConfig`."""
    trips = [go_to(rig, random_goals(rig, GOALS, seed), seed, **plant) for seed in seeds]
    settled_s = np.concatenate([trip.settled_s for trip in trips])
    stopped_by = sorted({trip.stopped_by for trip in trips} - {""})
    cells = [f"{np.median(settled_s):.2f} s", f"{np.max(settled_s):.2f} s", ", ".join(stopped_by) or "-"]
    for source in ("sensor", "estimate"):
        runs = [hold(rig, seed, REGULAR, seconds, source, **plant) for seed in seeds]
        touched = [held for held in runs if held.reached]
        rms_N = np.sqrt(np.mean([held.rms_N(WANTED_N) ** 2 for held in touched])) if touched else np.nan
        most_N = max((float(np.max(held.force_N)) for held in touched), default=np.nan)
        cells += [f"{1e3 * rms_N:.1f} mN", f"{1e3 * most_N:.0f} mN"]
    return " | ".join(cells)


def main() -> None:
    """Print a row for a wire without friction, one that rubs, and the same with the compensation, true and off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--friction", type=float, default=0.15, help="coefficient of friction of the wire")
    parser.add_argument("--turning", type=float, default=1.0, help="bend (rad) of the body between handle and distal shaft")
    parser.add_argument(
        "--factors", type=float, nargs="*", default=[0.5, 0.75, 1.25, 1.5], help="coefficient of the file over the true one"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[311, 312])
    parser.add_argument("--seconds", type=float, default=15.0, help="after contact")
    options = parser.parse_args()
    plain = load_rig(SIMULATED_RIG)
    smooth = replace(WIRE, wire_turning_rad=options.turning)
    rubs = replace(smooth, wire_friction=options.friction)
    other_law = {"knob": smooth, "effects": (coulomb(half_band_rad(plain, rubs)),)}
    print(
        "| wire | settled within 1 mm, median | longest | stopped by | RMS error, force sensor | largest | by poses alone "
        "| largest |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="seldinger-wire-") as folder:
        compensated = rubbing(plain, Path(folder), options.friction, options.turning)
        rows: list[tuple[str, Rig, dict[str, Any]]] = [
            ("no friction", plain, {"knob": smooth}),
            ("friction, not compensated", plain, {"knob": rubs}),
            ("friction, compensated", compensated, {"knob": rubs}),
        ]
        for factor in options.factors:
            off = rubbing(plain, Path(folder) / f"{factor:g}", factor * options.friction, options.turning)
            rows.append((f"friction, compensated with {factor:g} of its coefficient", off, {"knob": rubs}))
        rows.append(("Coulomb friction, not compensated", plain, other_law))
        rows.append(("Coulomb friction, compensated as the capstan's", compensated, other_law))
        for name, rig, plant in rows:
            print(f"| {name} | {row(rig, options.seeds, options.seconds, **plant)} |", flush=True)


if __name__ == "__main__":
    main()
