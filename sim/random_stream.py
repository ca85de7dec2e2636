"""A small random stream for compiled kernels: 32-bit xorshift, the same numbers with and without the compiler."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

Array = np.ndarray
_MASK = 0xFFFFFFFF


def seeded(seed: int, stream: int) -> int:
    """A non-zero 32-bit start state from `seed` and the number of the `stream`, well mixed."""
    return int(np.random.SeedSequence([seed, stream]).generate_state(1, np.uint32)[0]) | 1


@njit(cache=True)
def uniform(state: Array) -> float:
    """The next number in (0, 1); `state` (1,) int64 advances (Marsaglia 2003, xorshift32)."""
    x = state[0]
    x ^= (x << 13) & _MASK
    x ^= x >> 17
    x ^= (x << 5) & _MASK
    state[0] = x
    return (x + 0.5) / 4294967296.0


@njit(cache=True)
def normal(state: Array) -> float:
    """The next number of a standard normal distribution (Box and Muller)."""
    radius = math.sqrt(-2.0 * math.log(uniform(state)))
    return radius * math.cos(2.0 * math.pi * uniform(state))
