"""Tip position to insertion, roll and knob: arc geometry and the fitted knob curve (thesis 6.3, Alg. 6.1 corrected)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.interpolate import PchipInterpolator

from realtime.control.declare import Joint, ReadFloats
from realtime.control.records import CURVE_POINTS, KinematicsParams

# A part of a sweep with less than this share of its median slope is a dead zone.
DEAD_SHARE = 0.05
# The bend of an arc with its end furthest across (rad), and that reach over the arc's length; a bend up to a full turn.
FOLD_BEND, FOLD_REACH = 2.331122370414423, 0.7246113537767085
_FULL_TURN = 2.0 * math.pi - 1e-6


def fitted_knob_curve(knob_rad: list[float], curvature_per_m: list[float], max_curvature_per_m: float) -> np.ndarray:
    """Knob angle (rad) on a uniform grid of CURVE_POINTS curvatures in +-max_curvature_per_m.

    Inverse of a recorded sweep, monotone and shape-preserving (PCHIP) between its dead zones. Over a dead zone inside
    the sweep the inverse jumps: both ends are kept, the grid point in it takes the middle, so the jump is spread over two
    grid steps. A dead zone at an end of the sweep reaches nothing: its inner end is where the curve ends. Beyond the sweep
    the mean slope goes on.
    """
    knob, curvature = np.asarray(knob_rad, float), np.asarray(curvature_per_m, float)
    branches = _bending_branches(knob, curvature)
    grid = np.linspace(-max_curvature_per_m, max_curvature_per_m, CURVE_POINTS)
    first, last = branches[0], branches[-1]
    gain = (last[0][-1] - first[0][0]) / (last[1][-1] - first[1][0])
    out = np.where(grid < 0, first[0][0] + gain * (grid - first[1][0]), last[0][-1] + gain * (grid - last[1][-1]))
    half_step = 0.25 * (grid[1] - grid[0])
    for k, (angle, bent) in enumerate(branches):
        low = bent[0] if k == 0 else bent[0] + half_step
        high = bent[-1] if k == len(branches) - 1 else bent[-1] - half_step
        inside = (grid >= low) & (grid <= high)
        out[inside] = PchipInterpolator(bent, angle)(grid[inside])
        if k > 0:
            between = (grid > branches[k - 1][1][-1] - half_step) & (grid < low)
            out[between] = 0.5 * (branches[k - 1][0][-1] + angle[0])
    return np.maximum.accumulate(out)


def _bending_branches(knob: np.ndarray, curvature: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The sweep cut at its dead zones: (knob, curvature) of each part that bends. Raises ValueError where none does.

    Dead is a part whose slope is below DEAD_SHARE of the sweep's median slope.
    """
    slope = np.diff(curvature) / np.diff(knob)
    bends = slope > DEAD_SHARE * np.median(slope[slope > 0]) if np.any(slope > 0) else np.zeros(len(slope), bool)
    branches, start = [], None
    for i, live in enumerate([*bends, False]):
        if live and start is None:
            start = i
        elif not live and start is not None:
            branches.append((knob[start : i + 1], curvature[start : i + 1]))
            start = None
    if not branches:
        raise ValueError(
            f"curvature_per_m: found {curvature[0]:.3g} to {curvature[-1]:.3g} all along the sweep, "
            "wanted a knob that bends the catheter"
        )
    return branches


@njit(cache=True)
def knob_of_curvature(config: KinematicsParams, curvature_per_m: float) -> float:
    """Knob angle (rad) for a curvature (1/m), limited to the curve's range."""
    span = 2.0 * config.max_curvature_per_m
    place = (curvature_per_m + config.max_curvature_per_m) / span * (CURVE_POINTS - 1)
    place = min(max(place, 0.0), CURVE_POINTS - 1.0)
    low = min(int(place), CURVE_POINTS - 2)
    share = place - low
    return (1.0 - share) * config.knob_of_curvature_rad[low] + share * config.knob_of_curvature_rad[low + 1]


