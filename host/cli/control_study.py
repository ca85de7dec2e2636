"""`seldinger control-study`: the controller's figures on the simulated rig, beside what they are compared with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.studies.control.study import SECTIONS, StudySettings, in_words, study
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG


def control_study(
    seeds: Annotated[str, typer.Option(help="Seeds, with commas between; one run of each kind for each.")] = "1,2,3",
    seconds: Annotated[float, typer.Option(help="How long each force is held after contact.")] = 60.0,
    goals: Annotated[int, typer.Option(help="Random points for positioning.")] = 50,
    only: Annotated[str, typer.Option(help="Sections, with commas between: " + ", ".join(SECTIONS))] = "",
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Run the study in virtual time; with the defaults it takes some twenty minutes of one core."""
    settings = StudySettings(_seeds(seeds), seconds, goals, rig, _sections(only))
    if not 10.0 <= seconds <= 600.0:
        raise InputError("--seconds", seconds, "10 to 600")
    if not 1 <= goals <= 1000:
        raise InputError("--goals", goals, "1 to 1000")
    result = study(settings, lambda text: print(f"seldinger: {text}", file=sys.stderr, flush=True))
    print("\n".join(in_words(result)), file=sys.stderr)
    if json:
        write_json(result)


def _seeds(text: str) -> tuple[int, ...]:
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError("--seeds", text, "whole numbers with commas between") from None
    if not all(0 <= seed < 2**31 for seed in seeds):
        raise InputError("--seeds", text, "numbers from 0 to 2147483647")
    return seeds


def _sections(text: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(",") if part.strip()) or SECTIONS
    for name in names:
        if name not in SECTIONS:
            raise InputError("--only", name, "one of " + ", ".join(SECTIONS))
    return names
