"""Sensor noise of a stated standard deviation, white or coloured (first-order Markov), from a seeded generator."""

from __future__ import annotations

import math

import numpy as np


class MarkovNoise:
    """Zero-mean Gaussian noise, (size,), stationary; `correlation_s` 0 is white.

    n_k = a n_{k-1} + sqrt(1 - a^2) sigma w_k with a = exp(-dt / correlation_s), so that the standard deviation is
    `sigma` whatever the colour.
    """

    def __init__(self, rng: np.random.Generator, size: int, sigma: float, correlation_s: float) -> None:
        if not (sigma >= 0 and correlation_s >= 0):
            raise ValueError(f"noise: found sigma {sigma}, correlation_s {correlation_s}, wanted 0 or more")
        self._rng, self._sigma, self._correlation_s = rng, sigma, correlation_s
        self._value = rng.standard_normal(size) * sigma

    def step(self, dt_s: float) -> np.ndarray:
        """The noise `dt_s` after the last call, (size,)."""
        fresh = self._rng.standard_normal(self._value.size) * self._sigma
        if self._correlation_s > 0:
            a = math.exp(-dt_s / self._correlation_s)
            fresh = a * self._value + math.sqrt(1 - a * a) * fresh
        self._value = fresh
        return fresh.copy()


def generators(seed: int, count: int) -> list[np.random.Generator]:
    """Independent generators, so that one kind of randomness does not shift another's sequence."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
