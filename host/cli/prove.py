"""`seldinger prove`: concealed cases from a seed, blind verdicts, the seal opened last, the table beside baselines."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from protocol.errors import InputError

_WIDTH = 28


class Bar:
    """A progress bar on standard error; on anything but a terminal, one line a tenth."""

    def __init__(self) -> None:
        self.live, self.began, self.last = sys.stderr.isatty(), time.monotonic(), ""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` cases of `stage` are through."""
        share = done / max(total, 1)
        mark = f"{stage} {int(10 * share)}"
        if not self.live and mark == self.last:
            return
        self.last = mark
        filled = "#" * round(_WIDTH * share)
        text = f"{stage:<10} [{filled:<{_WIDTH}}] {done}/{total}  {time.monotonic() - self.began:.0f} s"
        end = "\n" if not self.live or done == total else ""
        sys.stderr.write(f"\r{text:<78}{end}" if self.live else f"{text}\n")
        sys.stderr.flush()


def prove(
    cases: Annotated[int, typer.Option(help="how many cases")] = 200,
    seed: Annotated[int, typer.Option(help="decides the whole suite")] = 1,
    json: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
    jobs: Annotated[int, typer.Option(help="processes on this machine")] = 2,
    scheduler: Annotated[
        str | None, typer.Option(help="address of a Dask scheduler; verdicts are then made by its workers")
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="folder of a run to go on with")] = None,
    dir: Annotated[
        Path | None, typer.Option(help="folder that keeps all that is made (default runs/prove_SEED_CASES)")
    ] = None,
    finder: Annotated[
        str | None, typer.Option(help="another command to put to the proof, called as `seldinger diagnose` is")
    ] = None,
    limit_s: Annotated[float, typer.Option(help="longest time for one case (s)")] = 900.0,
    baselines: Annotated[bool, typer.Option(help="also run the baselines")] = True,
) -> None:
    """Put the mismatch finder to the proof on concealed cases."""
    from host.studies.proof import workers
    from host.studies.proof.runner import Settings
    from host.studies.proof.runner import prove as run
    from host.studies.proof.table import markdown

    for key, value, least in (("--cases", cases, 1), ("--seed", seed, 0), ("--jobs", jobs, 1), ("--limit-s", limit_s, 1.0)):
        if not value >= least:
            raise InputError(key, value, f"at least {least}")
    if resume is not None and not (resume / "suite.json").exists():
        raise InputError("--resume", str(resume), "a folder that an earlier run made")
    folder = resume or dir or Path("runs") / f"prove_{seed}_{cases}"
    command = tuple(shlex.split(finder)) if finder else workers.FINDER
    result = run(
        Settings(cases, seed, folder, jobs, scheduler, command, limit_s, baselines),
        Bar(),
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
    """One case for people: right or not, truth, verdict."""
    said = ", ".join(f"{e.get('id')}@{e.get('subsystem')}" for e in case["verdict"].get("effects") or [])
    truth = " + ".join(case["truth"]) or "nothing"
    loop = "closed" if case["closed_loop"] else "open"
    return (
        f"{'right' if case['right'] else 'WRONG'}  {case['id']}  {case['kind']:<12} {loop:<6} rho {case['rho']:.2f}  "
        f"{case['category']}: {truth}  ->  {case['verdict'].get('verdict')} {said}"
    )
