"""A pose that the catheter cannot reach is bad input, not something to explain by a force."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.errors import InputError

# How much further than the exposed length a pose may lie from the sheath's exit: noise and registration, not a wrong unit.
REACH_MARGIN_M = 0.020


def check_reach(key: str, position_m: ArrayLike, exposed_m: float) -> None:
    """Raise InputError where the catheter cannot reach a position.

    Arguments: `position_m`, from the sheath's exit; `exposed_m`, length of catheter outside the sheath.
    """
    position = [float(part) for part in np.ravel(position_m)]
    distance_m = math.hypot(*position)
    if distance_m > exposed_m + REACH_MARGIN_M:
        raise InputError(
            key,
            position,
            f"a position at most {1e3 * (exposed_m + REACH_MARGIN_M):.1f} mm from the sheath's exit "
            f"(exposed length {1e3 * exposed_m:.1f} mm and {1e3 * REACH_MARGIN_M:.0f} mm), not {1e3 * distance_m:.1f} mm",
        )


def out_of_reach(positions_m: NDArray[np.float64], exposed_m: ArrayLike) -> NDArray[np.bool_]:
    """Whether positions (n, ..., 2 or 3) of n samples, any sensor of each, lie further off than the catheter reaches.

    exposed_m: (n,) or one length.
    """
    distance = np.linalg.norm(positions_m, axis=-1).reshape(len(positions_m), -1).max(axis=1)
    return np.asarray(distance > np.asarray(exposed_m) + REACH_MARGIN_M)