@njit(cache=True)
def curvature_of_knob(config: KinematicsParams, knob_rad: float) -> float:
    """Return the curvature (1/m) of a knob angle (rad): the inverse of the fitted curve."""
    curve = config.knob_of_curvature_rad
    low, high = 0, CURVE_POINTS - 1
    if not (curve[low] < knob_rad < curve[high]):
        return -config.max_curvature_per_m if knob_rad <= curve[low] else config.max_curvature_per_m
    while high - low > 1:
        middle = (low + high) // 2
        if curve[middle] <= knob_rad:
            low = middle
        else:
            high = middle
    share = (knob_rad - curve[low]) / (curve[high] - curve[low])
    return ((low + share) / (CURVE_POINTS - 1) * 2.0 - 1.0) * config.max_curvature_per_m


@njit(cache=True)
def bend_of_reach(ratio: float, beyond: bool) -> float:
    """Bend (rad, not negative) of an arc whose end is `ratio` of its length off the axis; (7.2) by Newton and bisection.

    Two bends reach one place: below the fold at FOLD_BEND, or `beyond` it, up to a full turn. Out of reach: the fold's.
    """
    if ratio >= FOLD_REACH:
        return FOLD_BEND
    low, high = (FOLD_BEND, _FULL_TURN) if beyond else (0.0, FOLD_BEND)
    bend = 0.5 * (low + high) if beyond else min(2.0 * ratio, FOLD_BEND)
    for _ in range(60):
        half = 0.5 * bend
        value = half if bend < 1e-4 else math.sin(half) ** 2 / half
        if (value < ratio) != beyond:
            low = bend
        else:
            high = bend
        slope = 0.5 if bend < 1e-4 else (math.sin(bend) - value) / bend
        last, bend = bend, bend - (value - ratio) / slope if slope != 0.0 else low - 1.0
        if not (low <= bend <= high):
            bend = 0.5 * (low + high)
        if abs(bend - last) < 1e-13:
            break
    return bend


@njit(cache=True)
def bend_and_insertion(config: KinematicsParams, lateral_m: float, axial_m: float) -> tuple[float, float]:
    """Curvature (1/m) and insertion (m) that put the unloaded tip `lateral_m` >= 0 off and `axial_m` along the axis.

    While only part of the distal shaft is out, the whole exposed catheter is one arc: (6.1) corrected, no
    singularity. Beyond its full length the body adds a straight piece and (7.1), (7.2) hold, below the fold.
    """
    bend = 2.0 * math.atan2(lateral_m, axial_m)
    chord = math.hypot(lateral_m, axial_m)
    half = 0.5 * bend
    length_m = chord if half < 1e-9 else chord * half / max(math.sin(half), 1e-12)
    if length_m <= config.distal_length_m:
        return bend / max(length_m, 1e-6), length_m - config.distal_length_m
    return _with_body_out(config, lateral_m, axial_m, False)


@njit(cache=True)
def _with_body_out(config: KinematicsParams, lateral_m: float, axial_m: float, beyond: bool) -> tuple[float, float]:
    """Curvature (1/m) and insertion (m) by (7.1), (7.2): the whole distal shaft bends, on either side of the fold."""
    bend = bend_of_reach(lateral_m / config.distal_length_m, beyond)
    along = config.distal_length_m * (1.0 if bend < 1e-6 else math.sin(bend) / bend)
    return bend / config.distal_length_m, axial_m - along


