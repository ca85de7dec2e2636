"""Fit the probabilities' calibration on runs of `seldinger prove`, leaving worlds out.

python -m host.studies.proof.calibrate --dir runs/prove_SEED --leave-out ode --out calibration_ode.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from host.studies.proof.calibration import KINDS, CalibrationTable, fit, kind_of_none, raw_probability
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
    """Return (raw probability, whether true) of all statements of `kind`: effect, none or absent."""
    found = []
    for label, verdict in judged:
        if kind == "effect":
            first = (verdict.get("effects") or [{}])[0]  # further effects have to pass other rules
            p, true = raw_probability(kind, first), any(first.get("id") in names for names in label["names"])
        elif kind == kind_of_none(verdict):
            p, true = raw_probability(kind, verdict), none_listed(label)
        else:
            continue
        if p is not None:
            found.append((p, true))
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
    stated = {kind: statements(used, kind) for kind in KINDS}
    source["statements"] = {kind: len(found) for kind, found in stated.items()}
    return CalibrationTable({kind: fit(stated[kind]) for kind in KINDS}, source)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit the probability curves to finished runs and write them."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.calibrate")
    parser.add_argument("--dir", type=Path, action="append", required=True, help="folder of a finished run; may be repeated")
    parser.add_argument("--leave-out", action="append", default=[], help="world that is not used; may be repeated")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    table = calibrated(given.dir, given.leave_out)
    table.write(given.out)
    for kind in KINDS:
        curve, count = table.curves[kind], table.source["statements"][kind]
        print(f"{kind}: a {curve.a:.2f}, b {curve.b:.2f}, c {curve.c:+.2f} ({count} statements)")


if __name__ == "__main__":
    main()
