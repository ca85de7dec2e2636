"""Fit the probabilities' calibration on runs of `seldinger prove`, leaving worlds out.

python -m host.studies.proof.calibrate --dir runs/prove_SEED --leave-out ode --out calibration_ode.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from host.studies.proof.calibration import CalibrationTable, Curve, fit
from host.studies.proof.scoring import none_listed
from host.studies.proof.worlds.suite import read_labels
from sim.concealed.label import Label

Judged = list[tuple[Label, dict[str, Any]]]


def read_run(folder: Path) -> dict[str, Judged]:
    """Return (label, verdict) of every case that has a verdict, by world. Raises OSError where labels are missing."""
    note = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
    found: dict[str, Judged] = {}
    for world in note["worlds"]:
        labels = read_labels(folder / world / "sealed" / "labels.json")
        verdicts = folder / world / "verdicts"
        paths = [(label, verdicts / f"{label['id']}.json") for label in labels]
        found[world] = [(la, json.loads(path.read_text(encoding="utf-8"))) for la, path in paths if path.exists()]
    return found


def statements(judged: Judged, kind: str) -> list[tuple[float, bool]]:
    """Return (raw probability, whether true) of all statements of `kind` effect or none."""
    found = []
    for label, verdict in judged:
        if kind == "none":
            p = verdict.get("probability_none_raw", verdict.get("probability_none"))
            true = none_listed(label)
        else:
            first = (verdict.get("effects") or [{}])[0]
            p = first.get("probability_raw", first.get("probability"))
            true = any(first.get("id") in names for names in label["names"])
        if isinstance(p, (int, float)):
            found.append((float(p), true))
    return found


def calibrated(runs: Sequence[Path], left_out: Sequence[str]) -> CalibrationTable:
    """Return the table fitted on all worlds of `runs` but those `left_out`."""
    used: Judged = []
    source: dict[str, Any] = {"left_out": sorted(left_out), "runs": []}
    for folder in runs:
        note = json.loads((folder / "suite.json").read_text(encoding="utf-8"))
        taken = {world: judged for world, judged in read_run(folder).items() if world not in left_out}
        used += [pair for judged in taken.values() for pair in judged]
        source["runs"].append({"seed": note["seed"], "cases": note["cases"], "worlds": sorted(taken)})
    effect, none = (statements(used, kind) for kind in ("effect", "none"))
    source["statements"] = {"effect": len(effect), "none": len(none)}
    return CalibrationTable(fit(effect) if effect else Curve(), fit(none) if none else Curve(), source)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit the probability curves to finished runs and write them."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.calibrate")
    parser.add_argument("--dir", type=Path, action="append", required=True, help="folder of a finished run; may be repeated")
    parser.add_argument("--leave-out", action="append", default=[], help="world that is not used; may be repeated")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    table = calibrated(given.dir, given.leave_out)
    table.write(given.out)
    print(f"effect: slope {table.effect.slope:.2f}, shift {table.effect.shift:+.2f}; none: slope {table.none.slope:.2f},")
    print(f"shift {table.none.shift:+.2f}; {table.source['statements']} statements -> {given.out}")


if __name__ == "__main__":
    main()
