"""The compiled loop around the control tick, cached on the disk: a process that starts it compiles nothing."""

from __future__ import annotations

import numpy as np
from numba import njit

from realtime.control.tick import tick
from realtime.loop.native_loop import LoopMemory, Schedule, run_loop


@njit(cache=True, nogil=True, error_model="numpy")
def run(memory: LoopMemory, params: np.ndarray, state: np.ndarray, schedule: Schedule) -> int:
    """Run the loop of `realtime.loop.native_loop.make_loop` for the control tick; returns why it ended."""
    return run_loop(tick, memory, params, state, schedule)
