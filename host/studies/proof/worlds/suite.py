"""One world's suite from a seed: cases without a trace of the truth, and the labels that a seal keeps apart.

`python -m host.studies.proof.worlds.suite --world W --seed S --cases N --dir DIR` writes DIR/cases/ID/ with recordings and
nominal.toml, and DIR/sealed/labels.json, whose sha256 it prints.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from host.studies.proof.worlds import case
from host.studies.proof.worlds.domains import generator as domains
from protocol.errors import InputError
from protocol.worker_process import end_with_parent
from sim.concealed import suite as own
from sim.concealed.label import Label

OWN = "own"
WORLDS = (OWN, "mujoco", "ode", "contact", domains.WORLD)


def mechanisms(world: str) -> tuple[case.Mechanism, ...]:
    """Return the mechanisms of `world`, one of mujoco, ode and contact.

    Raises InputError for another world, or where MuJoCo is not installed.
    """
    if world == "mujoco":
        try:
            import mujoco  # noqa: F401
        except ImportError:
            raise InputError("--world", world, "MuJoCo to be installed: pip install 'seldinger[mujoco]'") from None
        from host.studies.proof.worlds import engine

        return engine.MECHANISMS
    if world == "ode":
        from host.studies.proof.worlds import ode

        return ode.MECHANISMS
    if world == "contact":
        from host.studies.proof.worlds import contact

        return contact.MECHANISMS
    raise InputError("--world", world, f"one of {', '.join(WORLDS)}, or all")


def plans(world: str, seed: int, cases: int) -> list[case.CasePlan]:
    """Return the plans of the whole suite of `world`. Raises InputError for a world that is not known or cannot run here."""
    if world == domains.WORLD:
        return domains.plans(seed, cases)
    return case.plans(world, seed, cases, len(mechanisms(world)))


def suite(
    world: str, seed: int, cases: int, folder: Path, jobs: int = 1, progress: Callable[[int], None] = lambda _: None
) -> str:
    """Write the whole suite of `world` into `folder`; cases already there are not made again.

    Args:
        world: one of WORLDS.
        seed: decides the whole suite.
        cases: how many.
        folder: gets `cases/` and `sealed/`.
        jobs: processes.
        progress: called with how many cases are made.

    Returns:
        The sha256 of the sealed labels.

    Raises:
        InputError: the world is not known or cannot run here.
        RuntimeError: a case could not be drawn.
    """
    if world == OWN:
        return own.suite(seed, cases, folder, jobs, progress)
    seal, parts = folder / "sealed" / "labels.json", folder / "sealed" / "parts"
    if not seal.exists():
        planned = plans(world, seed, cases)
        parts.mkdir(parents=True, exist_ok=True)
        todo = [plan for plan in planned if not (parts / f"{plan.id}.json").exists()]
        done = cases - len(todo)
        with ProcessPoolExecutor(max_workers=jobs, initializer=end_with_parent) as pool:
            for made in (pool.map if jobs > 1 else map)(partial(_keep, folder), todo):
                done += made
                progress(done)
        labels = [json.loads((parts / f"{plan.id}.json").read_text(encoding="utf-8")) for plan in planned]
        content = {"world": world, "seed": seed, "cases": cases, "labels": labels}
        seal.write_text(json.dumps(content, sort_keys=True), encoding="utf-8")
        for part in parts.iterdir():
            part.unlink()
        parts.rmdir()
    seal.chmod(0o400)
    return hashlib.sha256(seal.read_bytes()).hexdigest()


def _keep(folder: Path, plan: case.CasePlan) -> int:
    """Make one case and put its label behind the seal. Returns 1."""
    made = domains.make(plan) if plan.world == domains.WORLD else case.make(mechanisms(plan.world), plan)
    case.write(made, folder / "cases" / plan.id)
    part = folder / "sealed" / "parts" / f"{plan.id}.json"
    part.with_suffix(".new").write_text(json.dumps(made.label), encoding="utf-8")
    part.with_suffix(".new").rename(part)
    return 1


def read_labels(seal: Path) -> list[Label]:
    """Return the labels of an opened seal."""
    labels: list[Label] = json.loads(seal.read_text(encoding="utf-8"))["labels"]
    return labels


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line: the sha256 of the labels on standard output, cases made so far on standard error."""
    parser = argparse.ArgumentParser(prog="python -m host.studies.proof.worlds.suite")
    parser.add_argument("--world", choices=WORLDS, required=True)
    for name in ("--seed", "--cases"):
        parser.add_argument(name, type=int, required=True)
    parser.add_argument("--dir", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args(arguments)

    def report(done: int) -> None:
        print(done, file=sys.stderr, flush=True)

    try:
        print(suite(given.world, given.seed, given.cases, given.dir, given.jobs, report))
    except InputError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
