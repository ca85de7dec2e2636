"""Diagnose all real recordings and compare held-out errors with fits made by hand.

    SELDINGER_DATA=FOLDER python -m host.studies.proof.real
    python -m host.studies.proof.real --data FOLDER --only mr_damper --json real.json

The recordings are not part of this repository; docs/diagnosis.md says where they come from. "Hand" is the held-out error
of a least-squares fit with physics chosen by a person, as published or as the README of the recordings has it; no rule of
the finder knows it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from host.diagnosis import diagnose
from host.diagnosis.model.nominal import nominal_path
from host.diagnosis.model.tables import read_table
from protocol.errors import InputError

Array = np.ndarray


@dataclass(frozen=True)
class Set:
    """One diagnosis to make.

    Attributes:
        name: of the row.
        nominal: that ships.
        file: table below the folder of recordings; empty: those that the nominal model names.
        cut: columns whose change begins a new recording.
        hand: held-out error of the fit made by hand, in `unit`; NaN where none is published.
        unit: of the error, and `scale` what one SI unit is in it.
        expected: ids that literature and authors give; naming any of them first is right.
        channel: output whose error is compared; empty: the verdict's own.
        recording: held-out recording whose error is compared; empty: all together.
    """

    name: str
    nominal: str
    file: str = ""
    cut: tuple[str, ...] = ()
    hand: float = float("nan")
    unit: str = ""
    scale: float = 1.0
    expected: tuple[str, ...] = ()
    channel: str = ""
    recording: str = ""


_PLAY = ("backlash", "presliding_friction", "nonlinear_stiffness", "coulomb_friction", "dead_zone", "static_nonlinearity")
_SEAL = ("load_dependent_friction", "coulomb_friction", "presliding_friction")
_DAMPER = ("presliding_friction", "coulomb_friction", "stribeck_friction")
_CABLE = ("backlash", "compliance", "presliding_friction", "coulomb_friction", "load_dependent_friction")
EMPS_FORCE_N = 58.45  # RMS of the force in the held-out recording; published errors are relative to it


def _cycloidal(mount: str, kind: str, hand_deg: float) -> Set:
    expected = (*_PLAY, "saturation") if kind == "command" else _PLAY
    file = f"cycloidal_backlash/base_{mount}.csv.gz"
    name = f"cycloidal {mount}, {kind}"
    return Set(name, f"cycloidal_{kind}", file, ("test_nr", "split"), hand_deg, "deg", 180.0 / np.pi, expected)


def _pneumatic(seal: str, hand_N: float) -> Set:
    file = f"pneumatic_seal_friction/{seal}.csv.gz"
    return Set(f"pneumatic {seal}", "pneumatic_seal", file, ("nominal_pressure_bar", "split"), hand_N, "N", 1.0, _SEAL)


def _damper(volts: str, hand_N: float) -> Set:
    file = f"mr_damper/mr_{volts}.csv.gz"
    return Set(f"mr_damper {volts}", "mr_damper", file, ("test_nr", "split"), hand_N, "N", 1.0, _DAMPER)


SETS = (
    Set("davinci_jaw", "davinci_jaw", hand=0.0084, unit="rad", expected=_CABLE),
    Set("davinci_torque", "davinci_torque", hand=10.0, unit="mN m", scale=1e3, expected=_CABLE),
    Set("emps", "emps", hand=0.0894 * EMPS_FORCE_N, unit="N", expected=("coulomb_friction", "asymmetry"), channel="force"),
    Set("silverbox", "silverbox", hand=0.523, unit="mV", scale=1e3, expected=("nonlinear_stiffness",), recording="arrow"),
    _cycloidal("init1", "command", 0.305),
    _cycloidal("init1", "torque", 0.288),
    _cycloidal("runin1", "command", 0.280),
    _cycloidal("runin1", "torque", 0.260),
    _cycloidal("runin5", "command", 0.288),
    _cycloidal("runin5", "torque", 0.275),
    _cycloidal("runin6", "command", 0.305),
    _cycloidal("runin6", "torque", 0.262),
    _pneumatic("oring", 1.09),
    _pneumatic("kdn", 0.70),
    _pneumatic("pk", 0.66),
    _damper("0V", 8.8),
    _damper("0p88V", 22.5),
)


@dataclass(frozen=True)
class SetResult:
    """Results for one data set; errors in its unit."""

    name: str
    verdict: str
    named: list[str]
    right: bool
    before: float
    after: float
    hand: float
    unit: str
    processor_s: float


def recordings_of(path: Path, cut: Sequence[str]) -> tuple[list[dict[str, Array]], list[str]]:
    """Return the recordings of a table, cut where a column of `cut` changes, and the names of those held out.

    Raises:
        InputError: the table cannot be read or has no such column.
    """
    columns = _numbers(path)
    marks = np.zeros(len(next(iter(columns.values()))), bool)
    for name in cut:
        if name not in columns:
            raise InputError(str(path), f"no column {name}", f"columns {', '.join(cut)}")
        marks[1:] |= np.diff(columns[name]) != 0
    begins = [0, *np.flatnonzero(marks), marks.size]
    found, heldout = [], []
    for first, last in itertools.pairwise(begins):
        found.append({name: values[first:last] for name, values in columns.items() if name != "split"})
        if columns["split"][first]:
            heldout.append(f"recording {len(found)}")
    return found, heldout


def _numbers(path: Path) -> dict[str, Array]:
    """Return the table's columns; `split` becomes 0 for train and 1 for test."""
    import gzip

    columns = dict(read_table(path))
    with gzip.open(path, "rt", encoding="utf-8") as file:
        at = file.readline().strip().split(",").index("split")
        columns["split"] = np.array([float(line.rstrip("\n").split(",")[at] == "test") for line in file])
    return columns


