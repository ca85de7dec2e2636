"""Force by pose alone on a catheter whose stiffness is not the file's, with and without adaptation (8.1.2).

    python -m host.studies.control.stiffness_study --scales 0.8 1.0 1.2 --seeds 301 302

The simulated rig's wire stretches (3500 N/m: with the shaft's 110 mm and the wire's 0.7 mm offset the free curvature goes
with the stiffness to the power -0.5). The catheter in it is softer or stiffer than its file. Virtual time; the force is the
simulator's, from 5 s after contact on.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from host.studies.control.runs import REGULAR, WANTED_N, Held, hold, with_control
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig
from protocol.topics import Message, Stiffness
from sim.catheter_chain import CATHETERS, CatheterConfig
from sim.knob import KnobConfig

WIRE = KnobConfig(wire_stiffness_N_per_m=3500.0)


def of_stiffness(rig: Rig, scale: float) -> CatheterConfig:
    """The simulated catheter of `rig` with every rigidity times `scale`."""
    plain = CATHETERS[rig.catheter.name]
    x, y, z = plain.distal_Nm2
    u, v, w = plain.body_Nm2
    return replace(plain, distal_Nm2=(scale * x, scale * y, scale * z), body_Nm2=(scale * u, scale * v, scale * w))


def run(rig: Rig, seed: int, scale: float, adaptation: bool, seconds: float) -> tuple[Held, Stiffness | None]:
    """Hold WANTED_N by pose alone; the force since contact, and the newest report of the adaptation."""
    reports: list[Stiffness] = []

    def publish(topic: str, message: Message) -> None:
        if isinstance(message, Stiffness):
            reports.append(message)

    held = hold(
        with_control(rig, "estimation", adaptation=adaptation),
        seed,
        REGULAR,
        seconds,
        "estimate",
        publish=publish,
        catheter=of_stiffness(rig, scale),
        knob=WIRE,
    )
    return held, reports[-1] if reports else None


def main() -> None:
    """Print a row for each stiffness, with and without adaptation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scales", type=float, nargs="+", default=[0.8, 1.0, 1.2], help="true stiffness over the file's")
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302])
    parser.add_argument("--seconds", type=float, default=15.0, help="after contact")
    options = parser.parse_args()
    rig = load_rig(SIMULATED_RIG)
    print("| true stiffness | adaptation | stiffness in use | mean force | RMS error | largest force | in contact |")
    print("|---|---|---|---|---|---|---|")
    for scale in options.scales:
        for adaptation in (False, True):
            runs = [run(rig, seed, scale, adaptation, options.seconds) for seed in options.seeds]
            settled = [held.force_N[held.time_s > 5.0] for held, _ in runs]
            used = [1.0 if report is None else report.scale for _, report in runs]
            print(
                f"| {scale:.2f} | {'on' if adaptation else 'off'} | {np.mean(used):.3f} | "
                f"{1e3 * np.mean([np.mean(force) for force in settled]):.0f} mN | "
                f"{1e3 * np.sqrt(np.mean([held.rms_N(WANTED_N) ** 2 for held, _ in runs])):.1f} mN | "
                f"{1e3 * max(float(np.max(held.force_N)) for held, _ in runs):.0f} mN | "
                f"{100 * np.mean([held.kept() for held, _ in runs]):.1f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
