"""`seldinger warm`: compile every kernel that a command needs, by small real uses of them, on all cores."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.extras import missing_extra
from host.cli.options import Jobs, Json, checked_jobs
from host.cli.progress import Progress
from host.cli.warm_workloads import WORKLOADS
from protocol.errors import one_of

POLL_S = 0.2


def warm(
    json: Json = False,
    jobs: Jobs = 0,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Part to compile, with the parts that it needs; may be given several times. Default: all."),
    ] = None,
) -> None:
    """Compile every kernel that a command needs. Exit status 1 when a part failed; the others are compiled then."""
    from protocol.kernel_cache import base

    processes = checked_jobs(jobs)
    for name in only or ():
        one_of("--only", name, WORKLOADS)
    began_s = time.monotonic()
    failed = _run_all(_with_needed(only or list(WORKLOADS)), processes)
    for name, reason in failed.items():
        print(f"seldinger: warm: {WORKLOADS[name].title}: {reason}", file=sys.stderr)
    size_bytes = sum(path.stat().st_size for path in base().rglob("*") if path.is_file()) if base().is_dir() else 0
    result = {
        "seconds": round(time.monotonic() - began_s, 1),
        "folder": str(base()),
        "megabytes": round(size_bytes / 1e6, 1),
        "failed": failed,
    }
    print(
        f"kernels compiled in {result['seconds']:.0f} s; {base()} has {result['megabytes']:.0f} MB",
        file=sys.stderr,
    )
    if json:
        write_json(result)
    raise typer.Exit(1 if failed else 0)


def _with_needed(names: Sequence[str]) -> list[str]:
    """Return `names` and all that must run before them, in the order of WORKLOADS."""
    wanted, waiting = set[str](), list(names)
    while waiting:
        name = waiting.pop()
        if name not in wanted:
            wanted.add(name)
            waiting += WORKLOADS[name].after
    return [name for name in WORKLOADS if name in wanted]


def _run_all(names: Sequence[str], jobs: int) -> dict[str, str]:
    """Run the workloads, `jobs` at a time, each in a process of its own. Returns why some failed."""
    waiting, done, failed = list(names), set[str](), dict[str, str]()
    running: dict[str, subprocess.Popen[bytes]] = {}
    folder = Path(tempfile.mkdtemp(prefix="seldinger-warm-"))
    try:
        with Progress() as bar:
            while waiting or running:
                for name in [name for name in waiting if done.issuperset(WORKLOADS[name].after)][: jobs - len(running)]:
                    waiting.remove(name)
                    running[name] = _start(name, folder)
                titles = ", ".join(WORKLOADS[name].title for name in running)
                bar(f"compiling kernels: {titles}", len(done) / len(names), f"({len(done)}/{len(names)})")
                time.sleep(POLL_S)
                for name in [name for name, process in running.items() if process.poll() is not None]:
                    if running.pop(name).returncode:
                        failed[name] = (folder / f"{name}.txt").read_text(errors="replace").strip().rpartition("\n")[2]
                    done.add(name)
    finally:
        for process in running.values():
            process.terminate()
            process.wait()
        shutil.rmtree(folder, ignore_errors=True)
    return failed


def _start(name: str, folder: Path) -> subprocess.Popen[bytes]:
    with (folder / f"{name}.txt").open("wb") as messages:
        command = [sys.executable, "-m", "host.cli.warm", name, str(folder)]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=messages, stdin=subprocess.DEVNULL)


def _main(name: str, folder: Path) -> None:
    """Run one workload in this process. A workload whose extra is not installed has no command that could need it."""
    try:
        WORKLOADS[name].run(folder)
    except ModuleNotFoundError as error:
        if missing_extra(error, name) is None:
            raise


if __name__ == "__main__":
    _main(sys.argv[1], Path(sys.argv[2]))
