"""Contact of the tip with tissue: a wall whose force follows depth, rate and history, with friction along it.

The force is solved together with the catheter's compliance within the step, so that stiff walls and the making and
breaking of contact stay stable; the force reported follows the law at the place where the tip ended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

Array = np.ndarray
LINEAR, POWER, EXPONENTIAL = 0, 1, 2
_REFERENCE_DEPTH_M = 2.0e-4  # a power law has the linear wall's force at this depth


@dataclass(frozen=True)
class TissueConfig:
    """Wall at `point_m` with `normal` out of the tissue towards the catheter (base frame)."""

    point_m: tuple[float, float, float] = (0.0, 0.0, 0.025)
    normal: tuple[float, float, float] = (0.0, 0.0, -1.0)
    stiffness_N_per_m: float = 1000.0
    exponent: float = 1.0  # of depth; 1.5 is Hertz'
    exponential_depth_m: float = 0.0  # above 0: stiffness * depth0 * (exp(depth/depth0) - 1)
    hunt_crossley_s_per_m: float = 0.0  # force * (1 + this * depth rate)
    viscosity_N_s_per_m: float = 0.0
    relaxing_N_per_m: float = 0.0  # a Maxwell branch parallel to the spring
    relaxation_s: float = 0.1
    friction: float = 0.0
    bristle_N_per_m: float = 2000.0  # tangential stiffness while it sticks


TISSUE_PARAMETERS = np.dtype(
    [
        ("point", "f8", (3,)),
        ("normal", "f8", (3,)),
        ("along", "f8", (2, 3)),
        ("law", "i8"),
        ("stiffness", "f8"),
        ("exponent", "f8"),
        ("depth0", "f8"),
        ("hunt_crossley", "f8"),
        ("viscosity", "f8"),
        ("relaxing", "f8"),
        ("relaxation_s", "f8"),
        ("friction", "f8"),
        ("bristle", "f8"),
    ],
    align=True,
)
TISSUE_STATE = np.dtype(
    [
        ("depth_m", "f8"),
        ("relaxing_N", "f8"),
        ("stretch", "f8", (2,)),
        ("last_tip", "f8", (3,)),
        ("began", "i8"),
        ("normal_force", "f8"),
        ("solved", "f8", (3,)),
        ("force", "f8", (3,)),
    ],
    align=True,
)


def parameters(config: TissueConfig) -> np.record:
    """`config` as the kernel's record, the normal of unit length. Raises ValueError for a normal of no length."""
    p = np.zeros(1, TISSUE_PARAMETERS).view(np.recarray)[0]
    normal = np.asarray(config.normal, float)
    size = float(np.linalg.norm(normal))
    if not size > 1e-9:
        raise ValueError(f"tissue.normal: found {config.normal}, wanted a vector of some length")
    p.point[:], p.normal[:] = config.point_m, normal / size
    p.along[0] = np.cross(p.normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    p.along[0] /= np.linalg.norm(p.along[0])
    p.along[1] = np.cross(p.normal, p.along[0])
    set_law(p, config.exponent, config.exponential_depth_m)
    p.stiffness, p.hunt_crossley = config.stiffness_N_per_m, config.hunt_crossley_s_per_m
    p.viscosity, p.relaxing, p.relaxation_s = config.viscosity_N_s_per_m, config.relaxing_N_per_m, config.relaxation_s
    p.friction, p.bristle = config.friction, config.bristle_N_per_m
    return p


def set_law(p: np.record, exponent: float, exponential_depth_m: float) -> None:
    """Choose the elastic law of record `p`: linear, a power of depth, or exponential."""
    p.exponent, p.depth0 = exponent, exponential_depth_m
    p.law = EXPONENTIAL if exponential_depth_m > 0.0 else (LINEAR if exponent == 1.0 else POWER)


def start() -> np.record:
    """State of tissue that nothing touches."""
    return np.zeros(1, TISSUE_STATE).view(np.recarray)[0]


@njit(cache=True)
def law(p, s, depth_m: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Normal force (N, never a pull) at `depth_m` reached from the state's depth within `dt_s`."""
    depth = max(depth_m, 0.0)
    rate = (depth - max(s.depth_m, 0.0)) / dt_s
    if p.law == LINEAR:
        force = p.stiffness * depth
    elif p.law == POWER:
        force = p.stiffness * _REFERENCE_DEPTH_M * (depth / _REFERENCE_DEPTH_M) ** p.exponent
    else:
        force = p.stiffness * p.depth0 * (math.exp(min(depth / p.depth0, 30.0)) - 1.0)
    force *= max(0.0, 1.0 + p.hunt_crossley * rate)
    if depth > 0.0:
        force += p.viscosity * rate
    return max(0.0, force + _relaxing(p, s, rate, dt_s))


@njit(cache=True)
def _relaxing(p, s, rate: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """Force of the Maxwell branch after `dt_s` at depth rate `rate` (backward Euler)."""
    if p.relaxing <= 0.0:
        return 0.0
    return (s.relaxing_N + p.relaxing * rate * dt_s) / (1.0 + dt_s / p.relaxation_s)


@njit(cache=True)
def _normal_force(p, s, free_depth_m: float, compliance: float, dt_s: float) -> float:  # type: ignore[no-untyped-def]
    """The force at which law(depth) and depth = free depth - compliance * force meet (regula falsi, Illinois)."""
    if free_depth_m <= 0.0:
        return 0.0
    high, low = free_depth_m, 0.0
    at_high, at_low = -compliance * law(p, s, high, dt_s), free_depth_m - compliance * law(p, s, 0.0, dt_s)
    if at_low <= 0.0:
        return free_depth_m / compliance
    depth = high
    for _ in range(60):
        if at_low - at_high <= 0.0:
            break
        depth = (low * at_high - high * at_low) / (at_high - at_low)
        value = free_depth_m - depth - compliance * law(p, s, depth, dt_s)
        if abs(value) < 1e-13:
            break
        if value > 0.0:
            low, at_low = depth, value
            at_high *= 0.5
        else:
            high, at_high = depth, value
            at_low *= 0.5
    return law(p, s, depth, dt_s)


@njit(cache=True)
def _form(a: Array, m: Array, b: Array) -> float:
    """a . m b for vectors (3,) and a matrix (3,3)."""
    total = 0.0
    for i in range(3):
        total += a[i] * (m[i, 0] * b[0] + m[i, 1] * b[1] + m[i, 2] * b[2])
    return total


@njit(cache=True)
def solve(p, s, free_tip: Array, heart_m: float, compliance: Array, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """s.solved (3,): force on the catheter within the step, in balance with the tip's `compliance` (3,3, m/N).

    free_tip: tip (3,) after the step if nothing touched it; heart_m: the wall's displacement along its normal.
    """
    n = p.normal
    depth = heart_m
    for i in range(3):
        depth -= n[i] * (free_tip[i] - p.point[i])
    c = _form(n, compliance, n)
    force_n = _normal_force(p, s, depth, c, dt_s)
    f0 = f1 = 0.0
    if p.friction > 0.0 and force_n > 0.0:
        c0, c1 = _form(n, compliance, p.along[0]), _form(n, compliance, p.along[1])
        for _ in range(4):
            f0, f1 = _tangential(p, s, free_tip, compliance, c0, c1, force_n)
            force_n = _normal_force(p, s, depth - c0 * f0 - c1 * f1, c, dt_s)
    for i in range(3):
        s.solved[i] = n[i] * force_n + p.along[0, i] * f0 + p.along[1, i] * f1


@njit(cache=True)
def _tangential(p, s, free_tip: Array, compliance: Array, c0: float, c1: float, force_n: float) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    """Friction along the wall's two directions: bristles stretched by the slide, no more than the cone allows."""
    b0, b1 = s.stretch[0] + c0 * force_n, s.stretch[1] + c1 * force_n
    if s.began:
        for i in range(3):
            b0 += p.along[0, i] * (free_tip[i] - s.last_tip[i])
            b1 += p.along[1, i] * (free_tip[i] - s.last_tip[i])
    m00 = _form(p.along[0], compliance, p.along[0]) + 1.0 / p.bristle
    m11 = _form(p.along[1], compliance, p.along[1]) + 1.0 / p.bristle
    m01 = _form(p.along[0], compliance, p.along[1])
    det = m00 * m11 - m01 * m01
    f0, f1 = -(m11 * b0 - m01 * b1) / det, -(m00 * b1 - m01 * b0) / det
    size = math.hypot(f0, f1)
    limit = p.friction * force_n
    if size > limit:
        f0, f1 = f0 * limit / size, f1 * limit / size
    return f0, f1


@njit(cache=True)
def report(p, s, tip: Array, heart_m: float, dt_s: float) -> None:  # type: ignore[no-untyped-def]
    """s.force (3,) on the catheter by the law at the tip's final place (3,), and the history that goes with it."""
    depth = heart_m
    for i in range(3):
        depth -= p.normal[i] * (tip[i] - p.point[i])
    force_n = law(p, s, depth, dt_s)
    s.relaxing_N = _relaxing(p, s, (max(depth, 0.0) - max(s.depth_m, 0.0)) / dt_s, dt_s)
    s.depth_m, s.normal_force = depth, force_n
    f0 = f1 = 0.0
    if p.friction > 0.0 and force_n > 0.0:
        for k in range(2):
            for i in range(3):
                s.stretch[k] += p.along[k, i] * (tip[i] - s.last_tip[i]) if s.began else 0.0
        f0, f1 = -p.bristle * s.stretch[0], -p.bristle * s.stretch[1]
        size, limit = math.hypot(f0, f1), p.friction * force_n
        if size > limit:
            f0, f1 = f0 * limit / size, f1 * limit / size
    s.stretch[0], s.stretch[1] = -f0 / p.bristle, -f1 / p.bristle
    s.began = 1
    for i in range(3):
        s.last_tip[i] = tip[i]
        s.force[i] = p.normal[i] * force_n + p.along[0, i] * f0 + p.along[1, i] * f1
