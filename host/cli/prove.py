"""`seldinger prove`: concealed cases from a seed, blind verdicts, labels opened last, the table with baselines."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, Seed, checked_seed, within, writable_folder
from host.cli.progress import Progress
from protocol.errors import InputError


def prove(
    cases: Annotated[int, typer.Option(help="Number of cases.")] = 200,
    seed: Seed = 1,
    json: Json = False,
    jobs: Annotated[int, typer.Option(help="Processes on this machine.")] = 2,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, whose workers then make the verdicts.")
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Folder of a run to continue.")] = None,
    dir: Annotated[
        Path | None, typer.Option(help="Folder for everything that is made (default: runs/prove_SEED_CASES).")
    ] = None,
    finder: Annotated[str | None, typer.Option(help="Another command to score, called as `seldinger diagnose` is.")] = None,
    limit_s: Annotated[float, typer.Option(help="Longest time for one case (s).")] = 900.0,
    baselines: Annotated[bool, typer.Option(help="Run the baselines too.")] = True,
) -> None:
    """Score the mismatch finder on concealed cases."""
    from host.studies.proof import workers
    from host.studies.proof.runner import Settings
    from host.studies.proof.runner import prove as run
    from host.studies.proof.table import markdown

    within("--cases", cases, 1, 1_000_000)
    within("--jobs", jobs, 1, 1024)
    within("--limit-s", limit_s, 1.0, 1e6, "s")
    checked_seed(seed)
    if resume is not None and not (resume / "suite.json").exists():
        raise InputError("--resume", str(resume), "a folder that an earlier run made")
    folder = writable_folder("--dir", resume or dir or Path("runs") / f"prove_{seed}_{cases}")
    command = tuple(shlex.split(finder)) if finder else workers.FINDER
    with Progress() as bar:
        result = run(
            Settings(cases, seed, folder, jobs, scheduler, command, limit_s, baselines),
            lambda stage, done, total: bar(stage, done / max(total, 1), f"{done}/{total}"),
            lambda digest: print(f"labels sha256 {digest}", file=sys.stderr, flush=True),
        )
    write_json(result, str(folder / "proof.json"))
    for case in result["cases"]:
        print(_line(case), file=sys.stderr)
    if json:
        write_json(result)
        return
    print(markdown(result["table"], result["baselines"]))


def _line(case: dict) -> str:  # type: ignore[type-arg]
    """One case as a line of text: right or not, truth, verdict."""
    effects = ", ".join(f"{e.get('id')}@{e.get('subsystem')}" for e in case["verdict"].get("effects") or [])
    truth = " + ".join(case["truth"]) or "nothing"
    loop = "closed" if case["closed_loop"] else "open"
    return (
        f"{'right' if case['right'] else 'WRONG'}  {case['id']}  {case['kind']:<12} {loop:<6} rho {case['rho']:.2f}  "
        f"{case['category']}: {truth}  ->  {case['verdict'].get('verdict')} {effects}"
    )
