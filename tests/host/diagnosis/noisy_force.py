"""False alarms against the noise of the force sensor: concealed null cases of the rig with a worse sensor.

python -m tests.host.diagnosis.noisy_force --cases 10 --force-noise 0.001 0.01 0.03 0.1
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from host.diagnosis.model.nominal import read_nominal
from host.diagnosis.models.rig import FORCE_ROWS
from host.diagnosis.pipeline import Diagnosis, diagnose
from sim.concealed import suite as concealed
from sim.concealed import system as concealed_system
from sim.concealed.suite import ConcealedCase, ConcealedPlan


def rig(seed: int, index: int) -> ConcealedCase:
    """A rig with nothing missing."""
    return concealed.draw(ConcealedPlan(seed, index, "null", "rig", bool(index % 2), 0.0, index))


def write(drawn: ConcealedCase, force_noise_N: float, folder: Path) -> list[Path]:
    """Its recordings with a force sensor as noisy as told, and nominal.toml, in `folder`."""
    sigma = drawn.system.sigma.copy()
    sigma[FORCE_ROWS] = force_noise_N
    system = replace(drawn.system, sigma=sigma)
    recorded = system.noisy(drawn.session, drawn.plan.stream(3))
    calibrated = system.calibrate(recorded, (0, 1), system.case.nominal, every=6)
    folder.mkdir(parents=True, exist_ok=True)
    concealed_system.write(system, recorded, calibrated, folder, False)
    return sorted(folder.glob("*.csv"))


def judged(folder: Path, files: list[Path]) -> Diagnosis:
    """Return the diagnosis of the recordings `files` with the nominal model of `folder`; no progress is shown."""
    return diagnose(read_nominal(folder / "nominal.toml"), files, lambda what, part: None)


def main() -> None:
    """Prints a line a case, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--seed", type=int, default=4711)
    parser.add_argument("--force-noise", type=float, nargs="+", default=[0.001, 0.01, 0.03, 0.1])
    given = parser.parse_args()
    said: dict[float, list[str]] = {noise: [] for noise in given.force_noise}
    for index in range(given.cases):
        drawn = rig(given.seed, index)
        for noise, verdicts in said.items():
            with tempfile.TemporaryDirectory() as folder:
                result = judged(Path(folder), write(drawn, noise, Path(folder)))
            named = ", ".join(term.candidate.key for term in result.found.best.terms)
            verdicts.append(result.verdict)
            off = result.found.nominal.values[6] / drawn.system.case.nominal[6] - 1.0
            print(f"case {index}, {noise:g} N: {result.verdict} {named}; stiffness off by {off:+.1%}", flush=True)
    lines = [
        f"| {noise:g} | {len(v)} | {v.count('missing_physics')} | {v.count('mismatch_not_identified')} |"
        for noise, v in said.items()
    ]
    head = ["| noise of the force sensor (N) | null cases | named something | doubtful |", "|---|---|---|---|"]
    print("\n".join([*head, *lines]))


if __name__ == "__main__":
    main()
