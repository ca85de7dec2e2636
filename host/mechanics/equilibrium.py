"""One equilibrium for a caller: roll of the handle, frame of the force, poses of stations, stability; one call.

Everything between the checked numbers and the result is compiled, because forty small numpy calls cost ten times as
much as the rod itself.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from host.mechanics.base_force import solve_cold, solve_warm
from host.mechanics.branch import CONVERGED
from host.mechanics.cosserat_kernels import BODY_LENGTH, EXACT, POSE, ROW, SHAFT_LENGTH, WORK, sweep
from host.mechanics.sections import section_pose, tip_pose
from host.mechanics.stability import unstable_modes

Array = NDArray[np.float64]

TIP_FRAME, BASE_FRAME = 0, 1
# Layout of a row of results: pose of the tip, then the tip force in both frames, the moment at the base, the load reached.
POSITION, QUATERNION, FORCE_TIP, FORCE_BASE, MOMENT, LOAD, FOUND = 0, 3, 7, 10, 13, 16, 17
# Layout of a row of counts.
STATUS, SWEEPS, LOAD_STEPS, UNSTABLE, WARM, COUNTS = 0, 1, 2, 3, 4, 5


@njit(cache=True, error_model="numpy", nogil=True)
def roll_vector(roll_rad: float, v: Array, out: Array) -> None:
    """Set out (3,) = v (3,) turned about e3 by the roll of the handle; out may be v."""
    c, s = math.cos(roll_rad), math.sin(roll_rad)
    x, y = v[0], v[1]
    out[0], out[1], out[2] = c * x - s * y, s * x + c * y, v[2]


@njit(cache=True, error_model="numpy", nogil=True)
def roll_quaternion(roll_rad: float, q: Array, out: Array) -> None:
    """Set out (4,) = orientation q (4,) turned about e3 by the roll of the handle; out may be q."""
    c, s = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0], out[1], out[2], out[3] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w


@njit(cache=True, error_model="numpy", nogil=True)
def equilibrium(
    rod: Array, force: Array, frame: int, roll_rad: float, start: Array, stations: Array, found: Array, poses: Array
) -> tuple[int, float, int, int, int, bool]:
    """Tip and stations under one tip force. Returns (status, load reached, sweeps, load steps, unstable modes, warm).

    Arguments: rod (9,); force (3,) N in `frame`, TIP_FRAME or BASE_FRAME; start (3,), the force in the tip frame of an
    equilibrium nearby, or (0,) for none; stations (k,) m back from the tip, in any order, inside the sheath too.
    Written: found (17,), layout above, and poses (k, 7); NaN where the status is not CONVERGED. warm: found from `start`.
    """
    n = stations.shape[0]
    out, work, x, held = np.zeros((n + 1, ROW)), np.zeros(WORK), np.empty(3), np.empty(3)
    total = rod[SHAFT_LENGTH] + rod[BODY_LENGTH]
    order = np.argsort(stations, kind="mergesort") if n > 1 else np.arange(n)
    exposed = np.minimum(stations, total)[order]
    status, reached, sweeps, steps, unstable, warm = CONVERGED, 1.0, 1, 0, 0, False
    if frame == TIP_FRAME:
        x[:] = force
        sweep(rod, x, exposed, EXACT, POSE, out, work)
        unstable = unstable_modes(rod, x, work)
    else:
        roll_vector(-roll_rad, force, held)  # the catheter is solved with the handle at zero roll
        sweeps = 0
        if start.shape[0] == 3:
            x[:] = start
            warm, sweeps = solve_warm(rod, held, exposed, EXACT, x, out, work)
            if warm:
                unstable = unstable_modes(rod, x, work)
        if not warm:
            status, reached, more, steps, unstable = solve_cold(rod, held, exposed, EXACT, x, out, work)
            sweeps += more
    if status != CONVERGED:
        found[:] = np.nan
        poses[:] = np.nan
        return status, reached, sweeps, steps, unstable, warm
    base = out[n]
    tip_pose(base, found[POSITION:QUATERNION], found[QUATERNION:FORCE_TIP])
    for i in range(3):
        found[FORCE_TIP + i] = x[i]
        found[FORCE_BASE + i] = base[3 + i]
        a, b = (i + 1) % 3, (i + 2) % 3
        found[MOMENT + i] = base[3 + a] * base[b] - base[3 + b] * base[a]
    for i in range(n):
        place = order[i]
        inside_m = max(stations[place] - total, 0.0)
        section_pose(base, out[i], inside_m, poses[place, :3], poses[place, 3:])
    if roll_rad != 0.0:
        roll_vector(roll_rad, found[POSITION:QUATERNION], found[POSITION:QUATERNION])
        roll_quaternion(roll_rad, found[QUATERNION:FORCE_TIP], found[QUATERNION:FORCE_TIP])
        roll_vector(roll_rad, found[FORCE_BASE:MOMENT], found[FORCE_BASE:MOMENT])
        roll_vector(roll_rad, found[MOMENT:LOAD], found[MOMENT:LOAD])
        for i in range(n):
            roll_vector(roll_rad, poses[i, :3], poses[i, :3])
            roll_quaternion(roll_rad, poses[i, 3:], poses[i, 3:])
    if frame == BASE_FRAME:
        found[FORCE_BASE:MOMENT] = force
    return status, reached, sweeps, steps, unstable, warm


@njit(cache=True, error_model="numpy", nogil=True)
def equilibria(
    rods: Array,
    forces: Array,
    frame: int,
    roll_rad: float,
    stations: Array,
    found: Array,
    poses: Array,
    counts: NDArray[np.int64],
) -> None:
    """`equilibrium` of many cases, each from its unloaded shape: rods (n, 9), forces (n, 3); results (n, ...) written."""
    none = np.zeros(0)
    for i in range(rods.shape[0]):
        status, load, sweeps, steps, unstable, _ = equilibrium(
            rods[i], forces[i], frame, roll_rad, none, stations, found[i], poses[i]
        )
        found[i, LOAD] = load
        counts[i, STATUS], counts[i, SWEEPS], counts[i, LOAD_STEPS], counts[i, UNSTABLE] = status, sweeps, steps, unstable
