"""`seldinger prove`: concealed cases from a seed, verdicts without the labels, the table with baselines."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Jobs, Json, Seed, checked_jobs, checked_seed, within, writable_folder
from host.cli.progress import Progress
from protocol.errors import Description, InputError, reason


def prove(
    cases: Annotated[int, typer.Option(help="Number of cases.")] = 200,
    seed: Seed = 1,
    json: Json = False,
    jobs: Jobs = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler; its workers make the verdicts.", hidden=True)
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Folder of a run to continue.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for all results (default: runs/prove_SEED_CASES).")
    ] = None,
    finder: Annotated[
        str | None, typer.Option(help="Command to test instead of `seldinger diagnose`; it gets the same arguments.")
    ] = None,
    limit_s: Annotated[float, typer.Option(help="Longest time for one case (s).", hidden=True)] = 900.0,
    baselines: Annotated[bool, typer.Option(help="Run the baseline methods too, in the world `own`.")] = True,
    world: Annotated[
        str,
        typer.Option(
            help="Generators of cases: own, mujoco, ode, contact, domains (comma separated), or all. --cases is for each."
        ),
    ] = "own",
    calibration: Annotated[
        Path | None,
        typer.Option(help="Table of host.studies.proof.calibrate to apply to the raw probabilities.", hidden=True),
    ] = None,
) -> None:
    """Score the mismatch finder on concealed cases."""
    from host.studies.proof import workers
    from host.studies.proof.runner import Settings, is_spent
    from host.studies.proof.runner import prove as run
    from host.studies.proof.table import Share, markdown, worlds_markdown

    within("--cases", cases, 1, 1_000_000)
    processes = checked_jobs(jobs)
    within("--limit-s", limit_s, 1.0, 1e6, "s")
    checked_seed(seed)
    if resume is not None and not (resume / "suite.json").exists():
        raise InputError("--resume", str(resume), "a folder of an earlier run")
    chosen = _worlds(world)
    named = "" if chosen == ("own",) else "_" + "_".join(chosen)
    calibrate = _calibration(calibration)
    command = tuple(shlex.split(finder)) if finder else workers.FINDER
    if finder and shutil.which(command[0]) is None:
        raise InputError("--finder", finder, "a command whose program can be run")
    folder = writable_folder("--out", resume or out or Path("runs") / f"prove_{seed}_{cases}{named}")
    if is_spent(seed):
        print(f"seed {seed} was used during the development of the finder, so its figures prove nothing", file=sys.stderr)
    with Progress() as bar:
        result = run(
            Settings(cases, seed, folder, processes, scheduler, command, limit_s, baselines, chosen, calibrate),
            lambda stage, done, total: bar(stage, done / max(total, 1), f"{done}/{total}"),
            lambda digest: print(f"labels sha256 {digest}", file=sys.stderr, flush=True),
        )
    write_json(result, str(folder / "proof.json"))
    for case in result["cases"]:
        print(_line(case), file=sys.stderr)
    if json:
        write_json(result)
        return
    if chosen == ("own",):
        print(markdown(result["table"], result["baselines"]))
    else:
        tables = {name: each["table"] for name, each in result["worlds"].items()}
        counted = {name: {k: Share(**v) for k, v in each["shares"].items()} for name, each in result["worlds"].items()}
        print(worlds_markdown(tables, counted, "own"))


def _calibration(path: Path | None) -> Any:
    """Return the calibration of raw probabilities: none, or the table in a file. Raises InputError."""
    from host.studies.proof.calibration import as_stated, read

    try:
        return as_stated if path is None else read(path)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError("--calibration", Description(f"{path}: {reason(error)}"), "a table of proof.calibrate") from None


def _worlds(text: str) -> tuple[str, ...]:
    """Return the worlds of `--world`. Raises InputError for an unknown one."""
    from host.studies.proof.worlds.suite import WORLDS

    chosen = WORLDS if text == "all" else tuple(text.split(","))
    if unknown := [name for name in chosen if name not in WORLDS]:
        raise InputError("--world", unknown[0], f"one of {', '.join(WORLDS)}, several joined by commas, or all")
    return chosen


def _line(case: dict) -> str:  # type: ignore[type-arg]
    """Return one case as a line of text: right or not, truth, verdict."""
    effects = ", ".join(f"{e.get('id')}@{e.get('subsystem')}" for e in case["verdict"].get("effects") or [])
    truth = " + ".join(case["truth"]) or "nothing"
    loop = "closed" if case["closed_loop"] else "open"
    return (
        f"{'right' if case['right'] else 'WRONG'}  {case['world']} {case['id']}  {case['kind']:<12} {loop:<6} "
        f"rho {case['rho']:.2f}  "
        f"{case['category']}: {truth}  ->  {case['verdict'].get('verdict')} {effects}"
    )
