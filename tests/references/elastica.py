"""A continuous planar rod by an ODE solver, with pieces of different stiffness and drag: the judge of the arcs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import root


def shape(
    length: ArrayLike,
    EI: ArrayLike,
    kappa0: ArrayLike,
    force: ArrayLike,
    drag: ArrayLike = (0.0, 0.0),
    stations: ArrayLike = (),
    steps: int = 12,
) -> tuple[NDArray, NDArray]:
    """Loaded shape, by shooting on base curvature with the load grown in `steps`.

    Arguments: `length`, `EI`, `kappa0` of each piece; `force` (2,) on the tip; `drag` (2,) per length. Result: tip
    (x, y, angle) and positions (k, 2) at arc lengths `stations` from the base.
    """
    length, EI, kappa0 = (np.asarray(value, dtype=float) for value in (length, EI, kappa0))
    keep = length > 0.0
    length, EI, kappa0 = length[keep], EI[keep], kappa0[keep]
    force, drag = np.asarray(force, dtype=float), np.asarray(drag, dtype=float)
    total = length.sum()
    moment = 0.0
    for load in np.linspace(0.0, 1.0, steps + 1)[1:]:
        found = root(
            lambda m, load=load: _shoot(m[0], length, EI, kappa0, load * force, load * drag)[0][3, -1], [moment], tol=1e-13
        )
        moment = float(found.x[0])
    states, places = _shoot(moment, length, EI, kappa0, force, drag, stations)
    assert abs(states[3, -1]) < 1e-9 * max(1e-3, np.abs(EI * 30.0).max())
    assert np.isclose(sum(length), total)
    return states[:3, -1], places


def _shoot(
    moment: float, length: NDArray, EI: NDArray, kappa0: NDArray, force: NDArray, drag: NDArray, stations: ArrayLike = ()
) -> tuple[NDArray, NDArray]:
    """Integrates x, y, angle and bending moment from the base; M' = -(tangent x internal force)."""
    state, before, total = np.array([0.0, 0.0, 0.0, moment]), 0.0, length.sum()
    places = np.empty((len(np.atleast_1d(stations)) if np.size(stations) else 0, 2))
    for l, stiffness, unloaded in zip(length, EI, kappa0, strict=True):

        def slope(s: float, y: NDArray, stiffness: float = stiffness, unloaded: float = unloaded) -> list[float]:
            inner = force + drag * (total - s)
            c, t = np.cos(y[2]), np.sin(y[2])
            return [c, t, unloaded + y[3] / stiffness, -(c * inner[1] - t * inner[0])]

        done = solve_ivp(slope, (before, before + l), state, method="DOP853", rtol=1e-12, atol=1e-14, dense_output=True)
        for k, s in enumerate(np.atleast_1d(stations) if np.size(stations) else []):
            if before - 1e-12 <= s <= before + l + 1e-12:
                places[k] = done.sol(min(max(s, before), before + l))[:2]
        state, before = done.y[:, -1], before + l
    return np.column_stack([state, state]), places
