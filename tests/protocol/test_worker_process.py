"""A worker process ends when the process that started it is killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import until

SCRIPT = r"""
import sys, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from os import getpid, write
from protocol.worker_process import end_with_parent

def work(seconds):
    write(1, b"%d\n" % getpid())  # one write: two workers share the pipe
    time.sleep(seconds)

if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context(sys.argv[1]), initializer=end_with_parent) as pool:
        for future in [pool.submit(work, 600.0) for _ in range(2)]:
            future.result()
"""


def is_running(pid: int) -> bool:
    """Whether a process is there and not only waits to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("start", ["spawn", "fork"])
def test_workers_of_a_killed_command_end(start: str, tmp_path: Path) -> None:
    script = tmp_path / "command.py"
    script.write_text(SCRIPT, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = subprocess.Popen([sys.executable, str(script), start], stdout=subprocess.PIPE, text=True, env=environment)
    assert command.stdout is not None
    workers = [int(command.stdout.readline()) for _ in range(2)]
    assert all(is_running(worker) for worker in workers)
    command.kill()
    command.wait()
    until(lambda: not any(is_running(worker) for worker in workers), "the workers to end")
