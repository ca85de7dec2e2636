"""Random rods and catheters for the tests of the spatial model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from host.mechanics.rod import rod_record
from protocol.catheter import Catheter, CosseratParameters, load_catheter

Array = NDArray[np.float64]

SPATIAL = ("livewire", "steerocath_t", "blazer_prime_xp")


def unit(rng: np.random.Generator) -> Array:
    """A direction, all alike."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def rod_of(name: str, insertion_m: float, curvature_per_m: float) -> Array:
    """Record (9,) of a shipped catheter."""
    return rod_record(load_catheter(name), insertion_m, curvature_per_m)


def uniform_catheter(EI1: float, EI2: float, GJ: float, length_m: float = 0.07) -> Catheter:
    """A catheter whose body is as stiff as its shaft."""
    return Catheter("uniform", length_m, 0.00233, 0.0007, cosserat=CosseratParameters(EI1, EI2, GJ, EI1, EI2, GJ))


def random_catheter(rng: np.random.Generator) -> Catheter:
    """Stiffnesses 1e-4 to 4e-4 N m2, as the benchmark's inputs."""
    return uniform_catheter(*rng.uniform(1e-4, 4e-4, 3))