def judged(one: Set, folder: Path) -> SetResult:
    """Diagnose one set. Raises InputError where its recordings are missing."""
    began = time.process_time()
    if one.file:
        content: dict[str, Any] = tomllib.loads(nominal_path(one.nominal).read_text(encoding="utf-8"))
        recordings, heldout = recordings_of(folder / one.file, one.cut)
        content["data"]["heldout"] = heldout
        found = diagnose(recordings, content).as_dict()
    else:
        found = diagnose([], one.nominal, data_folder=str(folder)).as_dict()
    named = [str(effect["id"]) for effect in found["effects"]]
    before, after = _errors(one, found["fit"])
    right = bool(named) and named[0] in one.expected
    spent = time.process_time() - began
    return SetResult(
        one.name, found["verdict"], named, right, one.scale * before, one.scale * after, one.hand, one.unit, spent
    )


def _errors(one: Set, fit: dict[str, Any]) -> tuple[float, float]:
    """Return (before, after), held out, of the channel and recording that are compared."""
    row = fit
    if one.recording:
        row = next(iter(fit["per_recording"][one.recording].values()))
    elif one.channel:
        row = fit["per_channel"][one.channel]
    return float(row["rmse_before"]), float(row["rmse_after"])


def markdown(results: Sequence[SetResult]) -> str:
    """Return the results as a table."""
    lines = ["| recordings | named | before | after | by hand | processor s |", "|---|---|---|---|---|---|"]
    for r in results:
        named = ", ".join(r.named).replace("_", " ") or r.verdict.replace("_", " ")
        mark = "" if r.right else " (not what the literature gives first)"
        hand = f"{r.hand:.3g}" if np.isfinite(r.hand) else ""
        better = "" if not hand else " (at or below)" if r.after <= r.hand else " (above)"
        lines.append(
            f"| {r.name} | {named}{mark} | {r.before:.3g} {r.unit} | {r.after:.3g} | {hand}{better} | {r.processor_s:.0f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the sets of real recordings and print or write the results."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.real")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("SELDINGER_DATA", "../shared/data")))
    parser.add_argument("--only", default="", help="only sets whose name holds this")
    parser.add_argument("--json", type=Path, help="file for the results")
    given = parser.parse_args(arguments)
    if not given.data.is_dir():
        parser.exit(2, f"--data: found no folder {given.data}; wanted that of the recordings (or SELDINGER_DATA)\n")
    results = []
    for one in SETS:
        if given.only not in one.name:
            continue
        try:
            results.append(judged(one, given.data))
        except InputError as error:
            print(f"{one.name}: {error}", file=sys.stderr)
            continue
        print(markdown(results[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    print(markdown(results))
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(r) for r in results], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
