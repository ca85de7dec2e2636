"""How often a 95 % interval holds the planted value: `python -m tests.host.diagnosis.coverage --fits 100`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from host.diagnosis.estimation.fit import finish, minimize, reweigh
from host.diagnosis.estimation.known import chosen
from host.diagnosis.estimation.uncertainty import intervals
from host.diagnosis.model.nominal import effect_of, read_nominal
from host.diagnosis.problems import prepare
from host.diagnosis.selection.refits import fit_nominal, refined
from host.diagnosis.selection.screening import term_of
from tests.host.diagnosis import planted

CASES = {
    "backlash": ("transmission", "backlash@cable", "width_rad", 0.02),
    "latency": ("transmission", "latency@cable", "delay_s", 0.11),
    "compliance": ("transmission", "compliance@cable", "compliance_rad_per_N_m", 0.02),
    "cubic": ("axis", "nonlinear_stiffness@stage", "cubic_N_per_m3", 150.0),
    "lugre": ("impedance", "presliding_friction@slide:form=dahl", "force_N", 0.3),
}


def held(case: str, seed: int, folder: Path) -> tuple[bool, float]:
    """Whether the interval of one fit holds the truth, and the relative error of its value."""
    kind, name, key, truth = CASES[case]
    nominal, files = getattr(planted, kind)(folder, case, seed)
    model, problem, _ = prepare(read_nominal(nominal), files)
    fit = fit_nominal(problem)
    candidate = chosen(model, effect_of(name), True)
    term = term_of(problem, candidate, fit)
    start = [truth if p.key == key else p.grid[len(p.grid) // 2] for p in term.parameters]
    fit = finish(problem, minimize(problem, (term,), np.concatenate((fit.values, start))))
    reweigh(problem, fit)
    fit = refined(problem, fit)
    place = len(model.parameters) + [p.key for p in term.parameters].index(key)
    low, high = intervals(problem, fit)[place]
    return low <= truth <= high, fit.values[place] / truth - 1.0


def coverage(case: str, fits: int, first_seed: int = 1000) -> tuple[float, float]:
    """Share of `fits` whose interval holds the planted value, and the median relative error."""
    with tempfile.TemporaryDirectory() as folder:
        found = [held(case, first_seed + k, Path(folder)) for k in range(fits)]
    return float(np.mean([inside for inside, _ in found])), float(np.median([abs(error) for _, error in found]))


def main() -> None:
    """Prints one line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=100)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    arguments = parser.parse_args()
    for case in arguments.cases:
        share, error = coverage(case, arguments.fits)
        print(
            f"{case:12} {100 * share:5.1f} % of {arguments.fits} intervals hold the truth; median error {100 * error:.2f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
