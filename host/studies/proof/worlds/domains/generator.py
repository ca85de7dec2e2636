"""World `domains`: all data sets, the plans that a seed gives, and the finished cases with their labels."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from host.studies.proof.worlds.case import Case, CasePlan, check_suite
from host.studies.proof.worlds.domains import instruments, machines, materials, thermal_and_fluid
from host.studies.proof.worlds.domains.dataset import DataSet, Drawn
from sim.concealed.label import Label, PlantedTruth

WORLD = "domains"
ATTEMPTS = 60
ALL: tuple[DataSet, ...] = (
    *machines.DATA_SETS,
    *thermal_and_fluid.DATA_SETS,
    *instruments.DATA_SETS,
    *materials.DATA_SETS,
)


def plans(seed: int, cases: int) -> list[CasePlan]:
    """Return the first `cases` of the shuffled data sets; further rounds draw each again, in another order.

    Raises ValueError for less than one case or a negative seed.
    """
    check_suite(seed, cases)
    found: list[CasePlan] = []
    while len(found) < cases:
        turn = len(found) // len(ALL)
        for k in np.random.default_rng([seed, turn, 1]).permutation(len(ALL))[: cases - len(found)]:
            data_set = ALL[k]
            plan = CasePlan(WORLD, seed, len(found), data_set.category, int(k), data_set.closed_loop, 0.0, turn)
            found.append(plan)
    return found


def make(plan: CasePlan) -> Case:
    """Return the case of `plan`, drawn again until its effects have a size within the bounds of `dataset`.

    Raises RuntimeError if no draw has.
    """
    data_set = ALL[plan.mechanism]
    for attempt in range(ATTEMPTS):
        now = replace(plan, attempt=attempt)
        drawn = data_set.draw(now.stream(1))
        if data_set.category == "null" or drawn.wanted_size():
            recordings = {"abcdef"[i]: sheet.columns for i, sheet in enumerate(drawn.sheets)}
            return Case(recordings, drawn.nominal, _label(data_set, now, drawn))
    raise RuntimeError(f"{plan.id}: no draw of {data_set.name} has effects of the wanted size in {ATTEMPTS} attempts")


def _label(data_set: DataSet, plan: CasePlan, drawn: Drawn) -> Label:
    """Return the label that is sealed. Closed gap, windows and equation are not scored, so their fields are empty."""
    rho = drawn.sizes()[0]
    planted: list[PlantedTruth] = [
        {
            "id": place.partition("@")[0],
            "port": place.partition("@")[2],
            "size": rho,
            "start_s": 0.0,
            "parameters": {name: float(value) for name, value in parameters.items()},
            "compared": [name for name in parameters if name in data_set.compared],
            "equivalent": {},
            "gain": 1.0,
        }
        for place, parameters in zip(data_set.truth, drawn.planted, strict=True)
    ]
    return {
        "id": plan.id,
        "category": data_set.category,
        "puzzle": "",
        "kind": data_set.name,
        "closed_loop": data_set.closed_loop,
        "truth": list(data_set.truth),
        "names": data_set.accepted(),
        "set": [] if data_set.truth else ["nothing_missing"],
        "form": "",
        "says": [data_set.says] * max(1, len(data_set.truth)),
        "rho": rho,
        "rho_wanted": rho,
        "planted": planted,
        "windows_s": [],
        "channels": [],
        "mismatch_rms_heldout": {},
        "noise_rms_heldout": {},
        "plan": asdict(plan),
        "findings": [data_set.finding] if data_set.finding else [],
    }
