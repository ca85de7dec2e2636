"""Every force term of the vocabulary in one kernel: along a measured motion, or inside the equation of motion of an axis."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from host.diagnosis.model.operators import followed

Array = npt.NDArray[np.float64]
SLOTS = (
    "coulomb",
    "static_excess",
    "stribeck_speed",
    "presliding",
    "presliding_distance",
    "load_friction",
    "load_friction_distance",
    "viscous",
    "drag",
    "viscous_asymmetry",
    "quadratic",
    "cubic",
    "maxwell_stiffness",
    "maxwell_time",
    "softening",
    "sine",
    "cosine",
    "pitch",
    "frequency",
    "second_mass",
    "second_omega",
    "second_damping",
    "contact_stiffness",
    "contact_place",
    "contact_exponent",
    "contact_damping",
    "stiffness",
    "gap",
    "backward_ratio",
    "stribeck_distance",
    "moment_sine",
    "moment_cosine",
    "slip_1",
    "slip_2",
    "slip_3",
    "slip_4",
    "slip_ratio",
    "drive_dead_band",
    "drive_limit",
    "smooth",
    "smooth_speed",
    "load_smooth",
    "load_smooth_speed",
    "constant",
    "load_zero",
    "added_mass",
    "smooth_excess",
    "smooth_stribeck",
    "smooth_power",
    "bristle_damping",
    "spring",
)
PLACE = {name: index for index, name in enumerate(SLOTS)}
(
    COULOMB,
    EXCESS,
    STRIBECK,
    PRESLIDING,
    PRE_DISTANCE,
    LOAD,
    LOAD_DISTANCE,
    VISCOUS,
    DRAG,
    ASYMMETRY,
    QUADRATIC,
    CUBIC,
    MAXWELL_K,
    MAXWELL_T,
    SOFTENING,
    SINE,
    COSINE,
    PITCH,
    FREQUENCY,
    MASS2,
    OMEGA2,
    DAMPING2,
    CONTACT_K,
    CONTACT_X,
    CONTACT_N,
    CONTACT_C,
    STIFFNESS,
    GAP,
    BACKWARD,
    STRIBECK_D,
    MOMENT_S,
    MOMENT_C,
    SLIP_1,
    SLIP_2,
    SLIP_3,
    SLIP_4,
    SLIP_RATIO,
    DRIVE_DEAD,
    DRIVE_LIMIT,
    SMOOTH,
    SMOOTH_SPEED,
    LOAD_SMOOTH,
    LOAD_SMOOTH_SPEED,
    CONSTANT,
    LOAD_ZERO,
    ADDED_MASS,
    SMOOTH_EXCESS,
    SMOOTH_STRIBECK,
    SMOOTH_POWER,
    BRISTLE_DAMPING,
    SPRING,
) = range(len(SLOTS))
TWO_PI = 2.0 * math.pi
SHARP = 0.1  # bend of a motion at its reversal, over the tolerance, from which its samples place the reversal
FOOT = 1.0 / (math.sqrt(10.0) - 1.0)  # of a parabola before its height is 0.1, in the time it takes from there to 1


class SmoothLaw(NamedTuple):
    """The smooth force terms of a parameter array, read once: the solver evaluates them many times in each sample."""

    damping: float
    drag: float
    asymmetry: float
    spring: float
    quadratic: float
    cubic: float
    constant: float
    branch: float  # stiffness of the Maxwell branch
    softening: float  # of the stiffness, over time
    stiffness: float  # that a gap takes away
    gap: float
    amplitude: float  # of the force that is periodic over the place or over time: amplitude*sin(... + phase)
    phase: float
    per_place: float
    per_time: float
    moment: float  # of a weight that turns: moment*sin(x + lean)
    lean: float
    contact_place: float
    contact_exponent: float
    contact_stiffness: float
    contact_damping: float


@njit(cache=True)
def smooth_law(p: Array) -> SmoothLaw:
    """The terms of `smooth_force` in the parameter array `p`."""
    return SmoothLaw(
        p[VISCOUS],
        p[DRAG],
        p[ASYMMETRY],
        p[SPRING],
        p[QUADRATIC],
        p[CUBIC],
        p[CONSTANT],
        p[MAXWELL_K],
        p[SOFTENING] * p[STIFFNESS],
        p[STIFFNESS],
        p[GAP],
        math.hypot(p[SINE], p[COSINE]),
        math.atan2(p[COSINE], p[SINE]),
        TWO_PI / p[PITCH] if p[PITCH] > 0.0 else 0.0,
        TWO_PI * p[FREQUENCY] if p[FREQUENCY] > 0.0 else 0.0,
        math.hypot(p[MOMENT_S], p[MOMENT_C]),
        math.atan2(p[MOMENT_C], p[MOMENT_S]),
        p[CONTACT_X],
        p[CONTACT_N],
        p[CONTACT_K],
        p[CONTACT_C],
    )


@njit(cache=True)
def smooth_force(x: float, v: float, t: float, slow: float, law: SmoothLaw) -> float:
    """Force without dry friction: against the motion, to be overcome by the input. `slow`: x after the lag of the
    Maxwell branch.
    """
    force = (
        (law.damping + law.drag * abs(v)) * v
        + law.asymmetry * abs(v)
        + (law.spring + (law.quadratic + law.cubic * x) * x) * x
    )
    force += law.constant + law.branch * (x - slow) + law.softening * t * x
    force -= law.stiffness * min(max(x, -law.gap), law.gap)
    if law.per_place > 0.0:
        force += law.amplitude * math.sin(law.per_place * x + law.phase)
    if law.per_time > 0.0:
        force += law.amplitude * math.sin(law.per_time * t + law.phase)
    if law.moment != 0.0:
        force += law.moment * math.sin(x + law.lean)
    depth = x - law.contact_place
    if law.contact_exponent > 0.0 and depth > 0.0:
        force += depth**law.contact_exponent * (law.contact_stiffness + law.contact_damping * v)
    return force


@njit(cache=True)
def level_at(v: float, p: Array) -> float:
    """Dry friction's level at speed v: Coulomb's, and what it has more at rest."""
    return p[COULOMB] + (p[EXCESS] * math.exp(-((v / p[STRIBECK]) ** 2)) if p[STRIBECK] > 0.0 else 0.0)


@njit(cache=True)
def _smooth_level(v: float, p: Array) -> float:
    """Level at speed v of the friction without a corner: that of Coulomb, and what it has more at low speed."""
    excess = p[SMOOTH_EXCESS] * math.exp(-((v / p[SMOOTH_STRIBECK]) ** 2)) if p[SMOOTH_STRIBECK] > 0.0 else 0.0
    return p[SMOOTH] + excess


@njit(cache=True)
def _rising(v: float, load: float, p: Array) -> float:
    """Friction at speed v of the laws that rise with speed, one of which follows the load; nothing where there is none."""
    force = _smooth_level(v, p) * _risen(v / p[SMOOTH_SPEED], p[SMOOTH_POWER])[0] if p[SMOOTH_SPEED] > 0.0 else 0.0
    if p[LOAD_SMOOTH_SPEED] > 0.0:
        force += p[LOAD_SMOOTH] * abs(load - p[LOAD_ZERO]) * math.tanh(v / p[LOAD_SMOOTH_SPEED])
    return force


@njit(cache=True)
def _risen(u: float, power: float) -> tuple[float, float]:
    """Share of friction that there is at `u` times the speed below which it rises, and its derivative by u.

    power: u / (1 + abs(u)^power)^(1/power), or tanh(u) where it is 0. It approaches 1 the more slowly the smaller it is.
    """
    if power <= 0.0:
        bent = math.tanh(u)
        return bent, 1.0 - bent * bent
    if abs(u) > 1e6:
        return math.copysign(1.0, u), 0.0
    whole = 1.0 + abs(u) ** power
    root = whole ** (-1.0 / power)
    return u * root, root / whole


@njit(cache=True)
def _slowed(v_free: float, lost: float, rise: float, power: float) -> float:
    """Speed v with v + lost*risen(v/rise) = v_free: friction that rises with speed over one step, by Newton's method.

    Explicit steps would have to be as short as the mass takes to stop from the speed `rise`.
    """
    if rise <= 0.0:
        return v_free
    if lost <= 0.0:
        return v_free - lost * _risen(v_free / rise, power)[0]
    low, high = min(v_free, 0.0), max(v_free, 0.0)
    slides = abs(v_free) > lost + rise
    v = v_free - math.copysign(lost, v_free) if slides else rise * math.atanh(0.999 * v_free / (lost + rise))
    v = min(max(v, low), high)
    for _ in range(20):
        share, steepness = _risen(v / rise, power)
        error = v + lost * share - v_free
        if error > 0.0:
            high = v
        else:
            low = v
        step = error / (1.0 + lost / rise * steepness)
        if abs(step) <= 1e-9 * (abs(v) + rise):
            break
        v = v - step if low < v - step < high else 0.5 * (low + high)
    return v


@njit(cache=True)
def _slowed_by_rising(v_free: float, load: float, h_over_m: float, p: Array) -> float:
    """Speed after the laws that rise with speed (`_rising`) have acted over one step, one after the other."""
    v = _slowed(v_free, h_over_m * _smooth_level(v_free, p), p[SMOOTH_SPEED], p[SMOOTH_POWER])
    return _slowed(v, h_over_m * p[LOAD_SMOOTH] * abs(load - p[LOAD_ZERO]), p[LOAD_SMOOTH_SPEED], 0.0)


@njit(cache=True)
def hysteresis(z: Array, dx: float, v: float, load: float, p: Array) -> float:
    """Presliding and load-dependent friction after a step dx at speed v; `z` (6,) is moved on: four Maxwell elements (or
    one of Dahl, whose bristles may be damped), the load's, and the bristles of Stribeck friction.
    """
    force = 0.0
    side = 1.0 if dx > 0.0 else -1.0
    if p[PRESLIDING] != 0.0:
        if p[SLIP_1] != 0.0 or p[SLIP_2] != 0.0 or p[SLIP_3] != 0.0 or p[SLIP_4] != 0.0:
            distance = p[PRE_DISTANCE] / p[SLIP_RATIO] ** 2
            for j in range(4):
                z[j] = min(max(z[j] + dx / distance, -1.0), 1.0)
                force += p[SLIP_1 + j] * z[j]
                distance *= p[SLIP_RATIO]
        else:
            z[0] = side + (z[0] - side) * math.exp(-abs(dx) / p[PRE_DISTANCE])
            force += p[PRESLIDING] * z[0]
            if dx != 0.0:
                force += p[BRISTLE_DAMPING] * (1.0 - z[0] * side) * v
    if p[LOAD] != 0.0:
        z[4] = side + (z[4] - side) * math.exp(-abs(dx) / p[LOAD_DISTANCE])
        force += p[LOAD] * abs(load - p[LOAD_ZERO]) * z[4]
    if p[STRIBECK_D] > 0.0:
        z[5] = side + (z[5] - side) * math.exp(-abs(dx) / p[STRIBECK_D])
        force += level_at(v, p) * z[5]
    return force * (1.0 + p[BACKWARD] * (1.0 if force < 0.0 else 0.0))


@njit(cache=True)
def start_state(z: Array, start: float, load: float, p: Array) -> float:
    """Friction states such that together they hold `start` at the first sample, as far as they can; returns Coulomb's
    share. A branch that relaxes holds what friction cannot (`relaxed_by`).
    """
    level = p[COULOMB] + p[EXCESS] + p[PRESLIDING] + p[LOAD] * abs(load - p[LOAD_ZERO])
    share = min(max(start / level, -1.0), 1.0) if level != 0.0 else 0.0
    z[:] = share
    return share


@njit(cache=True)
def _foot(x: Array, top: int, near: int, i: int, tolerance: float) -> int:
    """Last sample of a movement that has gone back by `tolerance` at sample i. top: its extreme; near: its last sample
    within a tenth of `tolerance` of that.

    Where the parabola through the extreme and its neighbours bends more than noise can, its vertex decides whether the
    extreme sample has turned already; after a rest it is the foot of the parabola through `near` and i.
    """
    if 1 <= top < x.size - 1:
        bend = x[top - 1] - 2.0 * x[top] + x[top + 1]
        if abs(bend) > SHARP * tolerance:
            return top - 1 if (x[top - 1] - x[top + 1]) / bend < 0.0 else top
    return near - int(FOOT * (i - near) + 0.5)


@njit(cache=True)
def relaxed_by(start: float, p: Array) -> float:
    """Extension of the Maxwell branch at the first sample: it holds the force `start` where there is no dry friction."""
    dry = p[COULOMB] + p[EXCESS] + p[PRESLIDING] + p[LOAD]
    return start / p[MAXWELL_K] if p[MAXWELL_K] != 0.0 and dry == 0.0 else 0.0


@njit(cache=True)
def sides(x: Array, tolerance: float) -> Array:
    """Direction (n,) of the movement that each sample belongs to, +1 or -1, 0 before the first.

    A movement has turned where it goes back by more than `tolerance`. It did so not there but where it set off (`_foot`).
    """
    out = np.zeros(x.size)
    high, low, at_high, at_low, begun, side = x[0], x[0], 0, 0, 0, 0.0
    top, bottom = 0, 0
    for i in range(1, x.size):
        top, bottom = i if x[i] > high else top, i if x[i] < low else bottom
        high, low = max(high, x[i]), min(low, x[i])
        at_high = i if x[i] > high - 0.1 * tolerance else at_high
        at_low = i if x[i] < low + 0.1 * tolerance else at_low
        if side >= 0.0 and x[i] < high - tolerance:
            foot = max(_foot(x, top, at_high, i, tolerance), begun)
            out[begun + 1 : foot + 1] = side
            begun, side, low, at_low, bottom = foot, -1.0, x[i], i, i
        elif side <= 0.0 and x[i] > low + tolerance:
            foot = max(_foot(x, bottom, at_low, i, tolerance), begun)
            out[begun + 1 : foot + 1] = side
            begun, side, high, at_high, top = foot, 1.0, x[i], i, i
    out[begun + 1 :] = side
    return out


@njit(cache=True)
def along(
    x: Array, v: Array, a: Array, load: Array, t: Array, dt_s: float, tolerance: float, start: float, p: Array
) -> Array:
    """Force of all terms along a measured motion x, v, a (n,)."""
    out = np.empty(x.size)
    z = np.zeros(6)
    rest, law = start_state(z, start, load[0], p), smooth_law(p)
    dry = p[COULOMB] != 0.0 or p[EXCESS] != 0.0
    side = sides(x, tolerance) if dry and p[STRIBECK_D] <= 0.0 else z
    slow = x[0] - relaxed_by(start, p)
    decay = math.exp(-dt_s / p[MAXWELL_T]) if p[MAXWELL_T] > 0.0 else 0.0
    for i in range(x.size):
        dx = x[i] - x[i - 1] if i > 0 else 0.0
        slow = x[i] + (slow - x[i]) * decay
        out[i] = smooth_force(x[i], v[i], t[i], slow, law) + hysteresis(z, dx, v[i], load[i], p)
        out[i] += _rising(v[i], load[i], p) + p[ADDED_MASS] * a[i]
        if dry and p[STRIBECK_D] <= 0.0:
            out[i] += level_at(v[i], p) * (side[i] if side[i] != 0.0 else rest)
    return out + second_mass(a, dt_s, p) if p[MASS2] > 0.0 else out


@njit(cache=True)
def second_mass(a: Array, dt_s: float, p: Array) -> Array:
    """Force (n,) of the second mass on an axis of acceleration `a` (n,), which it followed before: its own acceleration is
    that of the axis behind a mode.

    An input that is linear between samples has less of a fast signal than the signal itself, by (w dt)^2 / 12, which its
    second difference gives back.
    """
    full = a.copy()
    full[1:-1] -= (a[2:] - 2.0 * a[1:-1] + a[:-2]) / 12.0
    return p[MASS2] * followed(full, dt_s, 2.0 * p[DAMPING2] / p[OMEGA2], 1.0 / p[OMEGA2] ** 2)


class ForcedAxis(NamedTuple):
    """What moves an axis, without its dry friction. The second mass is one over that of the axis."""

    mass: float
    damping: float
    stiffness: float
    second_mass: float
    second_stiffness: float  # over the second mass, as is its damping
    second_damping: float
    law: SmoothLaw
    powers: tuple[float, float, float, float, float, float]  # as `_pull` wants them
    short: bool  # whether these powers are all there is


@njit(cache=True)
def _axis_of(linear: Array, p: Array) -> ForcedAxis:
    """The axis of the nominal parameters `linear` (m, c, k, offset) and the parameter array `p`."""
    m, c, k = linear[0], linear[1], linear[2]
    q = ((c + p[VISCOUS]) / m, p[DRAG] / m, p[ASYMMETRY] / m, (k + p[SPRING]) / m, p[QUADRATIC] / m, p[CUBIC] / m)
    k2, c2 = p[OMEGA2] * p[OMEGA2], 2.0 * p[DAMPING2] * p[OMEGA2]
    return ForcedAxis(m, c, k, p[MASS2], k2, c2, smooth_law(p), q, polynomial(p))


@njit(cache=True)
def _runge_kutta(
    x: float,
    v: float,
    u: tuple[float, float, float],
    t: float,
    h: float,
    slow: float,
    axis: ForcedAxis,
) -> tuple[float, float, float]:
    """One step of (x, v); the last item is the acceleration at its start."""
    less, c, k, law = 1.0 / axis.mass, axis.damping, axis.stiffness, axis.law
    a1 = less * (u[0] - c * v - k * x - smooth_force(x, v, t, slow, law))
    x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
    a2 = less * (u[1] - c * v2 - k * x2 - smooth_force(x2, v2, t + 0.5 * h, slow, law))
    x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
    a3 = less * (u[1] - c * v3 - k * x3 - smooth_force(x3, v3, t + 0.5 * h, slow, law))
    x4, v4 = x + h * v3, v + h * a3
    a4 = less * (u[2] - c * v4 - k * x4 - smooth_force(x4, v4, t + h, slow, law))
    return x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), a1


@njit(cache=True)
def _accelerations(
    s: tuple[float, float, float, float],
    u: float,
    t: float,
    slow: float,
    axis: ForcedAxis,
) -> tuple[float, float]:
    """Accelerations of the axis and of the second mass; `u` with offset and held friction."""
    pull = axis.second_stiffness * (s[0] - s[2]) + axis.second_damping * (s[1] - s[3])
    force = u - axis.damping * s[1] - axis.stiffness * s[0] - smooth_force(s[0], s[1], t, slow, axis.law)
    return force / axis.mass - axis.second_mass * pull, pull


@njit(cache=True)
def _two_masses(
    s: tuple[float, float, float, float],
    u: tuple[float, float, float],
    t: float,
    h: float,
    slow: float,
    axis: ForcedAxis,
) -> tuple[float, float, float, float, float]:
    """`_runge_kutta` with a second mass: one step of (x, v, x2, v2); the last item is the acceleration at its start."""
    x, v, y, w = s
    a1, b1 = _accelerations(s, u[0], t, slow, axis)
    v2, w2 = v + 0.5 * h * a1, w + 0.5 * h * b1
    s2 = (x + 0.5 * h * v, v2, y + 0.5 * h * w, w2)
    a2, b2 = _accelerations(s2, u[1], t + 0.5 * h, slow, axis)
    v3, w3 = v + 0.5 * h * a2, w + 0.5 * h * b2
    s3 = (x + 0.5 * h * v2, v3, y + 0.5 * h * w2, w3)
    a3, b3 = _accelerations(s3, u[1], t + 0.5 * h, slow, axis)
    v4, w4 = v + h * a3, w + h * b3
    a4, b4 = _accelerations((x + h * v3, v4, y + h * w3, w4), u[2], t + h, slow, axis)
    return (
        x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4),
        v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4),
        y + h / 6.0 * (w + 2.0 * w2 + 2.0 * w3 + w4),
        w + h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4),
        a1,
    )


@njit(cache=True)
def polynomial(p: Array) -> bool:
    """Whether position and speed alone, in powers, make the smooth force: then one short step serves."""
    return (
        p[MAXWELL_K] == 0.0
        and p[SOFTENING] == 0.0
        and p[GAP] == 0.0
        and p[PITCH] <= 0.0
        and p[FREQUENCY] <= 0.0
        and p[CONTACT_N] <= 0.0
        and p[MASS2] <= 0.0
        and p[MOMENT_S] == 0.0
        and p[MOMENT_C] == 0.0
    )


@njit(cache=True)
def _pull(x: float, v: float, q: tuple[float, float, float, float, float, float]) -> float:
    """Acceleration by spring and damper: q = (damping, drag, asymmetry, stiffness, quadratic, cubic), each per mass."""
    return -(q[0] + q[1] * abs(v)) * v - q[2] * abs(v) - (q[3] + (q[4] + q[5] * x) * x) * x


@njit(cache=True)
def _short_step(
    x: float, v: float, u0: float, u1: float, u2: float, h: float, q: tuple[float, float, float, float, float, float]
) -> tuple[float, float, float]:
    """One Runge-Kutta step of (x, v) for input accelerations at its start, middle and end; the last item is the
    acceleration at its start.
    """
    a1 = u0 + _pull(x, v, q)
    v2 = v + 0.5 * h * a1
    a2 = u1 + _pull(x + 0.5 * h * v, v2, q)
    v3 = v + 0.5 * h * a2
    a3 = u1 + _pull(x + 0.5 * h * v2, v3, q)
    v4 = v + h * a3
    a4 = u2 + _pull(x + h * v3, v4, q)
    return x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), a1


@njit(cache=True)
def _step(
    s: tuple[float, float, float, float], u: tuple[float, float, float], t: float, h: float, slow: float, axis: ForcedAxis
) -> tuple[float, float, float, float, float]:
    """One step of (x, v, x2, v2) without dry friction, at no more cost than the forces need; the last item is the
    acceleration at its start.
    """
    if axis.short:
        x, v, a = _short_step(s[0], s[1], u[0] / axis.mass, u[1] / axis.mass, u[2] / axis.mass, h, axis.powers)
        return x, v, x, v, a
    if axis.second_mass > 0.0:
        return _two_masses(s, u, t, h, slow, axis)
    x, v, a = _runge_kutta(s[0], s[1], u, t, h, slow, axis)
    return x, v, x, v, a


@njit(cache=True)
def _linear(p: Array) -> bool:
    """Whether position and speed alone, in proportion, make all forces."""
    return (
        polynomial(p)
        and p[DRAG] == 0.0
        and p[ASYMMETRY] == 0.0
        and p[QUADRATIC] == 0.0
        and p[CUBIC] == 0.0
        and p[COULOMB] == 0.0
        and (p[EXCESS] == 0.0 or p[STRIBECK] <= 0.0)
        and p[STRIBECK_D] <= 0.0
        and p[PRESLIDING] == 0.0
        and p[LOAD] == 0.0
        and p[SMOOTH_SPEED] <= 0.0
        and p[LOAD_SMOOTH_SPEED] <= 0.0
    )


@njit(cache=True)
def _run_linear(
    u: Array,
    substeps: int,
    h: float,
    more: float,
    m: float,
    q: tuple[float, float, float, float, float, float],
    begin: Array,
) -> Array:
    """`run_axis` with forces in proportion to position and speed (q as in `_pull`), and a constant one, `more`.

    Its Runge-Kutta step is then one matrix for all steps, and the input's share of it is known ahead.
    """
    n = u.shape[0]
    out = np.empty((4, n))
    xx, vx, _ = _short_step(1.0, 0.0, 0.0, 0.0, 0.0, h, q)
    xv, vv, _ = _short_step(0.0, 1.0, 0.0, 0.0, 0.0, h, q)
    x0, v0, _ = _short_step(0.0, 0.0, 1.0 / m, 0.0, 0.0, h, q)
    x1, v1, _ = _short_step(0.0, 0.0, 0.0, 1.0 / m, 0.0, h, q)
    x2, v2, _ = _short_step(0.0, 0.0, 0.0, 0.0, 1.0 / m, h, q)
    x, v = begin[0], begin[1]
    for i in range(n):
        out[0, i], out[1, i] = x, v
        out[2, i] = (u[i, 0, 0] + more) / m - q[0] * v - q[3] * x
        out[3, i] = u[i, 0, 0]
        for j in range(substeps):
            first, middle, last = u[i, j, 0] + more, u[i, j, 1] + more, u[i, j, 2] + more
            by_x = x0 * first + x1 * middle + x2 * last
            by_v = v0 * first + v1 * middle + v2 * last
            x, v = xx * x + xv * v + by_x, vx * x + vv * v + by_v
        if not abs(x) < 1e12:
            out[:, i:] = 1e12
            break
    return out


@njit(cache=True)
def _dry(v_old: float, v_free: float, a_free: float, dry: float, h: float, m: float) -> tuple[float, float, bool]:
    """Speed and place, beyond that without friction, after Coulomb friction `dry` has acted over a step; whether it holds.

    The axis stops within the step where its speed passes zero, and slides back if the other forces exceed friction. With the
    friction of one direction over the whole step, each reversal has an error of the first order in h.
    """
    if v_old == 0.0 and abs(a_free) * m <= dry:
        return 0.0, 0.0, True
    a, least = (v_free - v_old) / h, dry / m
    side = 1.0 if (v_old if v_old != 0.0 else v_free) > 0.0 else -1.0
    v = v_free - side * least * h
    if side * v >= 0.0:
        return v, 0.5 * h * (v - v_free), False
    first = abs(v_old) / abs(a - side * least)  # time until it stops
    v = (a + side * least) * (h - first) if abs(a) > least else 0.0
    return v, 0.5 * (v_old * first + v * (h - first)) - 0.5 * h * (v_old + v_free), False


@njit(cache=True)
def _begun(begin: Array) -> tuple[float, float, float, float]:
    """Place and speed of the axis and of a second mass, which begins at rest on the axis if `begin` does not say where."""
    if begin.size < 4:
        return begin[0], begin[1], begin[0], begin[1]
    return begin[0], begin[1], begin[0] + begin[2], begin[1] + begin[3]


@njit(cache=True)
def run_axis(
    u: Array,
    substeps: int,
    dt_s: float,
    linear: Array,
    p: Array,
    begin: Array,
    load: Array,
    control: Array,
    reference: Array,
    start: float,
    begin_s: float,
) -> Array:
    """Motion of m a + c v + k x + (force terms) = u + offset from recorded or controlled input.

    Arguments:
        u: (n, substeps, 3) input at the start, middle and end of every sub-step; of no use with a controller.
        linear: m, c, k, offset. begin: x and v at the first sample; place and speed of the second mass from there, or
            nothing if it begins at rest on the axis.
        control: (kp, kv, gain, limit) of a cascade controller, or empty. reference: (2, n) its reference, and what is
            added to its force. start: friction held at first. begin_s: time of the first sample.
    Returns:
        (4, n): position, velocity, acceleration, input used.
    Runge-Kutta for the smooth forces; Coulomb friction as an impulse at the end of each sub-step, so that it can hold
    (Moreau 1988).
    """
    n = load.size
    out = np.empty((4, n))
    m, offset, h = linear[0], linear[3], dt_s / substeps
    s = _begun(begin)
    z = np.zeros(6)
    start_state(z, start, load[0], p)
    held, slow = hysteresis(z, 0.0, begin[1], load[0], p), begin[0] - relaxed_by(start, p)
    decay = math.exp(-h / p[MAXWELL_T]) if p[MAXWELL_T] > 0.0 else 0.0
    previous, drive = begin[0], 0.0
    axis = _axis_of(linear, p)
    if not control.size and _linear(p):
        return _run_linear(u, substeps, h, offset - p[CONSTANT], m, axis.powers, begin)
    remembers = p[PRESLIDING] != 0.0 or p[LOAD] != 0.0 or p[STRIBECK_D] > 0.0
    rises = p[SMOOTH_SPEED] > 0.0 or p[LOAD_SMOOTH_SPEED] > 0.0
    for i in range(n):
        if control.size:
            drive = (
                control[2] * control[1] * (control[0] * (reference[0, i] - s[0]) - (s[0] - previous) / dt_s)
                + reference[1, i]
            )
            drive = min(max(drive, -control[3]), control[3])
            previous = s[0]
        out[0, i], out[1, i] = s[0], s[1]
        out[3, i] = drive if control.size else u[i, 0, 0]
        # What the controller asks for is recorded; what a weak or sticky drive gives of it is not.
        drive -= min(max(drive, -p[DRIVE_DEAD]), p[DRIVE_DEAD])
        if p[DRIVE_LIMIT] > 0.0:
            drive = min(max(drive, -p[DRIVE_LIMIT]), p[DRIVE_LIMIT])
        for j in range(substeps):
            more = offset - held - (p[CONSTANT] if axis.short else 0.0)
            push = (
                (drive + more, drive + more, drive + more)
                if control.size
                else (u[i, j, 0] + more, u[i, j, 1] + more, u[i, j, 2] + more)
            )
            # Half the impulse of friction that rises with speed before the step, half after it (Strang 1968).
            if rises:
                s = (s[0], _slowed_by_rising(s[1], load[i], 0.5 * h / m, p), s[2], s[3])
            x_old, v_old = s[0], s[1]
            dry = level_at(v_old, p) if p[STRIBECK_D] <= 0.0 else 0.0
            x, v, x2, v2, a = _step(s, push, begin_s + i * dt_s + j * h, h, slow, axis)
            if j == 0:
                out[2, i] = a - (dry / m if v_old > 0.0 else (-dry / m if v_old < 0.0 else min(max(a, -dry / m), dry / m)))
                out[2, i] -= _rising(v_old, load[i], p) / m
            if dry > 0.0:
                v, further, stuck = _dry(v_old, v, a, dry, h, m)
                x = x_old if stuck else x + further
            if rises:
                v = _slowed_by_rising(v, load[i], 0.5 * h / m, p)
            s = (x, v, x2, v2)
            slow = x + (slow - x) * decay
            if remembers:
                held = hysteresis(z, x - x_old, v, load[i], p)
            if not abs(x) < 1e12:
                out[:, i:] = 1e12
                return out
    return out


def slot_array(filled: list[dict[str, float]]) -> Array:
    """Parameter array of the kernel from the slots that the active effects fill."""
    p = np.zeros(len(SLOTS))
    for slots in filled:
        for name, value in slots.items():
            p[PLACE[name]] = value
    return p
