"""Tip position to insertion, roll and knob: arc geometry and the fitted knob curve (thesis 6.3, Alg. 6.1 corrected)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from realtime.records import CURVE_POINTS, KINEMATICS_PARAMS

Config = KINEMATICS_PARAMS

_FLAT_SLOPE = 1e-5


def fitted_knob_curve(knob_rad: list[float], curvature_per_m: list[float], max_curvature_per_m: float) -> np.ndarray:
    """Knob angle (rad) on a uniform grid of CURVE_POINTS curvatures in +-max_curvature_per_m.

    Piecewise linear inverse of a recorded sweep. Flat parts (dead zones) of the sweep become steep parts here, by
    a slope too small to matter that is added to them. Beyond the sweep its mean slope goes on.
    """
    knob, curvature = np.asarray(knob_rad, float), np.asarray(curvature_per_m, float)
    span = curvature[-1] - curvature[0]
    rising = curvature + _FLAT_SLOPE * span * (knob - knob[0]) / (knob[-1] - knob[0])
    grid = np.linspace(-max_curvature_per_m, max_curvature_per_m, CURVE_POINTS)
    inside = np.clip(grid, rising[0], rising[-1])
    gain = (knob[-1] - knob[0]) / span
    return np.asarray(np.interp(inside, rising, knob) + gain * (grid - inside))


@njit(cache=True)
def knob_of_curvature(config, curvature_per_m: float) -> float:  # type: ignore[no-untyped-def]
    """Knob angle (rad) for a curvature (1/m), limited to the curve's range."""
    span = 2.0 * config.max_curvature_per_m
    place = (curvature_per_m + config.max_curvature_per_m) / span * (CURVE_POINTS - 1)
    place = min(max(place, 0.0), CURVE_POINTS - 1.0)
    low = min(int(place), CURVE_POINTS - 2)
    share = place - low
    return (1.0 - share) * config.knob_of_curvature_rad[low] + share * config.knob_of_curvature_rad[low + 1]


@njit(cache=True)
def curvature_of_knob(config, knob_rad: float) -> float:  # type: ignore[no-untyped-def]
    """Curvature (1/m) that a knob angle (rad) asks for: the fitted curve read the other way round."""
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
def curvature_of_lateral(lateral_m: float, length_m: float) -> float:
    """Curvature (1/m, not negative) of an arc of `length_m` whose end is `lateral_m` off the axis, by Newton; (7.2).

    The branch with a bend up to the greatest lateral reach (about 2.33 rad); beyond the reach, the bend there.
    """
    ratio = lateral_m / length_m
    if ratio >= 0.7246:
        return 2.3311 / length_m
    bend = 2.0 * ratio
    for _ in range(30):
        if bend < 1e-4:
            value, slope = 0.5 * bend, 0.5
        else:
            value = (1.0 - math.cos(bend)) / bend
            slope = (math.sin(bend) - value) / bend
        step = (value - ratio) / slope
        bend = min(max(bend - step, 0.0), 2.3311)
        if abs(step) < 1e-12:
            break
    return bend / length_m


@njit(cache=True)
def bend_and_insertion(config, lateral_m: float, axial_m: float) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    """Curvature (1/m) and insertion (m) that put the unloaded tip `lateral_m` >= 0 off and `axial_m` along the axis.

    While only part of the distal shaft is out, the whole exposed catheter is one arc: (6.1) corrected, no
    singularity. Beyond its full length the body adds a straight piece and (7.1), (7.2) hold.
    """
    bend = 2.0 * math.atan2(lateral_m, axial_m)
    chord = math.hypot(lateral_m, axial_m)
    half = 0.5 * bend
    length_m = chord if half < 1e-9 else chord * half / math.sin(half)
    if length_m <= config.distal_length_m:
        return bend / max(length_m, 1e-6), length_m - config.distal_length_m
    curvature = curvature_of_lateral(lateral_m, config.distal_length_m)
    bend = curvature * config.distal_length_m
    along = config.distal_length_m if bend < 1e-6 else math.sin(bend) / curvature
    return curvature, axial_m - along


@njit(cache=True)
def _faded(radius_m: float, axis_radius_m: float) -> float:
    """0 up to `axis_radius_m`, 1 from twice that on, smooth between."""
    share = min(max(radius_m / max(axis_radius_m, 1e-9) - 1.0, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@njit(cache=True)
def apply(config, tip_m, last_roll_rad: float, out) -> None:  # type: ignore[no-untyped-def]
    """Insertion (m), roll (rad), knob (rad) of an unloaded catheter with its tip at `tip_m` (3,), into `out` (3,).

    Roll is continuous: of the two branches (bend to one side, or to the other with the roll half a turn away) the
    one nearest to `last_roll_rad` is taken, unwrapped. Near the axis, where noise decides the direction, the roll
    fades into the last one, which stays on the axis itself; only the part of the tip's offset in the plane of that
    roll is then bent for. Positive curvature bends towards -e2 at roll zero.
    """
    radius_m = math.hypot(tip_m[0], tip_m[1])
    roll = math.atan2(tip_m[0], -tip_m[1])
    turn = roll - last_roll_rad
    turn -= math.pi * math.floor(turn / math.pi + 0.5)
    roll = last_roll_rad + turn * _faded(radius_m, config.axis_radius_m)
    lateral_m = tip_m[0] * math.sin(roll) - tip_m[1] * math.cos(roll)
    curvature, insertion = bend_and_insertion(config, abs(lateral_m), tip_m[2])
    out[0] = insertion
    out[1] = roll
    out[2] = knob_of_curvature(config, math.copysign(curvature, lateral_m))
