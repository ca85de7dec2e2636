"""Many independent cases spread over threads: the compiled kernels release the interpreter's lock."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

PARTS_PER_THREAD = 8  # some cases take a hundred times as long as others: small parts keep all threads busy


def core_count() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def in_threads(work: Callable[[slice], None], count: int, workers: int | None, least: int = 1) -> None:
    """Call `work` with slices that cover `count` cases.

    Arguments: workers, threads (None: one for each core that this process may use); least, cases that a part has at
    least, so that few cases are not spread at all. An exception of `work` is raised here.
    """
    threads = max(1, core_count() if workers is None else workers)
    parts = 1 if threads == 1 else max(1, min(PARTS_PER_THREAD * threads, count // max(least, 1)))
    edges = np.linspace(0, count, parts + 1).astype(int)
    slices = [slice(a, b) for a, b in itertools.pairwise(edges) if b > a]
    if len(slices) < 2:
        for part in slices:
            work(part)
        return
    with ThreadPoolExecutor(threads) as executor:
        list(executor.map(work, slices))
