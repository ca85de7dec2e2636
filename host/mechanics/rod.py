"""The exposed part of a catheter as the compiled rod models see it: one checked record of nine numbers.

Checks of one number cost as much as a sweep along the rod when numpy does them; here a good number passes in plain
Python, and only a bad one is looked at closely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.catheter import Catheter, CosseratParameters
from protocol.errors import InputError

Array = NDArray[np.float64]

LARGEST_CURVATURE_per_m = 1000.0
LARGEST_INSERTION_m = 2.0
LARGEST_LOAD_NUMBER = 5000.0
MOST_THREADS = 1024
NO_STATIONS: Array = np.zeros(0)


def real(key: str, value: ArrayLike, wanted: str) -> Array:
    """Return `value` as floats, whatever its shape. Raises InputError naming `key` where it does not hold real numbers.

    Kernels are compiled for contiguous, writable arrays. Others are copied here: a kernel would be compiled again for each.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # rows of different lengths
        raise InputError(key, str(value), wanted) from None
    if array.dtype.kind not in "fiu" or (isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value)):
        raise InputError(key, str(value), wanted)
    array = array.astype(np.float64, copy=False)
    return array if array.flags.carray else array.copy()


def yes_or_no(key: str, value: object) -> bool:
    """Return `value`, True or False. Raises InputError naming `key`."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(key, str(value), "True or False")
    return bool(value)


def checked_workers(workers: object) -> int | None:
    """Return a number of threads, or None for one on each core. Raises InputError."""
    if workers is None:
        return None
    if isinstance(workers, bool) or not isinstance(workers, int | np.integer) or not 1 <= workers <= MOST_THREADS:
        raise InputError("workers", str(workers), f"a number of threads, 1 to {MOST_THREADS}, or None")
    return int(workers)


def finite(key: str, value: ArrayLike, shape: tuple[int, ...], wanted: str) -> Array:
    """`value` as floats of that shape. Raises InputError naming `key` where it is not, or where NaN or infinity is in it."""
    array = real(key, value, wanted)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(key, array.tolist(), wanted)
    return array


def number(key: str, value: object, wanted: str) -> float:
    """`value` as one finite float. Raises InputError naming `key`."""
    if type(value) is float and math.isfinite(value):
        return value
    return float(finite(key, value, (), wanted))  # type: ignore[arg-type]


def column(key: str, value: ArrayLike, count: int, wanted: str) -> Array:
    """`value`, one number or (count,), as finite floats (count,). Raises InputError naming `key`."""
    numbers = real(key, value, f"{wanted}: one, or {count}, one for each case")
    try:
        array = np.broadcast_to(numbers, (count,))
    except ValueError:
        raise InputError(key, str(value), f"{wanted}: one, or {count}, one for each case") from None
    if not np.isfinite(array).all():
        raise InputError(key, "NaN or infinity", wanted)
    return array


def checked_catheter(catheter: object) -> Catheter:
    """Return `catheter`. Raises InputError where it is none."""
    if not isinstance(catheter, Catheter):
        raise InputError("catheter", repr(catheter), "a Catheter, as load_catheter returns it")
    return catheter


def _compliances(catheter: Catheter) -> tuple[float, ...]:
    checked_catheter(catheter)
    if catheter.cosserat is None:
        raise InputError("catheter", catheter.name, "a catheter with a [cosserat] table: its spatial stiffness is not known")
    return _inverse(catheter.cosserat)


@lru_cache(maxsize=64)
def _inverse(stiffness: CosseratParameters) -> tuple[float, ...]:
    """1/(N m2), computed once for each catheter: shaft about e1, e2, e3, then the body."""
    p = stiffness
    return tuple(1.0 / value for value in (p.EI1, p.EI2, p.GJ, p.EbI1, p.EbI2, p.GbJ))


def rod_record(catheter: Catheter, insertion_m: float, curvature_per_m: float) -> Array:
    """Record (9,) of `cosserat_kernels`: compliances of shaft and body 1/(N m2), exposed lengths m, pre-curvature 1/m.

    Arguments: insertion_m, catheter body outside the sheath; negative while part of the shaft is still inside.
    The pre-curvature belongs to the distal shaft, the body has none (section 3.2.3, corrected).
    Raises: InputError for a catheter without spatial parameters, a shaft that is all inside, numbers out of range.
    """
    compliances = _compliances(catheter)
    insertion = number("insertion_m", insertion_m, "a finite length in m")
    k0 = number("curvature_per_m", curvature_per_m, "a finite curvature in 1/m")
    if not -catheter.distal_length_m < insertion <= LARGEST_INSERTION_m:
        raise _bad_insertion(catheter, insertion)
    if abs(k0) > LARGEST_CURVATURE_per_m:
        raise InputError("curvature_per_m", k0, f"at most {LARGEST_CURVATURE_per_m} either way")
    return np.array((*compliances, catheter.distal_length_m + min(insertion, 0.0), max(insertion, 0.0), k0))


def rod_records(catheter: Catheter, insertion_m: ArrayLike, curvature_per_m: ArrayLike, count: int) -> Array:
    """Records (count, 9) as of `rod_record`; insertion_m and curvature_per_m one number or (count,). Raises InputError."""
    compliances = _compliances(catheter)
    insertion = column("insertion_m", insertion_m, count, "a finite length in m")
    k0 = column("curvature_per_m", curvature_per_m, count, "a finite curvature in 1/m")
    outside = (insertion <= -catheter.distal_length_m) | (insertion > LARGEST_INSERTION_m)
    if outside.any():
        raise _bad_insertion(catheter, float(insertion[outside][0]))
    if (np.abs(k0) > LARGEST_CURVATURE_per_m).any():
        raise InputError("curvature_per_m", float(np.abs(k0).max()), f"at most {LARGEST_CURVATURE_per_m} either way")
    rods = np.empty((count, 9))
    rods[:, :6] = compliances
    rods[:, 6], rods[:, 7], rods[:, 8] = (
        catheter.distal_length_m + np.minimum(insertion, 0.0),
        np.maximum(insertion, 0.0),
        k0,
    )
    return rods


def _bad_insertion(catheter: Catheter, insertion_m: float) -> InputError:
    wanted = (
        f"more than -{catheter.distal_length_m} (some of the distal shaft must be outside the sheath) "
        f"and at most {LARGEST_INSERTION_m}"
    )
    return InputError("insertion_m", insertion_m, wanted)


def largest_force(rod: Array) -> float:
    """Largest force in N that is accepted for the rod (9,): beyond it the rod would coil."""
    c1, c2, c3, b1, b2, b3, shaft, body, _ = rod.tolist()
    return LARGEST_LOAD_NUMBER / ((shaft + body) ** 2 * max(c1, c2, c3, b1, b2, b3))


def checked_force(key: str, force_N: ArrayLike, rod: Array) -> Array:
    """The force (3,) in N. Raises InputError where it is not three finite numbers, or so large that the rod would coil."""
    force = real(key, force_N, "three finite numbers in N").copy()
    if force.shape != (3,):
        raise InputError(key, force.tolist(), "three finite numbers in N")
    x, y, z = force.tolist()
    limit = largest_force(rod)
    if x * x + y * y + z * z <= limit * limit:  # false for NaN and infinity
        return force
    finite(key, force, (3,), "three finite numbers in N")
    raise InputError(key, force.tolist(), f"at most {limit:.3g} N for this catheter and length")


def checked_stations(stations_m: Sequence[float] | Array) -> Array:
    """Arc lengths back from the tip (n,) in m. Raises InputError where one is negative or not finite."""
    if isinstance(stations_m, list | tuple) and not stations_m:
        return NO_STATIONS
    stations = np.atleast_1d(real("stations_m", stations_m, "a list of arc lengths back from the tip, 0 or more"))
    if stations.ndim != 1 or not np.all(np.isfinite(stations)) or np.any(stations < 0.0):
        raise InputError("stations_m", np.asarray(stations_m).tolist(), "a list of arc lengths back from the tip, 0 or more")
    return stations
