"""`seldinger tune`: gains of the thesis' controller by (7.4), simplex beside a global search, with their margin."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.commissioning.characterization import load_calibrated_rig
from host.commissioning.tuning import GAINS, Margin, Tuned, best_of, criterion, half_way, stability_margin
from host.commissioning.tuning import tune as search
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG

# Least gain factor and phase margin of a proposal; below, the force gains are halved once.
LEAST_FACTOR, LEAST_PHASE_DEG = 2.0, 30.0


def tune(
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, as `characterize` writes it.")] = None,
    gains: Annotated[str, typer.Option(help="Keys of [control] to tune, with commas between.")] = ",".join(GAINS),
    evaluations: Annotated[int, typer.Option(help="Evaluations of (7.4) for each method.")] = 100,
    processes: Annotated[int, typer.Option(help="Side by side.")] = 2,
    seed: Annotated[int, typer.Option(help="Of the global search.")] = 1,
    check: Annotated[bool, typer.Option("--check", help="Only the margin of the rig's present gains.")] = False,
) -> None:
    """Tune the gains of the thesis' law on the simulated rig, over desired forces of 0.1, 0.2 and 0.3 N."""
    if not 8 <= evaluations <= 5000:
        raise InputError("--evaluations", evaluations, "8 to 5000")
    if not 1 <= processes <= 64:
        raise InputError("--processes", processes, "1 to 64")
    try:
        loaded = load_calibrated_rig(rig, calibration)
        names = [name.strip() for name in gains.split(",") if name.strip()]
        present = {name: float(getattr(loaded.control, name)) for name in GAINS}
        if check:
            result: dict[str, Any] = {
                "present": _told(Tuned("present", present, criterion(loaded, present), 1), stability_margin(loaded, present))
            }
        else:
            found = search(loaded, names, evaluations, processes, seed, progress=lambda text: print(text, file=sys.stderr))
            result = _proposal(loaded, present, found)
    except ValueError as error:
        key, _, rest = str(error).partition(": found ")
        what, _, wanted = rest.partition(", wanted ")
        raise InputError(key, what, wanted) from None
    _print(result)
    if json:
        write_json(result)


def _told(tuned: Tuned, margin: Margin | None) -> dict[str, Any]:
    told: dict[str, Any] = {
        "method": tuned.method,
        "gains": tuned.gains,
        "cost_N": tuned.cost_N,
        "evaluations": tuned.evaluations,
    }
    if margin is not None:
        told["margin"] = {
            "gain_factor": margin.gain_factor,
            "delay_s": margin.delay_s,
            "crossover_Hz": margin.crossover_Hz,
            "phase_deg": margin.phase_deg,
        }
    return told


def _proposal(rig: Any, present: dict[str, float], found: list[Tuned]) -> dict[str, Any]:
    """The best of both methods, halved once where its margin is small, beside the present gains."""
    best = best_of(found)
    try:
        margin: Margin | None = stability_margin(rig, {**present, **best.gains})
    except ValueError:
        margin = None
    halved = margin is None or margin.gain_factor < LEAST_FACTOR or margin.phase_deg < LEAST_PHASE_DEG
    if halved:
        best = half_way(rig, best)
        margin = stability_margin(rig, {**present, **best.gains})
    before = criterion(rig, present)
    return {
        "present": _told(Tuned("present", present, before, 1), None),
        "methods": [_told(item, None) for item in found],
        "proposal": {**_told(best, margin), "force_gains_halved_for_margin": halved},
        "loop_hz": rig.control.loop_hz,
        "simulated_on": "tick and plant with obedient stages, tracker and force sensor with noise and delays",
    }


def _print(result: dict[str, Any]) -> None:
    for item in [result["present"], *result.get("methods", []), *([result["proposal"]] if "proposal" in result else [])]:
        gains = ", ".join(f"{key} {value:.4g}" for key, value in item["gains"].items())
        name = "proposal" if item is result.get("proposal") else item["method"]
        print(f"{name:<24} J = {item['cost_N'] * 1e3:6.2f} mN   {gains}", file=sys.stderr)
        if "margin" in item:
            margin = item["margin"]
            phase = f"phase {margin['phase_deg']:.0f} deg at {margin['crossover_Hz']:.2f} Hz"
            print(
                f"{'':<24} rings at {margin['gain_factor']:.1f} times the gain; "
                + (
                    f"with {margin['delay_s'] * 1e3:.0f} ms more delay, {phase}"
                    if math.isfinite(margin["phase_deg"])
                    else f"not with {margin['delay_s'] * 1e3:.0f} ms more delay"
                ),
                file=sys.stderr,
            )
