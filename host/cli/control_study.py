"""`seldinger control-study`: the controller's figures on the simulated rig, each with its reference."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import SEEDS, Json, RigFile, within
from protocol.errors import InputError, one_of
from protocol.rig_file import SIMULATED_RIG


def control_study(
    seeds: Annotated[str, typer.Option(help="Seeds, comma separated; each kind of run is made with every seed.")] = "1,2,3",
    seconds: Annotated[float, typer.Option(help="Time to hold each force after contact, s.")] = 60.0,
    goals: Annotated[int, typer.Option(help="Number of random points for positioning.")] = 50,
    only: Annotated[str, typer.Option(help="Sections to run, comma separated; default: all.")] = "",
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
) -> None:
    """Run the study in virtual time; with the defaults it takes some twenty minutes of one core."""
    from host.studies.control.study import SECTIONS, StudySettings, study, table_lines

    names = tuple(part.strip() for part in only.split(",") if part.strip()) or SECTIONS
    for name in names:
        one_of("--only", name, SECTIONS)
    within("--seconds", seconds, 10.0, 600.0, "s")
    within("--goals", goals, 1, 1000)
    settings = StudySettings(_seeds(seeds), seconds, goals, rig, names)
    result = study(settings, lambda text: print(f"seldinger: {text}", file=sys.stderr, flush=True))
    print("\n".join(table_lines(result)), file=sys.stderr)
    if json:
        write_json(result)


def _seeds(text: str) -> tuple[int, ...]:
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError("--seeds", text, "whole numbers, comma separated") from None
    for seed in seeds:
        within("--seeds", seed, *SEEDS)
    return seeds
