"""Cases of a suite of `seldinger prove`, made and diagnosed one at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from host.diagnosis import diagnose
from host.studies.proof.worlds import case, suite


def verdict_of(world: str, seed: int, number: int, folder: Path, attempt: int | None = None) -> dict[str, Any]:
    """Verdict of case `number` among 50 of a world; its recordings are written to `folder`, which is empty.

    attempt: which draw of the case; without it, the first that has the wanted size.
    """
    mechanisms, plan = suite.mechanisms(world), suite.plans(world, seed, 50)[number]
    if attempt is None:
        made = case.make(mechanisms, plan)
    else:
        now, mechanism = replace(plan, attempt=attempt), mechanisms[plan.mechanism]
        drawn = case._attempt(mechanism, now)
        assert drawn is not None
        made = case._finished(mechanism, now, drawn)
    case.write(made, folder)
    return diagnose(sorted(folder.glob("*.csv")), folder / "nominal.toml").as_dict()
