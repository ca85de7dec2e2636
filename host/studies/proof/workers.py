"""One concealed case given to the finder in a process of its own, here or on a Dask cluster; no lost worker loses a case."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from protocol.errors import InputError

FINDER = (sys.executable, "-m", "host.cli.main", "diagnose")
TRIES = 3
Verdict = dict[str, Any]


def run_case(files: dict[str, bytes], finder: Sequence[str], limit_s: float) -> Verdict:
    """Verdict of `finder` on one case, whose files (name -> content) are all that it gets, in an empty folder.

    A finder that fails, or takes longer than limit_s (s), gives {"verdict": "failed", "error": one line}. `wall_s` and
    `processor_s` (user and system, of the finder's process and those it waited for) are added.
    """
    with tempfile.TemporaryDirectory(prefix="case_") as folder, tempfile.TemporaryDirectory(prefix="said_") as said:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        recordings = sorted(name for name in files if name != "nominal.toml")
        command = [*finder, *recordings, "--nominal", "nominal.toml", "--json"]
        status, took, processor_s = _run(command, Path(folder), Path(said), limit_s)
        spent = {"wall_s": took, "processor_s": processor_s}
        if status is None:
            return {"verdict": "failed", "error": f"no verdict within {limit_s:.0f} s", **spent}
        if status < 0:
            raise ChildProcessError(f"finder ended by signal {-status}")
        try:
            verdict = json.loads((Path(said) / "out").read_text(encoding="utf-8"))
        except ValueError:
            lines = (Path(said) / "error").read_text(encoding="utf-8", errors="replace").strip().splitlines()
            return {"verdict": "failed", "error": f"exit status {status}: {(lines or ['no message'])[-1][:200]}", **spent}
    return (
        {**verdict, **spent} if isinstance(verdict, dict) else {"verdict": "failed", "error": "not one JSON object", **spent}
    )


def _run(command: Sequence[str], folder: Path, said: Path, limit_s: float) -> tuple[int | None, float, float]:
    """(exit status, wall s, processor s) of `command`, whose output goes to `said`; status None after limit_s."""
    began = time.monotonic()
    with (said / "out").open("wb") as out, (said / "error").open("wb") as error:
        child = subprocess.Popen(command, cwd=folder, env=_environment(), stdout=out, stderr=error, stdin=subprocess.DEVNULL)
        late = False
        while True:
            # wait4 gives this child's own processor time, which no call of subprocess does
            pid, status, usage = os.wait4(child.pid, os.WNOHANG)
            if pid:
                break
            if not late and time.monotonic() - began > limit_s:
                late = True
                child.kill()
            time.sleep(0.02)
        child.returncode = os.waitstatus_to_exitcode(status)
    took = time.monotonic() - began
    return None if late else child.returncode, took, usage.ru_utime + usage.ru_stime


def _environment() -> dict[str, str]:
    """The finder's environment: one thread a library, no folder of data, this installation's modules."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("SELDINGER_")}
    root = str(Path(__file__).parents[3])
    path = os.pathsep.join([root, *filter(None, [kept.get("PYTHONPATH")])])
    return kept | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def read_case(folder: Path) -> dict[str, bytes]:
    """Return file name -> content for all files of one case."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def locally(folders: dict[str, Path], finder: Sequence[str], limit_s: float, jobs: int) -> Iterator[tuple[str, Verdict]]:
    """(id, verdict) of all cases as they come, `jobs` processes at a time; one that a signal ended runs again."""

    def attempt(folder: Path) -> Verdict:
        error: Exception | None = None
        for _ in range(TRIES):
            try:
                return run_case(read_case(folder), finder, limit_s)
            except ChildProcessError as lost:
                error = lost
        return {"verdict": "failed", "error": f"{error}, {TRIES} times"}

    with ThreadPoolExecutor(max_workers=jobs) as executor:
        waiting = {executor.submit(attempt, folder): name for name, folder in folders.items()}
        for done in as_completed(waiting):
            yield waiting[done], done.result()


def on_cluster(
    folders: dict[str, Path], finder: Sequence[str], limit_s: float, address: str
) -> Iterator[tuple[str, Verdict]]:
    """The same on the Dask cluster whose scheduler listens at `address`; cases of lost workers are sent again.

    Raises InputError where dask.distributed is not installed or nothing answers.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            "--scheduler", address, "dask.distributed to be installed: pip install 'seldinger[cluster]'"
        ) from None
    try:
        client = distributed.Client(address, timeout="5s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError("--scheduler", address, f"a Dask scheduler that answers ({error})") from None
    with client:
        tried = dict.fromkeys(folders, 0)

        def send(name: str) -> Any:
            tried[name] += 1
            return client.submit(
                run_case,
                read_case(folders[name]),
                tuple(finder),
                limit_s,
                key=f"{name}-{tried[name]}-{time.time_ns()}",
                pure=False,
                retries=TRIES,
            )

        sent = [send(name) for name in folders]
        names = {future.key: name for future, name in zip(sent, folders, strict=True)}
        waiting = distributed.as_completed(sent, loop=client.loop)
        for future in waiting:
            name = names[future.key]
            if future.status == "finished":
                yield name, future.result()
            elif tried[name] < TRIES:
                again = send(name)
                names[again.key] = name
                waiting.add(again)
            else:
                yield name, {"verdict": "failed", "error": f"worker lost {TRIES} times: {future.exception()!r}"[:300]}
