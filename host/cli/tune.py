"""`seldinger tune`: gains of the thesis' controller by (7.4), by simplex and by a global search, with their margin."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Jobs, Json, RigFile, Seed, checked_jobs, checked_seed, within
from protocol.rig_file import SIMULATED_RIG


def tune(
    json: Json = False,
    rig: RigFile = SIMULATED_RIG,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, as `characterize` writes it.")] = None,
    gains: Annotated[str, typer.Option(help="Keys of [control] to tune, comma separated; default: all four.")] = "",
    evaluations: Annotated[int, typer.Option(help="Evaluations of (7.4) for each method.")] = 100,
    jobs: Jobs = 0,
    seed: Seed = 1,
    check: Annotated[bool, typer.Option("--check", help="Report only the margin of the present gains.")] = False,
) -> None:
    """Tune the gains of the thesis' law on the simulated rig, over desired forces of 0.1, 0.2 and 0.3 N."""
    from host.commissioning.characterization import load_calibrated_rig
    from host.commissioning.tuning import GAINS, margin_report, proposal_report
    from host.commissioning.tuning import tune as search

    within("--evaluations", evaluations, 8, 5000)
    processes = checked_jobs(jobs)
    checked_seed(seed)
    loaded = load_calibrated_rig(rig, calibration)
    names = [name.strip() for name in gains.split(",") if name.strip()] or list(GAINS)
    if check:
        result = margin_report(loaded)
    else:
        found = search(loaded, names, evaluations, processes, seed, progress=lambda text: print(text, file=sys.stderr))
        result = proposal_report(loaded, found)
    _print(result)
    if json:
        write_json(result)


def _print(result: dict[str, Any]) -> None:
    for item in [result["present"], *result.get("methods", []), *([result["proposal"]] if "proposal" in result else [])]:
        gains = ", ".join(f"{key} {value:.4g}" for key, value in item["gains"].items())
        name = "proposal" if item is result.get("proposal") else item["method"]
        print(f"{name:<24} J = {item['cost_N'] * 1e3:6.2f} mN   {gains}", file=sys.stderr)
        if "margin" in item:
            margin = item["margin"]
            phase = f"phase {margin['phase_deg']:.0f} deg at {margin['crossover_Hz']:.2f} Hz"
            print(
                f"{'':<24} oscillates at {margin['gain_factor']:.1f} times the gain; "
                + (
                    f"with {margin['delay_s'] * 1e3:.0f} ms more delay, {phase}"
                    if math.isfinite(margin["phase_deg"])
                    else f"not with {margin['delay_s'] * 1e3:.0f} ms more delay"
                ),
                file=sys.stderr,
            )
