"""Benchmark of starting up: a fresh interpreter imports the mechanics and solves once, with a filled kernel cache."""

from __future__ import annotations

import subprocess
import sys

from host.studies.benchmarks.runner import PairedTimes, Report, Row, row_of

TURNS = 3
CLOCKED = """
import time
start = time.perf_counter()
{job}
print(time.perf_counter() - start)
"""
OURS = """
import host.mechanics
from protocol.catheter import load_catheter
from host.mechanics.cosserat import solve_cosserat
assert solve_cosserat(load_catheter("livewire"), 0.01, 10.0, [0.0, 0.05, 0.0]).converged
"""
PEER = """
import numpy as np
from host.studies.benchmarks.boundary_value import solve, unloaded
rod = np.array([1e4, 1e4, 1e4, 1e4, 1e4, 1e4, 0.07, 0.0, 10.0])
assert solve(rod, np.array([0.0, 0.05, 0.0]), unloaded(rod), 1e-6).success
"""


def _seconds(job: str) -> float:
    run = subprocess.run([sys.executable, "-c", CLOCKED.format(job=job)], capture_output=True, text=True, check=True)
    return float(run.stdout.split()[-1])


def import_and_solve(seed: int, _report: Report) -> list[Row]:
    """Import and first solution in a fresh interpreter, compared with scipy's: both without the interpreter's own start."""
    _seconds(OURS)
    timed = PairedTimes()
    for _ in range(TURNS):
        timed.ours_s.append(_seconds(OURS))
        timed.peer_s.append(_seconds(PEER))
    return [row_of("import_and_solve", "filled cache", "scipy solve_bvp imported and run once", timed, seed)]
