"""The exposed part of a catheter as the compiled rod models see it: one checked record of nine numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.catheter import Catheter
from protocol.errors import InputError

Array = NDArray[np.float64]

LARGEST_CURVATURE_per_m = 1000.0
LARGEST_INSERTION_m = 2.0
LARGEST_LOAD_NUMBER = 5000.0


def finite(key: str, value: ArrayLike, shape: tuple[int, ...], wanted: str) -> Array:
    """`value` as floats of that shape. Raises InputError naming `key` where it is not, or where NaN or infinity is in it."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, str(value), wanted) from None
    if array.shape != shape or not np.all(np.isfinite(array)):
        raise InputError(key, array.tolist(), wanted)
    return array


def rod_record(catheter: Catheter, insertion_m: float, curvature_per_m: float) -> Array:
    """Record (9,) of `cosserat_kernels`: compliances of shaft and body 1/(N m2), exposed lengths m, pre-curvature 1/m.

    Arguments: insertion_m, catheter body outside the sheath; negative while part of the shaft is still inside.
    The pre-curvature belongs to the distal shaft, the body has none (section 3.2.3, put right).
    Raises: InputError for a catheter without spatial parameters, a shaft that is all inside, numbers out of range.
    """
    if catheter.cosserat is None:
        raise InputError("catheter", catheter.name, "a catheter with a [cosserat] table: its spatial stiffness is not known")
    insertion = float(finite("insertion_m", insertion_m, (), "a finite length in m"))
    k0 = float(finite("curvature_per_m", curvature_per_m, (), "a finite curvature in 1/m"))
    if not -catheter.distal_length_m < insertion <= LARGEST_INSERTION_m:
        raise InputError(
            "insertion_m",
            insertion,
            f"more than -{catheter.distal_length_m} (some of the distal shaft must "
            f"be outside the sheath) and at most {LARGEST_INSERTION_m}",
        )
    if abs(k0) > LARGEST_CURVATURE_per_m:
        raise InputError("curvature_per_m", k0, f"at most {LARGEST_CURVATURE_per_m} either way")
    p = catheter.cosserat
    stiffness = np.array([p.EI1, p.EI2, p.GJ, p.EbI1, p.EbI2, p.GbJ])
    shaft = catheter.distal_length_m + min(insertion, 0.0)
    return np.concatenate([1.0 / stiffness, [shaft, max(insertion, 0.0), k0]])


def checked_force(key: str, force_N: ArrayLike, rod: Array) -> Array:
    """The force (3,) in N. Raises InputError where it is not three finite numbers, or so large that the rod would coil."""
    force = finite(key, force_N, (3,), "three finite numbers in N")
    length = rod[6] + rod[7]
    limit = LARGEST_LOAD_NUMBER / (length * length * rod[:6].max())
    if float(np.linalg.norm(force)) > limit:
        raise InputError(key, force.tolist(), f"at most {limit:.3g} N for this catheter and length")
    return force


def checked_stations(stations_m: Sequence[float] | Array) -> Array:
    """Arc lengths back from the tip (n,) in m. Raises InputError where one is negative or not finite."""
    stations = np.atleast_1d(np.asarray(stations_m, dtype=np.float64)) if len(stations_m) else np.zeros(0)
    if stations.ndim != 1 or not np.all(np.isfinite(stations)) or np.any(stations < 0.0):
        raise InputError("stations_m", np.asarray(stations_m).tolist(), "a list of arc lengths back from the tip, 0 or more")
    return stations
