"""Cases of a suite of `seldinger prove`, made and diagnosed one at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from host.diagnosis import diagnose
from host.studies.proof.worlds import case, suite


def verdict_of(world: str, seed: int, number: int, folder: Path, attempt: int = 0) -> dict[str, Any]:
    """Verdict of case `number` among 50 of a world; its recordings are written to `folder`, which is empty.

    attempt: the first draw of the case that may be taken.
    """
    plan = replace(suite.plans(world, seed, 50)[number], attempt=attempt)
    case.write(case.make(suite.mechanisms(world), plan), folder)
    return diagnose(sorted(folder.glob("*.csv")), folder / "nominal.toml").as_dict()