@njit(cache=True)
def _faded(radius_m: float, axis_radius_m: float) -> float:
    """Return a smooth step: 0 up to `axis_radius_m`, 1 from twice that on."""
    share = min(max(radius_m / max(axis_radius_m, 1e-9) - 1.0, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@njit(cache=True)
def roll_of(config: KinematicsParams, tip_m: ReadFloats, last_roll_rad: float) -> float:
    """Return the roll (rad) nearest to `last_roll_rad` of a tip at `tip_m` (3,), held near the axis."""
    return _roll_and_lateral(config, tip_m, last_roll_rad)[0]


@njit(cache=True)
def _roll_and_lateral(config: KinematicsParams, tip_m: ReadFloats, last_roll_rad: float) -> tuple[float, float]:
    """Roll (rad) nearest to `last_roll_rad`, unwrapped, and the tip's offset (m, signed) in the plane of that roll."""
    radius_m = math.hypot(tip_m[0], tip_m[1])
    roll = math.atan2(tip_m[0], -tip_m[1])
    turn = roll - last_roll_rad
    turn -= math.pi * math.floor(turn / math.pi + 0.5)
    roll = last_roll_rad + turn * _faded(radius_m, config.axis_radius_m)
    return roll, tip_m[0] * math.sin(roll) - tip_m[1] * math.cos(roll)


@njit(cache=True)
def apply(config: KinematicsParams, tip_m: ReadFloats, last_roll_rad: float) -> Joint:
    """Return insertion (m), roll (rad), knob (rad) of an unloaded catheter with its tip at `tip_m` (3,).

    Roll is continuous: of the two branches (bend to one side, or to the other with the roll half a turn away) the
    one nearest to `last_roll_rad` is taken, unwrapped. Near the axis, where noise decides the direction, the roll
    fades into the last one, which stays on the axis itself; only the part of the tip's offset in the plane of that
    roll is then bent for. Positive curvature bends towards -e2 at roll zero. The bend is the one below the fold:
    `apply_nearest` chooses by the last knob as well.
    """
    roll, lateral_m = _roll_and_lateral(config, tip_m, last_roll_rad)
    curvature, insertion = bend_and_insertion(config, abs(lateral_m), tip_m[2])
    return insertion, roll, knob_of_curvature(config, math.copysign(curvature, lateral_m))


@njit(cache=True)
def apply_nearest(config: KinematicsParams, tip_m: ReadFloats, last_joint: ReadFloats) -> Joint:
    """Return the joints as `apply` does, on the branches of roll and knob nearest to `last_joint` (3,) (m, rad, rad).

    Past the fold (Algorithm 6.1's other curve) counts where it is not out of the knob's range and the whole distal shaft
    is out.
    """
    length_m = config.distal_length_m
    roll, lateral_m = _roll_and_lateral(config, tip_m, last_joint[1])
    curvature, insertion = bend_and_insertion(config, abs(lateral_m), tip_m[2])
    other, other_m = _with_body_out(config, abs(lateral_m), tip_m[2], True)
    if other_m >= -1e-6 and other <= config.max_curvature_per_m:
        last = math.copysign(1.0, lateral_m) * curvature_of_knob(config, last_joint[2])
        here = abs(curvature - last) * length_m + abs(insertion - last_joint[0]) / length_m
        if abs(other - last) * length_m + abs(other_m - last_joint[0]) / length_m < here:
            curvature, insertion = other, other_m
    return insertion, roll, knob_of_curvature(config, math.copysign(curvature, lateral_m))


@njit(cache=True)
def out_of_reach_m(config: KinematicsParams, tip_m: ReadFloats, least_m: float, most_m: float, knob_rad: float) -> float:
    """How far (m) a wanted tip (3,) is from the nearest that either branch comes to within the limits.

    least_m, most_m: of the insertion; knob_rad: how far the knob turns either way. Roll is taken as free.
    """
    length_m, across_m = config.distal_length_m, math.hypot(tip_m[0], tip_m[1])
    bend_most = min(config.max_curvature_per_m, abs(curvature_of_knob(config, knob_rad)))
    off_m = math.inf
    for beyond in (False, True):
        found = bend_and_insertion(config, across_m, tip_m[2])
        if beyond:
            found = _with_body_out(config, across_m, tip_m[2], True)
        curvature = min(found[0], bend_most)
        insertion_m = min(max(found[1], least_m, -length_m), most_m)
        arc_m = max(length_m + min(insertion_m, 0.0), 0.0)
        bend = curvature * arc_m
        lateral_m = 0.5 * bend * arc_m if bend < 1e-5 else (1.0 - math.cos(bend)) / curvature
        along_m = max(insertion_m, 0.0) + (arc_m if bend < 1e-5 else math.sin(bend) / curvature)
        off_m = min(off_m, math.hypot(lateral_m - across_m, along_m - tip_m[2]))
    return off_m
