"""Cases of a suite of `seldinger prove`, made and diagnosed one at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from host.diagnosis import diagnose
from host.studies.proof.worlds import case, suite


def verdict_of(world: str, seed: int, number: int, folder: Path) -> dict[str, Any]:
    """Verdict of case `number` among 50 of a world; its recordings are written to `folder`, which is empty."""
    case.write(case.make(suite.mechanisms(world), suite.plans(world, seed, 50)[number]), folder)
    return diagnose(sorted(folder.glob("*.csv")), folder / "nominal.toml").as_dict()
