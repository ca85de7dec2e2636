"""A pose that the catheter cannot reach is bad input, not something to explain by a force."""

from __future__ import annotations

import math
from collections.abc import Sequence

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


def check_apart(key: str, offsets_m: Sequence[float], positions_m: Sequence[Sequence[float] | NDArray[np.float64]]) -> None:
    """Raise InputError where two neighbouring sensors are further apart than the catheter between them is long.

    Arguments: `offsets_m` (k,), arc lengths back from the tip; `positions_m`, k positions. `key` has a place for the index.
    """
    for i in range(1, len(positions_m)):
        between_m = abs(offsets_m[i] - offsets_m[i - 1])
        apart_m = math.dist(positions_m[i], positions_m[i - 1])
        if apart_m > between_m + REACH_MARGIN_M:
            raise InputError(
                key.format(i),
                [float(part) for part in positions_m[i]],
                f"a position at most {1e3 * (between_m + REACH_MARGIN_M):.1f} mm from the sensor before it "
                f"(catheter between them {1e3 * between_m:.1f} mm and {1e3 * REACH_MARGIN_M:.0f} mm), "
                f"not {1e3 * apart_m:.1f} mm",
            )


def out_of_reach(positions_m: NDArray[np.float64], offsets_m: Sequence[float], exposed_m: ArrayLike) -> NDArray[np.bool_]:
    """Whether `check_reach` or `check_apart` would refuse positions (n, k, 2 or 3) of n samples; not for what is not finite.

    Arguments: offsets_m (k,), arc lengths back from the tip; exposed_m, (n,) or one length.
    """
    exposed = np.broadcast_to(np.asarray(exposed_m), len(positions_m))[:, None]
    far = np.linalg.norm(positions_m, axis=-1) > exposed + REACH_MARGIN_M
    between = np.abs(np.diff(np.asarray(offsets_m)))
    apart = np.linalg.norm(np.diff(positions_m, axis=1), axis=-1) > between + REACH_MARGIN_M
    return np.asarray(far.any(axis=1) | apart.any(axis=1))
